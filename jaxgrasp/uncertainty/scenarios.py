"""Tightening forces of least effort that hold with a probability, found with draws and tested on others.

Errors of contacts change G itself, so that no support function has their worst case. In a draw f = f_0 + G* (b - G f_0)
is what blocking forces make of f_0, and its rows are rows of f_0. f_0 has 3 n_c components, so at most as many draws
decide: what holds in all of 3 n_c / (1 - p) draws holds in the mean with probability p or more (the scenario theorem of
Calafiore and Campi). Most rows of most draws follow from others: those that are violated most are added, a few times.
"""

import math
from dataclasses import dataclass, replace
from functools import partial

import jax
import jax.numpy as jnp
from jax.typing import ArrayLike
from jaxtyping import Array, Float, Int

from jaxgrasp.arrays import as_float, literal
from jaxgrasp.compiling import compiled
from jaxgrasp.contact.contacts import Contacts
from jaxgrasp.contact.friction import pyramid_facets
from jaxgrasp.contact.grasp_map import grasp_map
from jaxgrasp.disturbance import DisturbanceSet
from jaxgrasp.lanes.independent import with_automatic_axes
from jaxgrasp.records import record
from jaxgrasp.robustness import least_effort, weighted_pseudo_inverse, worst_case
from jaxgrasp.solvers import solve_qp
from jaxgrasp.solvers.status import Status
from jaxgrasp.uncertainty.distribution import margin_distribution
from jaxgrasp.uncertainty.draws import Draws, apply, draw
from jaxgrasp.uncertainty.spec import Uncertainty
from jaxgrasp.uncertainty.statistics import Estimate

# How often rows are added to the program, and how far one may be violated, in units of the largest force.
_ROUNDS = 6
_ACCEPTED = {"float64": 1e-7, "float32": 1e-4}
# Draws that are looked at together.
_TILE = 16


@record
class ScenarioForces:
    """Forces that hold in draws, and how often they do in others."""

    forces: Float[Array, "*batch contacts 3"]
    """f_0 in contact frames of the grasp as it is known, N; NaN where there are none."""
    effort: Float[Array, "*batch"]
    """1/2 f_0'f_0, N^2."""
    known_effort: Float[Array, "*batch"]
    """The effort of (22) for the grasp as it is known."""
    p_hold: Estimate
    """(*batch,), the probability that they hold, from draws that were not used to find them."""
    status: Int[Array, "*batch"]
    """SOLVED; INFEASIBLE where no forces hold in all draws; MAX_ITERATIONS where some are still violated a little; that
    of (22) where it has no answer."""


