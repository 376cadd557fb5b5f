"""Grasp synthesis: from a shape to many grasps of large robustness margin."""

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh, NamedSharding, PartitionSpec
from jax.typing import ArrayLike
from jaxtyping import Array, Float, Int, PRNGKeyArray

from jaxgrasp.arrays import as_float
from jaxgrasp.disturbance import DisturbanceSet
from jaxgrasp.geometry import Shape, centroid, project, sample_surface
from jaxgrasp.synthesis.ascent import CHUNK, MOST_EDGES, TOLERANCE, State, Task, advance, evaluate
from jaxgrasp.synthesis.placing import Placing

T = TypeVar("T")


@dataclass(frozen=True, kw_only=True)
class Record:
    """How the ascent went, by steps."""

    lowest_tenth: Float[np.ndarray, " steps"]
    """The best margin so far below which a tenth of the starts are; -inf where these have none yet."""
    median: Float[np.ndarray, " steps"]
    """The median of the starts' best margins so far."""
    best: Float[np.ndarray, " steps"]
    """The best of all."""
    positive: Float[np.ndarray, " steps"]
    """The share of the starts that have had a positive margin."""


@dataclass(frozen=True, kw_only=True)
class Synthesis:
    """Grasps of one object, one a start, in NumPy; those that keep spacing and span first, by falling margin."""

    positions: Float[np.ndarray, "starts contacts 3"]
    """Contact positions about the centre of mass, m."""
    outward_normals: Float[np.ndarray, "starts contacts 3"]
    """Outward unit normals of the surface there."""
    margin: Float[np.ndarray, " starts"]
    """lambda of (21) without reserve and with the edges asked for; a certified lower bound."""
    upper_bound: Float[np.ndarray, " starts"]
    """A certified upper bound of it."""
    status: Int[np.ndarray, " starts"]
    """`Status` of (21)."""
    forces: Float[np.ndarray, "starts contacts 3"]
    """Tightening forces that attain the margin, object frame, N; NaN where there are none."""
    shortfall: Float[np.ndarray, " starts"]
    """By how much the worst pair of contacts misses spacing or span, m."""
    first_margin: Float[np.ndarray, " starts"]
    """The margin where the start began."""
    restarts: Int[np.ndarray, " starts"]
    """How often it began anew."""
    center_of_mass: Float[np.ndarray, "3"]
    """In the frame of the shape, m: add it to the positions to come back to it."""
    record: Record
    """How the ascent went."""
    interrupted: bool
    """Whether Ctrl-C ended the ascent early."""


