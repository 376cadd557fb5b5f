"""Gradient ascent of a batch of grasps on the robustness margin, with restarts of those that lead nowhere.

The margin is flat at zero without force closure. So every facet row first keeps d newtons in reserve, which makes the
margin of such grasps negative and gives it a slope, and d falls to zero on the way. A reserve only takes from the
margin: what is found with one is a lower bound of what holds without.
"""

import functools
from dataclasses import dataclass, replace
from typing import Any, cast

import jax
import jax.numpy as jnp
import optax
from jax import lax
from jax.sharding import Mesh
from jax.sharding import PartitionSpec as P
from jaxtyping import Array, Float, Int, PRNGKeyArray

from jaxgrasp.compiling import compiled
from jaxgrasp.contact import Contacts
from jaxgrasp.disturbance import DisturbanceSet
from jaxgrasp.geometry import normals
from jaxgrasp.robustness import largest_disturbance
from jaxgrasp.synthesis.placing import Placing

# Steps of one call of the compiled program: between calls the progress is told.
CHUNK = 10
# More edges than these make the ascent slower and its ends no better.
MOST_EDGES = 8
# The reserve d at the start, in units of max_force, and the share of the steps after which it is gone.
_RESERVE, _WITH_RESERVE = 0.1, 0.6
# Adam's step at the start and at the end, in units of half the diagonal of the object's bounds.
_FIRST_STEP, _LAST_STEP = 0.08, 0.001
_ADAM = optax.scale_by_adam(b1=0.9, b2=0.99)
# Shares of the steps after which starts below this share of the median margin begin anew elsewhere.
_RESTARTS, _HOPELESS = (0.1, 0.2, 0.3, 0.4, 0.5), 0.8
# Spacing and span count as kept up to this, in units of half the diagonal.
TOLERANCE = 1e-3


@jax.tree_util.register_dataclass
@dataclass(frozen=True, kw_only=True)
class Task:
    """What is wanted of every grasp."""

    placing: Placing
    """Where contacts may be."""
    disturbances: DisturbanceSet
    """The set D."""
    friction: Float[Array, ""]
    """Coulomb's coefficient."""
    max_force: Float[Array, ""]
    """Largest normal force, N."""
    center_of_mass: Float[Array, "3"]
    """In the frame of the shape, m."""
    size: Float[Array, ""]
    """Half the diagonal of the object's bounds, m."""
    steps: Float[Array, ""]
    """Steps in all."""

    def contacts(self, points: Float[Array, "*batch contacts 3"]) -> Contacts:
        """The contacts at points on the surface."""
        return Contacts.from_normals(
            points - self.center_of_mass,
            normals(self.placing.shape, points),
            friction=self.friction,
            max_force=self.max_force,
        )


@jax.tree_util.register_dataclass
@dataclass(frozen=True, kw_only=True)
class State:
    """Grasps on their way; starts lead."""

    starts: Float[Array, "starts contacts 3"]
    """Where they began, m: also the pool from which restarts draw."""
    points: Float[Array, "starts contacts 3"]
    """Where they are, m."""
    momentum: Any
    """Adam's."""
    best_points: Float[Array, "starts contacts 3"]
    """Where the margin was largest, spacing and span kept; m."""
    best_margin: Float[Array, " starts"]
    """A lower bound of the margin there; -inf before there is one."""
    restarts: Int[Array, " starts"]
    """How often each began anew."""

    @classmethod
    def from_starts(cls, points: Float[Array, "starts contacts 3"]) -> "State":
        """Grasps that have not moved yet."""
        count = points.shape[:1]
        # Adam's own count of steps becomes one a lane, since lanes begin anew on their own.
        momentum = jax.vmap(_ADAM.init)(points)
        return cls(
            starts=points,
            points=points,
            momentum=momentum,
            best_points=points,
            best_margin=jnp.full(count, -jnp.inf, points.dtype),
            restarts=jnp.zeros(count, jnp.int32),
        )


