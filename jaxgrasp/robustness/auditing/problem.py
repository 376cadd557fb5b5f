"""The data of the grasps as the audit sees them: the public arguments, lanes leading, in newtons and metres."""

import math
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxgrasp.arrays import fold_last
from jaxgrasp.contact.actuation import Actuation
from jaxgrasp.contact.compliance import Compliance
from jaxgrasp.contact.friction import contact_facets
from jaxgrasp.disturbance.terms import Term
from jaxgrasp.robustness.actuators import Actuated, clip_limits
from jaxgrasp.robustness.interface.arguments import Arguments, Inputs


class Problem(NamedTuple):
    """Grasps and what is asked of them; leaves (lanes, ...), or (1, ...) where all lanes share them.

    positions, frames: as in `Contacts`; whatever is given where a contact is absent.
    friction, max_force: as in `Contacts`; 0 and 1 where a contact is absent. A contact without friction has friction 1:
        the rows of C then say that it does not pull.
    arms: (lanes, n), m, moments about the normals per newton of the fourth component of forces; None for hard contacts.
    present: bool (lanes, n).
    transmits: bool (lanes, n, k), which components of force a contact has: without friction the normal one alone.
    size: (lanes,), m, root-mean-square distance of the contacts from the centre of mass; 1 where that is zero.
    wrench: (lanes, 6), b, N and N m.
    reserve: (lanes, n or 1, n_e or 1), d, N, zero where a contact is absent; None where there is none.
    terms: the disturbance set, lanes trailing.
    reach: (lanes, 6), the largest |w_i| of the set.
    compliance, per_vertex, weights, margin, cutoff: as given; None where not.
    hand: what actuators can do, None without any.
    """

    positions: jax.Array
    frames: jax.Array
    friction: jax.Array
    max_force: jax.Array
    arms: jax.Array | None
    present: jax.Array
    transmits: jax.Array
    size: jax.Array
    wrench: jax.Array
    reserve: jax.Array | None
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
    leading = lambda x, shared: jax.lax.stop_gradient(x[None] if shared else x)
    inputs: Inputs = jax.tree.map(leading, arguments.inputs, arguments.shared)
    data, contacts, compliance = inputs.data, inputs.data.contacts, inputs.data.compliance
    assert data.required_wrench is not None
    present, rough = contacts.active, contacts.active & (contacts.friction > 0)
    arms = contacts.torsional_arms
    turning = [] if arms is None else [present & (arms > 0)]
    transmits = jnp.stack([rough, rough, jnp.broadcast_to(present, rough.shape), *turning], -1)
    here = lambda x, other: jnp.where(present.reshape(*present.shape, *[1] * (x.ndim - 2)), x, other)
    positions = here(contacts.positions, 0)
    friction, max_force = here(jnp.where(rough, contacts.friction, 1), 0), here(contacts.max_force, 1)
    count = jnp.maximum(fold_last(jnp.add, present.astype(positions.dtype)), 1)
    # In units of the largest, whose square may be more, or less, than there are numbers for.
    largest = fold_last(jnp.maximum, jnp.abs(positions), 2)
    largest = jnp.where(largest > 0, largest, 1)
    square = fold_last(jnp.add, (positions / largest[:, None, None]) ** 2, 2) / count
    strongest = jnp.where(present, max_force, 0)
    return Problem(
        positions=contacts.positions,
        frames=contacts.frames,
        friction=friction,
        max_force=max_force,
        arms=None if arms is None else here(arms, 0),
        present=present,
        transmits=transmits,
        size=largest * jnp.sqrt(jnp.where(square > 0, square, 1)),
        wrench=data.required_wrench,
        reserve=None if data.cone_margin is None else _reserve(data.cone_margin, present),
        terms=jax.tree.map(lambda x: jnp.moveaxis(x, 0, -1), data.disturbances.terms),
        reach=sum(inputs.extents),  # pyright: ignore[reportArgumentType]  # no sum of none
        compliance=None if isinstance(compliance, Compliance) else compliance,
        per_vertex=compliance.per_vertex if isinstance(compliance, Compliance) else None,
        weights=inputs.options.effort_weights,
        margin=inputs.options.margin,
        cutoff=inputs.options.cutoff,
        hand=None
        if data.actuation is None
        else _hand(data.actuation, jnp.where(transmits[..., None], data.actuation.jacobian, 0), friction, strongest),
    )


def _reserve(reserve: jax.Array, present: jax.Array) -> jax.Array:
    rows = reserve.reshape(*reserve.shape, *[1] * (3 - reserve.ndim))
    return rows if reserve.ndim == 1 else jnp.where(present[:, :, None], rows, 0)


def _hand(actuation: Actuation, jacobian: jax.Array, friction: jax.Array, max_force: jax.Array) -> Hand:
    last = lambda x: jnp.moveaxis(x, 0, -1)
    limits = clip_limits(
        Actuated(
            joints=jnp.moveaxis(jacobian, (3, 2, 1, 0), (0, 1, 2, 3)),
            transmission=last(actuation.transmission),
            inverse=last(actuation.inverse),
            unreached=None,
            lower=last(actuation.lower),
            upper=last(actuation.upper),
        ),
        last(friction),
        last(max_force),
    )
    return Hand(
        jacobian=jacobian,
        transmission=actuation.transmission,
        inverse=actuation.inverse,
        unreached=actuation.unreached,
        lower=jnp.moveaxis(limits.lower, -1, 0),
        upper=jnp.moveaxis(limits.upper, -1, 0),
    )


def every(x: jax.Array, turn: jax.Array, stride: int, devices: int = 1) -> jax.Array:
    """Lane `turn` of every `stride` lanes; what is left over at the end, of each device, is not looked at."""
    lanes = x.reshape(devices, -1, *x.shape[1:])
    blocks = lanes[:, : lanes.shape[1] // stride * stride].reshape(devices, -1, stride, *x.shape[1:])
    return jax.lax.dynamic_index_in_dim(blocks, turn, 2, keepdims=False).reshape(-1, *x.shape[1:])


def devices_of(lanes: jax.Array) -> int:
    """Over how many devices the leading axis is divided, as far as its type says so."""
    sharding = jax.typeof(lanes).sharding
    axes = sharding.spec[0] if len(sharding.spec) else None
    names = axes if isinstance(axes, tuple) else (axes,) if axes is not None else ()
    return math.prod(sharding.mesh.shape[name] for name in names)


def facets(problem: Problem, cone_edges: int) -> np.ndarray:
    """The facet rows for unit friction: (n_e, 3), of soft contacts (2 n_e, 4)."""
    return contact_facets(cone_edges, 3 if problem.arms is None else 4)


def edges_of(problem: Problem, cone: jax.Array) -> int:
    """n_e, from numbers of every facet (..., facets)."""
    return cone.shape[-1] if problem.arms is None else cone.shape[-1] // 2
