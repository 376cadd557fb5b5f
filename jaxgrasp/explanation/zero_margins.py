"""Why margins are zero: what the contacts of a grasp lack, in words."""

import functools
from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, Int

from jaxgrasp import linalg
from jaxgrasp.compiling import compiled
from jaxgrasp.contact import Contacts
from jaxgrasp.contact.row_space import RANK_TOLERANCE
from jaxgrasp.disturbance import DisturbanceSet
from jaxgrasp.lanes.direct import power_of_two
from jaxgrasp.metrics import WrenchSpace
from jaxgrasp.metrics.interior import contains_origin
from jaxgrasp.metrics.wrench_space import edges_of
from jaxgrasp.solvers.status import Status

# Of more grasps than this the reasons of so many are found, evenly spread over them.
_LOOKED_AT = 1_000

REASONS = {
    "contact": "without contacts",
    "line": "with contacts on one line (as two always are), about which hard contacts do not resist a turn",
    "friction": "without friction",
    "slippery": "with contacts without friction: they push along their normals alone, and some disturbance needs more",
    "closure": "without force closure: no forces inside the friction cones squeeze the object",
    "spare": "with force closure, to which the load, the largest forces or the actuators leave no force to spare",
}
"""Why a margin is zero, in words that follow "a grasp"; the first one that is true."""
# Multiples of the disturbances below which a margin is none.
_SMALLEST_MARGIN = 1e-6


def is_zero(margin: Float[np.ndarray, " batch"], status: Int[np.ndarray, " batch"]) -> Bool[np.ndarray, " batch"]:
    """Whether a margin (21) that was found is none.

    Args:
        margin: Multiples of the disturbances.
        status: `Status` of each.
    """
    return (status == Status.SOLVED) & (margin <= _SMALLEST_MARGIN)


def why_zero(
    contacts_of: Callable[[Int[np.ndarray, " rows"]], Contacts],
    zero: Bool[np.ndarray, " batch"],
    disturbances: DisturbanceSet,
    *,
    cone_edges: int = 8,
) -> list[str]:
    """Find out why the margins (21) of grasps are zero.

    Args:
        contacts_of: Makes the contacts of some grasps by their numbers, with one batch axis: there may be too many for
            all at once.
        zero: Which grasps have a margin of zero.
        disturbances: The set that the margins scale, the same for all.
        cone_edges: Edges of the friction pyramid.

    Returns:
        A line for each reason that there is, with the number of grasps, the commonest first; of large numbers of grasps
        the shares are those of a part.
    """
    rows = np.flatnonzero(zero)
    if not len(rows):
        return []
    looked_at = rows[:: -(-len(rows) // _LOOKED_AT)]
    # Of few sizes, so that there are few programs.
    more = np.full(power_of_two(len(looked_at), 1) - len(looked_at), looked_at[-1])
    found = np.asarray(reasons(contacts_of(np.concatenate([looked_at, more])), disturbances, cone_edges))
    found = found[: len(looked_at)]
    of = "" if len(looked_at) == len(rows) else f" of {len(looked_at):,} looked at"
    counts = {reason: int((found == number).sum()) for number, reason in enumerate(REASONS)}
    return [
        f"{count:,}{of} {REASONS[reason]}"
        for reason, count in sorted(counts.items(), key=lambda item: -item[1])
        if count
    ]


@functools.partial(compiled, static_argnums=(2,), pace=lambda *_: "soon")
def reasons(contacts: Contacts, disturbances: DisturbanceSet, cone_edges: int) -> jax.Array:
    """Why the margins of grasps are zero, where they are.

    Args:
        contacts: Grasps with one batch axis.
        disturbances: The set that the margins scale; with one batch axis or none.
        cone_edges: Edges of the friction pyramid.

    Returns:
        The place of each grasp's reason in `REASONS`.
    """
    edges = edges_of(contacts, WrenchSpace(cone_edges=cone_edges))
    smooth = edges.present & (jnp.where(edges.present, contacts.friction, 1) == 0)
    others = [jnp.zeros_like(smooth)] * (edges.grasp_map.shape[-1] - 2)
    sideways = jnp.stack([smooth, smooth, *others], -1)
    G = jnp.where(sideways[..., None, :], 0, edges.grasp_map)
    G = jnp.moveaxis(G, -3, -2).reshape(*edges.valid.shape, 6, -1)
    singular, left = linalg.right_singular(jnp.swapaxes(G, -1, -2))
    # Rows: directions of wrenches, and which of them no contact forces exert.
    directions = jnp.swapaxes(left, -1, -2)
    unreached = singular <= RANK_TOLERANCE[G.dtype.name] * singular[:, :1]
    twists = jnp.concatenate([directions[..., :3], directions[..., 3:] / edges.length[:, None, None]], -1)
    extent = jnp.maximum(disturbances.support(twists), disturbances.support(-twists))
    disturbed = jnp.where(unreached, extent, 0).max(-1) > RANK_TOLERANCE[G.dtype.name] * extent.max(-1)

    # With both signs of what is lacking, the hull of the wrenches has the origin inside where it has it in their span.
    lacking = jnp.where(unreached[..., None], directions, 0)
    W = jnp.concatenate([edges.flat, lacking, -lacking], -2)
    longest = jnp.sqrt(jnp.max(jnp.sum(W * W, -1), -1))
    closed = jax.vmap(contains_origin)(W / jnp.where(longest > 0, longest, 1)[..., None, None])

    conditions = {
        "contact": ~edges.present.any(-1),
        "line": disturbed & ~smooth.any(-1),
        "friction": (smooth == edges.present).all(-1) & (disturbed | ~closed),
        "slippery": disturbed,
        "closure": ~closed,
        "spare": jnp.ones_like(closed),
    }
    return jnp.argmax(jnp.stack([conditions[reason] for reason in REASONS]), axis=0)
