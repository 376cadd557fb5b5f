"""The public, batch-first arguments side by side: which leaves have the batch axes, and which all grasps share."""

import math
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxgrasp.arrays import as_float, broadcast_batch
from jaxgrasp.contact.actuation import Actuation
from jaxgrasp.contact.compliance import Compliance
from jaxgrasp.contact.contacts import Contacts
from jaxgrasp.disturbance import DisturbanceSet
from jaxgrasp.disturbance.terms import Term
from jaxgrasp.disturbance.vertices import Vertices

_CONTACT_LEAVES = ("positions", "frames", "friction", "max_force", "active")
_PUBLIC = {
    "wrench": "required_wrench",
    "reserve": "cone_margin",
    "per_vertex": "compliance",
    "weights": "effort_weights",
}
# Trailing axes of the leaves of `Actuation`.
ACTUATION_EVENTS = {"jacobian": 3, "transmission": 2, "inverse": 2, "unreached": 2, "lower": 1, "upper": 1}


@dataclass(frozen=True)
class Arguments:
    """Public arguments by name.

    leaves: (lanes, ...), or without the leading axis where all grasps share them.
    shared: by name.
    batch: the batch axes that the lanes stand for.
    structure: of the disturbance set, whose leaves are named "term 0", "term 1" and so on.
    """

    leaves: dict[str, jax.Array]
    shared: dict[str, bool]
    batch: tuple[int, ...]
    structure: Any

    def terms(self, leaves: dict[str, jax.Array]) -> tuple[Term, ...]:
        """The terms of the disturbance set, from leaves by name."""
        return jax.tree.unflatten(self.structure, [leaves[f"term {i}"] for i in range(self.structure.num_leaves)]).terms


def laid_out(contacts: Contacts, disturbances: DisturbanceSet, given: dict) -> Arguments:
    """Broadcast all arguments to the batch that they have in common.

    Args:
        contacts: the grasps; their dtype is the precision of everything.
        disturbances: the set D.
        given: the other arguments by their public names, None where not given.

    Raises:
        ValueError: shapes that do not fit.
    """
    required_wrench, compliance, cone_margin = given["required_wrench"], given["compliance"], given["cone_margin"]
    effort_weights = given["effort_weights"]
    n = contacts.n_c
    own = {name: (getattr(contacts, name), contacts.batch_shape) for name in _CONTACT_LEAVES}
    other: dict[str, tuple[Any, tuple[int, ...]]] = {
        "wrench": _argument("required_wrench", np.zeros(6) if required_wrench is None else required_wrench, (6,)),
        "reserve": _argument("cone_margin", cone_margin, ()),
    }
    if isinstance(compliance, Compliance):
        other["per_vertex"] = _per_vertex(compliance, disturbances, n)
    elif compliance is not None:
        other["compliance"] = _compliance(compliance, n)
    if effort_weights is not None:
        other["weights"] = _argument("effort_weights", effort_weights, (n, 3, 3))
    for name in ("margin", "smoothing", "cutoff"):
        if given[name] is not None:
            other[name] = _argument(name, given[name], ())
    if given["actuation"] is not None:
        other |= _actuation(given["actuation"], n)
    batch = broadcast_batch(
        contacts=contacts.batch_shape,
        disturbances=disturbances.batch_shape,
        **{_PUBLIC.get(name, name): lead for name, (_, lead) in other.items()},
    )
    dtype = contacts.positions.dtype
    terms, structure = jax.tree.flatten(disturbances.spread_over(batch) if disturbances.batch_shape else disturbances)
    lead = batch if disturbances.batch_shape else ()
    spread = jax.tree.unflatten(structure, terms)
    leaves = {**own, **other, **{f"term {i}": (leaf, lead) for i, leaf in enumerate(terms)}}
    leaves |= {f"extent {i}": (jax.lax.stop_gradient(term.extent()), lead) for i, term in enumerate(spread.terms)}

    arguments, shared = {}, {}
    for name, (leaf, lead) in leaves.items():
        leaf = leaf if leaf.dtype == bool else leaf.astype(dtype)
        shared[name] = not lead and name not in own
        if not shared[name]:
            event = leaf.shape[len(lead) :]
            leaf = jnp.broadcast_to(leaf, (*batch, *event)).reshape(math.prod(batch), *event)
        arguments[name] = leaf
    return Arguments(arguments, shared, batch, structure)


def _argument(name: str, value: Any, event: tuple[int, ...]) -> tuple[jax.Array, tuple[int, ...]]:
    array = as_float(name, value, event)
    return array, array.shape[: array.ndim - len(event)]


def _compliance(value: Any, n: int) -> tuple[jax.Array, tuple[int, ...]]:
    array = as_float("compliance", value, ("rows", "columns"))
    for event in ((n, 3, 3), (3 * n, 3 * n)):
        if array.shape[-len(event) :] == event:
            return array, array.shape[: array.ndim - len(event)]
    raise ValueError(f"compliance: got shape {array.shape}, wanted (*batch, {n}, 3, 3) or (*batch, {3 * n}, {3 * n})")


def _per_vertex(compliance: Compliance, disturbances: DisturbanceSet, n: int) -> tuple[jax.Array, tuple[int, ...]]:
    if len(disturbances.terms) != 1 or not isinstance(disturbances.terms[0], Vertices):
        raise ValueError(
            "compliance: got one Q for each direction, wanted a single Q, "
            "since the disturbance set is not given by vertices; use DisturbanceSet.vertices"
        )
    if disturbances.terms[0].width is not None:
        raise ValueError("compliance: got one Q for each direction, wanted a single Q, since the set is smoothed")
    array, count = compliance.per_vertex, disturbances.terms[0].wrenches.shape[-2]
    for event in ((count, n, 3, 3), (count, 3 * n, 3 * n)):
        if array.shape[-len(event) :] == event:
            return array, array.shape[: array.ndim - len(event)]
    raise ValueError(
        f"compliance: got shape {array.shape}, wanted (*batch, {count}, {n}, 3, 3) or "
        f"(*batch, {count}, {3 * n}, {3 * n}), one Q for each of the {count} wrenches"
    )


def _actuation(actuation: Actuation, n: int) -> dict[str, tuple[jax.Array, tuple[int, ...]]]:
    if actuation.jacobian.shape[-3] != n:
        raise ValueError(
            f"actuation: got a jacobian of shape {actuation.jacobian.shape}, wanted (*batch, {n}, 3, n_v), "
            f"one for each of the {n} contacts"
        )
    leaves = {name: getattr(actuation, name) for name in ACTUATION_EVENTS}
    return {name: (x, x.shape[: x.ndim - ACTUATION_EVENTS[name]]) for name, x in leaves.items() if x is not None}