def scenario_effort(
    contacts: Contacts,
    disturbances: DisturbanceSet,
    margin: ArrayLike,
    uncertainty: Uncertainty,
    probability: float = 0.95,
    required_wrench: ArrayLike | None = None,
    cone_edges: int = 8,
    *,
    samples: int = 1000,
    seed: int = 0,
) -> ScenarioForces:
    """The forces of least effort that hold with a probability, from draws of the grasps; tested on others.

    Args:
        contacts: the grasps, hard contacts.
        disturbances: the set D.
        margin: lambda (*batch,), >= 0.
        uncertainty: what is not known; distributions, not samples.
        probability: p in (0, 1): forces hold in all of 3 n_c / (1 - p) draws.
        required_wrench: b (*batch, 6), N and N m; None is zero.
        cone_edges: n_e.
        samples: how many other draws `p_hold` is found with.
        seed: of the draws that are used; the others have the next one.

    Returns:
        ScenarioForces with `*batch` axes.

    Raises:
        ValueError: shapes or options that do not fit.
    """
    if not 0 < probability < 1:
        raise ValueError(f"probability: got {probability}, wanted a number in (0, 1)")
    if uncertainty.sample_count() is not None:
        raise ValueError("uncertainty: got samples, wanted distributions, of which other draws can be made")
    if contacts.torsional_friction is not None:
        raise ValueError("contacts: got soft contacts, wanted hard ones")
    known = least_effort(contacts, disturbances, margin, required_wrench, cone_edges=cone_edges)
    scale = jnp.broadcast_to(as_float("margin", margin, ()).astype(known.effort.dtype), known.effort.shape)
    count = math.ceil(3 * contacts.n_c / (1 - probability))
    question = _Scenarios(cone_edges, -(-count // _TILE) * _TILE)
    wrench = None if required_wrench is None else as_float("required_wrench", required_wrench, (6,))
    forces, effort, status = _tighten(
        question, contacts, disturbances, wrench, scale, known.forces, known.status, uncertainty, jnp.asarray(seed)
    )
    tested = margin_distribution(
        contacts, disturbances, uncertainty, wrench, cone_edges=cone_edges, forces=forces, margin=scale,
        samples=samples, seed=seed + 1,
    )  # fmt: skip
    return ScenarioForces(forces=forces, effort=effort, known_effort=known.effort, p_hold=tested.p_hold, status=status)


@dataclass(frozen=True)
class _Scenarios:
    """What changes the program."""

    cone_edges: int
    count: int


@partial(compiled, static_argnums=(0,), pace=lambda *_: "brief")
def _tighten(
    question: _Scenarios,
    contacts: Contacts,
    disturbances: DisturbanceSet,
    wrench: jax.Array | None,
    margin: jax.Array,
    start: jax.Array,
    known: jax.Array,
    uncertainty: Uncertainty,
    seed: jax.Array,
) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Forces, effort and status of the least effort that holds in all draws."""
    batch, n, dtype = margin.shape, contacts.n_c, margin.dtype
    draws = draw(uncertainty, n, question.count, seed, dtype)
    # The grasp as it is known is one of them.
    draws = jax.tree.map(lambda x: x.at[0].set(0).reshape(-1, _TILE, *x.shape[1:]), draws)
    lanes = math.prod(batch)
    flat = lambda tree: jax.tree.map(lambda x: x.reshape(lanes, 1, *x.shape[len(batch) :]), tree)
    spread = jax.tree.map(lambda x: jnp.broadcast_to(x, (*batch, *x.shape[len(contacts.batch_shape) :])), contacts)
    if disturbances.batch_shape:
        disturbances = flat(disturbances.spread_over(batch))
    load = jnp.zeros(6, dtype) if wrench is None else wrench.astype(dtype)
    grasps = _Known(flat(spread), disturbances, flat(jnp.broadcast_to(load, (*batch, 6))), flat(margin))
    own = jax.tree.map(lambda _: False, grasps)
    own = replace(own, disturbances=jax.tree.map(lambda _: not disturbances.batch_shape, disturbances))
    arguments = (grasps, start.reshape(lanes, 3 * n), known.reshape(lanes), draws)
    shared = jax.tree.leaves((own, False, False, jax.tree.map(lambda _: True, draws)))
    leaves, structure = jax.tree.flatten(arguments)
    tightened = lambda *leaves: _tighten_lanes(question, *jax.tree.unflatten(structure, leaves))
    forces, effort, status = with_automatic_axes(tightened, leaves, shared)
    return forces.reshape(*batch, n, 3), effort.reshape(batch), status.reshape(batch)


def _tighten_lanes(
    question: _Scenarios, grasps: "_Known", start: jax.Array, known: jax.Array, draws: Draws
) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Do the same for grasps (lanes,) and draws (tiles, draws)."""
    (lanes, size), n, dtype = start.shape, start.shape[1] // 3, start.dtype
    count = n * (question.cone_edges + 1)
    # Of the type of the forces, also where these vary over devices.
    filled = lambda value, *shape: jnp.full_like(start[:, :1], value, shape=(lanes, *shape))

    def worst(forces: jax.Array) -> _Rows:
        """The rows of the draws that are violated most by forces (lanes, 3 n), one of each kind."""

        def look(best: _Rows, some: Draws) -> tuple[_Rows, None]:
            rows, sides = _rows_in(question, grasps, some)
            over = (rows @ forces[:, None, :, None])[..., 0] - sides
            which = jnp.argmax(over, 1)[:, None]
            pick = lambda x: jnp.take_along_axis(x, which.reshape(*which.shape, *[1] * (x.ndim - 3)), 1)[:, 0]
            found = _Rows(pick(rows), pick(sides), pick(over))
            more = found.over > best.over
            chosen = lambda a, b: jnp.where(more.reshape(*more.shape, *[1] * (a.ndim - 2)), a, b)
            return jax.tree.map(chosen, found, best), None

        none = _Rows(filled(0, count, size), filled(1, count), filled(-jnp.inf, count))
        return jax.lax.scan(look, none, draws)[0]

    G = grasp_map(grasps.contacts)[:, 0]

    def tighten(state: tuple, turn: jax.Array) -> tuple[tuple, None]:
        rows, sides, forces, infeasible = state
        found = worst(forces)
        rows = jax.lax.dynamic_update_slice_in_dim(rows, found.rows, turn * count, 1)
        sides = jax.lax.dynamic_update_slice_in_dim(sides, found.sides, turn * count, 1)
        solved = solve_qp(jnp.eye(3 * n, dtype=dtype), jnp.zeros(3 * n, dtype), G, grasps.wrench[:, 0], rows, sides)
        infeasible |= solved.status == Status.INFEASIBLE
        better = (solved.status == Status.SOLVED)[:, None]
        return (rows, sides, jnp.where(better, solved.x, forces), infeasible), None

    rows, sides = filled(0, _ROUNDS * count, size), filled(1, _ROUNDS * count)
    state = (rows, sides, jnp.nan_to_num(start), filled(0).astype(bool))
    (_, _, forces, infeasible), _ = jax.lax.scan(tighten, state, jnp.arange(_ROUNDS))
    violated = worst(forces).over.max(-1) > _ACCEPTED[dtype.name] * jnp.max(grasps.contacts.max_force, (1, 2))
    status = jnp.where(violated, Status.MAX_ITERATIONS, Status.SOLVED)
    status = jnp.where(infeasible, Status.INFEASIBLE, status)
    status = jnp.where(known != Status.SOLVED, known, status).astype(jnp.int32)
    answered = (status == Status.SOLVED) | (status == Status.MAX_ITERATIONS)
    forces = jnp.where(answered[:, None], forces, jnp.nan)
    return forces, 0.5 * (forces**2).sum(-1), status


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class _Known:
    """The grasps as they are known, with axes (lanes, 1)."""

    contacts: Contacts
    disturbances: DisturbanceSet
    wrench: jax.Array
    margin: jax.Array


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class _Rows:
    """Rows a'f_0 <= h, (lanes, rows), and by how much forces violate them, N."""

    rows: jax.Array
    sides: jax.Array
    over: jax.Array


def _rows_in(question: _Scenarios, grasps: _Known, draws: Draws) -> tuple[jax.Array, jax.Array]:
    """The rows of draws (draws,) as rows of f_0: (lanes, draws, rows, 3 n), and their sides."""
    drawn = apply(grasps.contacts, grasps.wrench, draws)
    contacts, wrench = drawn.contacts, drawn.required_wrench
    assert wrench is not None
    batch, n = contacts.batch_shape, contacts.n_c
    inverse = weighted_pseudo_inverse(contacts)
    cone_loss, bound_loss = worst_case(contacts, grasps.disturbances, cone_edges=question.cone_edges)
    frames = jnp.broadcast_to(grasps.contacts.frames, contacts.frames.shape)
    # f = T f_0 + G* (b - G T f_0), with T from the known contact frames to the drawn ones.
    pushed = Contacts.from_frames(
        contacts.positions, frames, friction=contacts.friction, max_force=contacts.max_force, active=contacts.active
    )
    turned = jnp.einsum("...nji,...njk->...nik", contacts.frames, frames)
    turned = jnp.einsum("...nik,nm->...nimk", turned, jnp.eye(n, dtype=turned.dtype)).reshape(*batch, n, 3, 3 * n)
    kept = turned - (inverse @ grasp_map(pushed)).reshape(turned.shape)
    answers = (inverse * wrench[..., None, :]).sum(-1).reshape(*batch, n, 3)
    c, s, k = literal(pyramid_facets(question.cone_edges).T, turned.dtype)
    friction = contacts.friction[..., None]
    normal = k * friction
    facets = jnp.stack([jnp.broadcast_to(c, normal.shape), jnp.broadcast_to(s, normal.shape), normal], -1)
    margin = grasps.margin[..., None]
    cone = jnp.einsum("...nei,...niv->...nev", facets, kept)
    cone_sides = cone_loss * margin[..., None] - jnp.einsum("...nei,...ni->...ne", facets, answers)
    bound_sides = contacts.max_force + answers[..., 2] - bound_loss * margin
    rows = jnp.concatenate([cone, -kept[..., 2:, :]], -2)
    sides = jnp.concatenate([cone_sides, bound_sides[..., None]], -1)
    there = contacts.active[..., None]
    rows, sides = jnp.where(there[..., None], rows, 0), jnp.where(there, sides, 1)
    return rows.reshape(*batch, -1, 3 * n), sides.reshape(*batch, -1)