def synthesize(
    shape: Shape,
    n_contacts: int,
    key: PRNGKeyArray,
    *,
    disturbances: DisturbanceSet,
    friction: float,
    max_force: float,
    starts: int = 1024,
    steps: int = 200,
    spacing: float = 0.0,
    span: float = math.inf,
    center_of_mass: ArrayLike | None = None,
    cone_edges: int = 8,
    progress: Callable[[int, Record], None] | None = None,
) -> Synthesis:
    """Moves contacts over a surface so that the robustness margin (21) grows, from many random starts at once.

    Each step follows the margin's gradient with respect to positions and normals (the normals turn with the surface)
    along the tangent plane, by Adam, and comes back to the surface. Pairs that are too near or too far apart are moved
    there and then. Starts that lead nowhere begin anew, and of each start the best is kept. The ascent is in single
    precision; its results are then evaluated in the precision that JAX is set to. Work is spread over the process's
    devices.

    Args:
        shape: the object.
        n_contacts: contacts of each grasp.
        key: key of the random numbers: the same key, the same grasps on the same number of devices.
        disturbances: the set D, without batch axes, about the centre of mass.
        friction: Coulomb's coefficient of all contacts.
        max_force: largest normal force of all contacts, N.
        starts: how many.
        steps: how many; rounded up to a multiple of ten.
        spacing: least distance of contacts that are on the same side of the object (their normals less than 90 degrees
            apart), m.
        span: largest distance of any two contacts, m.
        center_of_mass: (3,), m, in the shape's frame; None is the centre of its volume.
        cone_edges: edges of the friction pyramid by which the results are judged.
        progress: called with the number of steps done and the record so far.

    Returns:
        A grasp for each start, the best first. Ctrl-C ends the ascent early: after the first steps, what there is
        is evaluated and returned.

    Raises:
        ValueError: numbers out of range, with the argument's name.
    """
    checks = (
        ("n_contacts", n_contacts, n_contacts >= 2, "at least 2"),
        ("starts", starts, starts >= 1, "at least 1"),
        ("steps", steps, steps >= 1, "at least 1"),
        ("friction", friction, 0 < friction < math.inf, "a positive number"),
        ("max_force", max_force, 0 < max_force < math.inf, "a positive number, N"),
        ("spacing", spacing, 0 <= spacing < math.inf, "a number >= 0, m"),
        ("span", span, span > spacing, "a length above spacing, m"),
        ("cone_edges", cone_edges, cone_edges >= 3, "at least 3"),
        ("disturbances", disturbances.batch_shape, disturbances.batch_shape == (), "a set without batch axes"),
    )
    for name, got, admissible, wanted in checks:
        if not admissible:
            raise ValueError(f"{name}: got {got}, wanted {wanted}")
    centre = centroid(shape) if center_of_mass is None else as_float("center_of_mass", center_of_mass, (3,))
    lower, upper = shape.bounds
    size = 0.5 * jnp.linalg.norm(upper - lower)
    slack = TOLERANCE * size
    exact = Task(
        placing=Placing(shape=shape, spacing=jnp.asarray(spacing, float), span=jnp.asarray(span, float), slack=slack),
        disturbances=disturbances,
        friction=jnp.asarray(friction, float),
        max_force=jnp.asarray(max_force, float),
        center_of_mass=centre,
        size=size,
        steps=jnp.asarray(steps, float),
    )
    exact = _in(jnp.result_type(float), exact)
    mesh = Mesh(np.array(jax.local_devices()), ("starts",))
    lanes = math.ceil(starts / mesh.size) * mesh.size
    sampling, restarting = jax.random.split(key)
    # Placed as the programs leave them: JAX would compile anew for arrays that lie elsewhere.
    spread, shared = NamedSharding(mesh, PartitionSpec("starts")), NamedSharding(mesh, PartitionSpec())
    begin = sample_surface(exact.placing.shape, sampling, lanes * n_contacts).reshape(lanes, n_contacts, 3)
    begin, exact = jax.device_put(begin, spread), jax.device_put(exact, shared)
    state, record = _ascend(
        _in(jnp.float32, begin), _in(jnp.float32, exact), steps, restarting, cone_edges, mesh, progress
    )

    found = jnp.where(jnp.isfinite(state.best_margin)[:, None, None], state.best_points, state.points)
    # Single precision leaves the points off the surface by its rounding.
    found = jax.device_put(project(exact.placing.shape, found.astype(begin.dtype)), spread)
    first, *_ = evaluate(begin, exact, cone_edges, mesh)
    answers = map(np.asarray, evaluate(found, exact, cone_edges, mesh))
    margin, upper_bound, status, positions, outward, forces, shortfall = answers
    kept = shortfall <= 2 * TOLERANCE * float(exact.size)
    order = np.lexsort((-np.nan_to_num(margin, nan=-np.inf), ~kept))[:starts]
    return Synthesis(
        positions=positions[order],
        outward_normals=outward[order],
        margin=margin[order],
        upper_bound=upper_bound[order],
        status=status[order],
        forces=forces[order],
        shortfall=shortfall[order],
        first_margin=np.asarray(first)[order],
        restarts=np.asarray(state.restarts)[order],
        center_of_mass=np.asarray(centre),
        record=record,
        interrupted=len(record.median) < steps,
    )


def _ascend(
    begin: Array,
    task: Task,
    steps: int,
    key: PRNGKeyArray,
    cone_edges: int,
    mesh: Mesh,
    progress: Callable[[int, Record], None] | None,
) -> tuple[State, Record]:
    state, rows = jax.device_put(State.from_starts(begin), begin.sharding), []
    try:
        for first in range(0, steps, CHUNK):
            state, margins = advance(state, task, jnp.asarray(first), key, min(cone_edges, MOST_EDGES), mesh)
            rows.append(_quantiles(np.sort(np.asarray(margins), axis=1)))
            if progress is not None:
                progress(min(first + CHUNK, steps), _record(rows))
    except KeyboardInterrupt:
        if not rows:
            raise
    return state, _record(rows)


def _quantiles(margins: np.ndarray) -> np.ndarray:
    """What `Record` has of sorted margins, a row a step."""
    count = margins.shape[1]
    return np.stack([margins[:, count // 10], margins[:, count // 2], margins[:, -1], (margins > 1e-4).mean(1)], axis=1)


def _record(rows: list[np.ndarray]) -> Record:
    return Record(**dict(zip(("lowest_tenth", "median", "best", "positive"), np.concatenate(rows).T, strict=True)))


def _in(dtype: jnp.dtype, tree: T) -> T:
    return jax.tree.map(lambda leaf: leaf.astype(dtype), tree)