@functools.partial(compiled, static_argnums=(4, 5))
def advance(
    state: State, task: Task, first: Array, key: PRNGKeyArray, cone_edges: int, mesh: Mesh
) -> tuple[State, Float[Array, "chunk starts"]]:
    """`CHUNK` steps of all grasps, spread over the devices.

    Args:
        state: the grasps.
        task: what is wanted.
        first: the number of the first of these steps.
        key: key of the random numbers for restarts.
        cone_edges: edges of the friction pyramid.
        mesh: the devices, one axis "starts".

    Returns:
        The grasps, and after each step the best margin so far.
    """

    def on_one_device(state: State, task: Task, first: Array, key: PRNGKeyArray) -> tuple[State, Array]:
        key = jax.random.fold_in(key, lax.axis_index("starts"))

        def step(state: State, number: Array) -> tuple[State, Array]:
            state = _step(state, task, number, jax.random.fold_in(key, number), cone_edges)
            return state, state.best_margin

        return lax.scan(step, state, first + jnp.arange(CHUNK))

    spread = jax.shard_map(
        on_one_device,
        mesh=mesh,
        in_specs=(P("starts"), P(), P(), P()),
        out_specs=(P("starts"), P(None, "starts")),
        check_vma=False,
    )
    return spread(state, task, first, key)


def _step(state: State, task: Task, number: Array, key: PRNGKeyArray, cone_edges: int) -> State:
    dtype = state.points.dtype
    done = number.astype(dtype) / task.steps
    reserve = _RESERVE * task.max_force * jnp.maximum(1 - done / _WITH_RESERVE, 0)

    def total(points: Array) -> tuple[Array, tuple[Array, Array]]:
        contacts = task.contacts(points)
        margin = largest_disturbance(contacts, task.disturbances, cone_edges=cone_edges, cone_margin=reserve).margin
        usable = jnp.isfinite(margin)
        return jnp.where(usable, margin, 0).sum(), (jnp.where(usable, margin, -jnp.inf), contacts.frames[..., 2])

    slope, (margin, outward) = jax.grad(total, has_aux=True)(state.points)
    kept = task.placing.shortfall(state.points, outward) <= TOLERANCE * task.size
    better = kept & (margin > state.best_margin)
    state = replace(
        state,
        best_points=jnp.where(better[:, None, None], state.points, state.best_points),
        best_margin=jnp.where(better, margin, state.best_margin),
    )
    # Optax raises floats to integer powers, which users of strict promotion have forbidden.
    with jax.numpy_dtype_promotion("standard"):
        direction, momentum = jax.vmap(_ADAM.update)(slope, state.momentum)
    # Optax's updates are any tree; Adam's have the form of the slope.
    direction = cast(Array, direction)
    length = task.size * (_LAST_STEP + _FIRST_STEP * 0.5 * (1 + jnp.cos(jnp.pi * done)))
    move = length * direction
    move = move - outward * jnp.sum(move * outward, -1, keepdims=True)
    points = task.placing.corrected(state.points + move, outward)

    due = (number == jnp.round(jnp.asarray(_RESTARTS, dtype) * task.steps).astype(number.dtype)).any()
    again = due & ~(state.best_margin >= _HOPELESS * jnp.median(state.best_margin))
    pool = jax.random.permutation(key, state.starts.reshape(-1, 3)).reshape(state.starts.shape)

    def renewed(fresh: Array, old: Array) -> Array:
        return jnp.where(again.reshape(-1, *[1] * (old.ndim - 1)), fresh, old)

    return replace(
        state,
        points=renewed(pool, points),
        momentum=jax.tree.map(lambda old: renewed(jnp.zeros_like(old), old), momentum),
        restarts=state.restarts + again.astype(jnp.int32),
    )


@functools.partial(compiled, static_argnums=(2, 3))
def evaluate(points: Float[Array, "starts contacts 3"], task: Task, cone_edges: int, mesh: Mesh) -> tuple[Array, ...]:
    """Of grasps: margin, upper bound, status, positions about the centre of mass, normals, forces and shortfall."""

    def on_one_device(points: Array, task: Task) -> tuple[Array, ...]:
        contacts = task.contacts(points)
        solution = largest_disturbance(contacts, task.disturbances, cone_edges=cone_edges)
        outward = contacts.frames[..., 2]
        forces = solution.forces_in_object_frame(contacts)
        shortfall = task.placing.shortfall(points, outward)
        return solution.margin, solution.upper_bound, solution.status, contacts.positions, outward, forces, shortfall

    spread = jax.shard_map(
        on_one_device, mesh=mesh, in_specs=(P("starts"), P()), out_specs=P("starts"), check_vma=False
    )
    return spread(points, task)
