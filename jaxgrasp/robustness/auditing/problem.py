"""The data of the grasps as the audit sees them: the public arguments, lanes leading, in newtons and metres."""

from dataclasses import replace
from typing import NamedTuple

import jax
import jax.numpy as jnp

from jaxgrasp.arrays import fold_last
from jaxgrasp.contact.friction import pyramid_facets
from jaxgrasp.disturbance.terms import Term
from jaxgrasp.robustness.actuators import Actuated, limited
from jaxgrasp.robustness.interface.arguments import Arguments


class Problem(NamedTuple):
    """Grasps and what is asked of them; leaves (lanes, ...), or (1, ...) where all lanes share them.

    positions, frames, friction, max_force: as in `Contacts`; zero where a contact is absent, but for max_force, 1.
    present: bool (lanes, n).
    size: (lanes,), m, root-mean-square distance of the contacts from the centre of mass; 1 where that is zero.
    wrench: (lanes, 6), b, N and N m.
    reserve: (lanes,), d, N.
    terms: the disturbance set, lanes trailing.
    reach: (lanes, 6), the largest |w_i| of the set.
    compliance, per_vertex, weights, margin, cutoff: as given; None where not.
    hand: what actuators can do, None without any.
    """

    positions: jax.Array
    frames: jax.Array
    friction: jax.Array
    max_force: jax.Array
    present: jax.Array
    size: jax.Array
    wrench: jax.Array
    reserve: jax.Array
    terms: tuple[Term, ...]
    reach: jax.Array
    compliance: jax.Array | None
    per_vertex: jax.Array | None
    weights: jax.Array | None
    margin: jax.Array | None
    cutoff: jax.Array | None
    hand: "Hand | None"


class Hand(NamedTuple):
    """`Actuation`, lanes leading, limits as finite as bounded contact forces allow."""

    jacobian: jax.Array
    transmission: jax.Array
    inverse: jax.Array
    unreached: jax.Array | None
    lower: jax.Array
    upper: jax.Array


def problem_of(arguments: Arguments) -> Problem:
    """The audit's view of the arguments; no derivative passes through it."""
    leaves = {
        name: jax.lax.stop_gradient(x[None] if arguments.shared[name] else x) for name, x in arguments.leaves.items()
    }
    present = leaves["active"]
    here = lambda name, other: jnp.where(
        present.reshape(*present.shape, *[1] * (leaves[name].ndim - 2)), leaves[name], other
    )
    positions, friction, max_force = here("positions", 0), here("friction", 0), here("max_force", 1)
    count = jnp.maximum(fold_last(jnp.add, present.astype(positions.dtype)), 1)
    # In units of the largest, whose square may be more, or less, than there are numbers for.
    largest = fold_last(jnp.maximum, jnp.abs(positions), 2)
    largest = jnp.where(largest > 0, largest, 1)
    square = fold_last(jnp.add, (positions / largest[:, None, None]) ** 2, 2) / count
    last = {name: jnp.moveaxis(x, 0, -1) for name, x in leaves.items() if name.startswith("term")}
    terms = arguments.terms(last)
    strongest = jnp.where(present, max_force, 0)
    return Problem(
        positions=positions,
        frames=here("frames", 0),
        friction=friction,
        max_force=max_force,
        present=present,
        size=largest * jnp.sqrt(jnp.where(square > 0, square, 1)),
        wrench=leaves["wrench"],
        reserve=leaves["reserve"],
        terms=terms,
        reach=sum(leaves[f"extent {i}"] for i in range(len(terms))),  # pyright: ignore[reportArgumentType]  # no sum of none
        compliance=leaves.get("compliance"),
        per_vertex=leaves.get("per_vertex"),
        weights=leaves.get("weights"),
        margin=leaves.get("margin"),
        cutoff=leaves.get("cutoff"),
        hand=_hand(leaves, here("jacobian", 0), friction, strongest) if "jacobian" in leaves else None,
    )


def _hand(leaves: dict[str, jax.Array], jacobian: jax.Array, friction: jax.Array, max_force: jax.Array) -> Hand:
    last = lambda x: jnp.moveaxis(x, 0, -1)
    limits = limited(
        Actuated(
            joints=jnp.moveaxis(jacobian, (3, 2, 1, 0), (0, 1, 2, 3)),
            transmission=last(leaves["transmission"]),
            inverse=last(leaves["inverse"]),
            unreached=None,
            lower=last(leaves["lower"]),
            upper=last(leaves["upper"]),
        ),
        last(friction),
        last(max_force),
    )
    return Hand(
        jacobian=jacobian,
        transmission=leaves["transmission"],
        inverse=leaves["inverse"],
        unreached=leaves.get("unreached"),
        lower=jnp.moveaxis(limits.lower, -1, 0),
        upper=jnp.moveaxis(limits.upper, -1, 0),
    )


def picked(arguments: Arguments, turn: jax.Array, stride: int) -> Arguments:
    """The arguments of one lane in `stride`, see `every`."""
    leaves = {name: x if arguments.shared[name] else every(x, turn, stride) for name, x in arguments.leaves.items()}
    return replace(arguments, leaves=leaves)


def every(x: jax.Array, turn: jax.Array, stride: int) -> jax.Array:
    """Lane `turn` of every `stride` lanes; what is left over at the end is not looked at."""
    blocks = x[: x.shape[0] // stride * stride].reshape(-1, stride, *x.shape[1:])
    return jax.lax.dynamic_index_in_dim(blocks, turn, 1, keepdims=False)


def facets(cone_edges: int, dtype: jnp.dtype) -> jax.Array:
    """The facet rows (n_e, 3) for unit friction."""
    return jnp.asarray(pyramid_facets(cone_edges), dtype)
