"""What a cone margin d is for: a grasp, a contact or a row.

The number of its axes decides, never their lengths, so that no two meanings fit one array.
"""


def cone_margin_shape(shape: tuple[int, ...], batch_axes: int, n_c: int, cone_edges: int | None) -> tuple[int, ...]:
    """The shape of d without batch axes: () for one value a grasp, (n_c,) a contact, (n_c, n_e) a row.

    Args:
        shape: that of d.
        batch_axes: how many batch axes the other arguments have together. d is one value a grasp where it has no more
            axes, one a contact where it has one more, and one a row where it has two more.
        n_c: the number of contacts.
        cone_edges: n_e; None where friction cones are exact.

    Raises:
        ValueError: d has more axes than a row's, or other lengths than n_c and n_e.
    """
    event = shape[batch_axes:]
    if event in ((), (n_c,), (n_c, cone_edges)):
        return event
    rows = f"(*batch, {n_c}, {cone_edges}) a row" if cone_edges is not None else "no values for rows of exact cones"
    raise ValueError(
        f"cone_margin: got shape {shape}, wanted (*batch,) for one value a grasp, (*batch, {n_c}) a contact, {rows}; "
        f"*batch of the other arguments has {batch_axes} axes"
    )
