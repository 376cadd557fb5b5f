"""The distribution of the margin (21), and of whether given forces hold, where grasps are not known exactly."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial

import jax
import jax.numpy as jnp
from jax.scipy.special import ndtr, ndtri
from jax.typing import ArrayLike
from jaxtyping import Array, Bool, Float, Int

from jaxgrasp.arrays import as_float
from jaxgrasp.compiling import compiled
from jaxgrasp.contact.actuation import Actuation
from jaxgrasp.contact.compliance import Compliance
from jaxgrasp.contact.contacts import Contacts
from jaxgrasp.disturbance import DisturbanceSet
from jaxgrasp.lanes.independent import with_automatic_axes
from jaxgrasp.records import record
from jaxgrasp.robustness import largest_disturbance
from jaxgrasp.robustness.interface.arguments import GraspData, Options, lay_out
from jaxgrasp.solvers.status import Status
from jaxgrasp.uncertainty.draws import Draws, apply, draw, turn_jacobian
from jaxgrasp.uncertainty.holding import slack_of
from jaxgrasp.uncertainty.layout import Grasps, divided, lanes_of
from jaxgrasp.uncertainty.spec import Uncertainty
from jaxgrasp.uncertainty.statistics import Estimate, mean_of, probability_of, quantile_of, tail_mean_of

DEFAULT_SAMPLES = 1000
# Margins that are solved at once, and kept at once, but for one grasp with more samples than that.
_SOLVED, _KEPT = 1 << 13, 1 << 22
# An estimate of first order is good where it is as near to the samples' as this share of the standard deviation.
_NEAR = 0.1
# What the margin that holds may be above a bound by rounding, as a share.
_ROUNDING = 1e-6


@record
class FirstOrder:
    """The distribution of the margin if it varied linearly and normally, from its exact gradient."""

    mean: Float[Array, "*batch"]
    """The margin at the mean deviations; NaN where it is not finite."""
    std: Float[Array, "*batch"]
    """The root of g'Vg, with the gradient g there and the covariance V of the draws."""
    quantiles: Float[Array, "*batch levels"]
    """Quantiles of the normal distribution with that mean and that standard deviation."""
    at_least: Float[Array, "*batch thresholds"]
    """P(margin >= x) of the same."""
    good: Bool[Array, "*batch"]
    """Whether mean and quantiles are within the samples' 95 % intervals, or a tenth of the standard deviation off."""


@record
class MarginDistribution:
    """What samples say of the margins of a batch of grasps.

    A draw without an answer, or whose load cannot be borne by any forces and no number says by how much, counts as a
    margin of -inf. Negative margins are kept as they are; their size is no measure, see `largest_disturbance`.
    """

    mean: Estimate
    """(*batch,), the mean of the margin."""
    quantiles: Estimate
    """(*batch, levels), quantiles of the margin."""
    at_least: Estimate
    """(*batch, thresholds), P(margin >= x)."""
    tail_mean: Estimate
    """(*batch,), the conditional value at risk: the mean margin of the worst `tail` of the draws."""
    p_hold: Estimate
    """(*batch,), P(the forces hold); without given forces, P(some forces hold)."""
    first_order: FirstOrder
    """An estimate from the exact gradient, with a flag where it is not good."""
    clipped: Float[Array, "*batch"]
    """The share of draws in which a value would have left what is admissible, and was moved back."""
    unanswered: Int[Array, "*batch"]
    """The number of draws without an answer."""
    status: Int[Array, "*batch"]
    """SOLVED; INVALID_INPUT; INFEASIBLE or UNBOUNDED where all draws are; else the largest status of draws without an
    answer."""


def margin_distribution(
    contacts: Contacts,
    disturbances: DisturbanceSet,
    uncertainty: Uncertainty,
    required_wrench: ArrayLike | None = None,
    compliance: ArrayLike | Compliance | None = None,
    cone_edges: int = 8,
    cone_margin: ArrayLike = 0.0,
    actuation: Actuation | None = None,
    *,
    quantiles: Sequence[float] = (0.1, 0.5, 0.9),
    at_least: ArrayLike | Sequence[float] = (1.0,),
    tail: float = 0.1,
    forces: ArrayLike | None = None,
    margin: ArrayLike = 1.0,
    samples: int | None = None,
    seed: int = 0,
) -> MarginDistribution:
    """The distribution of the margin (21), and of whether given forces hold, where grasps are not known exactly.

    Every grasp is solved with the same draws. Memory grows with the draws themselves, 8 (7 n_c + 10) bytes a sample at
    most, and not with samples times grasps, but inside `jax.vmap`; a batch costs what as many margins cost.

    Args:
        contacts: the grasps as far as they are known; their dtype is the precision.
        disturbances: the set D, at the drawn centre of mass; without batch axes it is shared by all grasps.
        uncertainty: what is not known, and how it is distributed.
        required_wrench: b (*batch, 6), N and N m, about the drawn centre of mass; None is zero.
        compliance: Q, as in `largest_disturbance`, in drawn contact frames.
        cone_edges: n_e.
        cone_margin: d, N, as in `largest_disturbance`.
        actuation: what the hand can do, as in `largest_disturbance`; J stays that of the grasp as it is known.
        quantiles: levels of the quantiles, in (0, 1).
        at_least: x (thresholds,) of P(margin >= x), in units of the margin.
        tail: the share of draws, in (0, 1], whose mean margin is `tail_mean`.
        forces: f_0 (*batch, n_c, 3), N, in the contact frames of the grasp as it is known. They keep their directions
            in the object frame; blocking forces (15) supply what they leave of the load, and they hold where all rows
            do with the disturbances scaled by `margin`. For hard contacts without actuation.
        margin: (*batch,), the scale of the disturbances in `p_hold`.
        samples: how many draws; None is 1,000, or as many as are given.
        seed: of the draws; the same seed gives the same draws, the first of which are the same for any number of them.

    Returns:
        MarginDistribution with `*batch` axes.

    Raises:
        ValueError: shapes or options that do not fit; at trace time.

    Status:
        See `MarginDistribution.status`. A grasp or draw that cannot be used costs no other anything.

    Derivatives:
        First ones of `value` of all estimates, with respect to all that is continuous, the spreads and means of the
        distributions included, see `jaxgrasp.uncertainty.statistics`. Errors, intervals and `first_order` count as
        constants. The backward pass solves every margin two more times, in place of keeping them.

    Example:
        >>> spec = jg.Uncertainty.of(friction=0.1, position=0.002, normal=0.17, center_of_mass=0.005)
        >>> found = jg.margin_distribution(grasp, pushes, spec)
        >>> found.at_least.value, found.quantiles.low, found.status  # doctest: +SKIP
    """
    if not isinstance(uncertainty, Uncertainty):
        raise ValueError(f"uncertainty: got {type(uncertainty).__name__}, wanted jaxgrasp.Uncertainty")
    data = GraspData.from_arguments(
        contacts, disturbances, required_wrench, compliance, cone_margin, actuation, cone_edges
    )
    given = uncertainty.sample_count()
    count = given if samples is None else samples
    count = DEFAULT_SAMPLES if count is None else count
    if count < 1 or given not in (None, count):
        wanted = "at least 1" if given is None else f"{given}, as many as the uncertainty has, or None"
        raise ValueError(f"samples: got {count}, wanted {wanted}")
    for name, level in [("quantiles", level) for level in quantiles] + [("tail", tail)]:
        if not (0 < level < 1 or (name == "tail" and level == 1)):
            raise ValueError(f"{name}: got {level}, wanted a number in (0, 1{']' if name == 'tail' else ')'}")
    thresholds = as_float("at_least", at_least, ("thresholds",))
    if thresholds.ndim != 1:
        raise ValueError(f"at_least: got shape {thresholds.shape}, wanted (thresholds,)")
    if forces is not None:
        forces = as_float("forces", forces, (contacts.n_c, 3))
        if actuation is not None or contacts.torsional_friction is not None or isinstance(compliance, Compliance):
            what = "an actuation" if actuation is not None else "soft contacts"
            what = "one Q for each direction" if isinstance(compliance, Compliance) else what
            raise ValueError(f"forces: got {what}, too, wanted hard contacts alone, with a single Q")
    question = _Question(cone_edges, tuple(quantiles), tail, count)
    options = Options(margin=as_float("margin", margin, ()))
    return _run(question, data, options, forces, uncertainty, thresholds, jnp.asarray(seed))


@dataclass(frozen=True)
class _Question:
    """What changes the program."""

    cone_edges: int
    levels: tuple[float, ...]
    tail: float
    count: int


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class _Solved:
    """What was found of draws, (lanes, samples)."""

    margin: jax.Array
    """-inf where nothing holds, or there is no answer."""
    status: jax.Array
    clipped: jax.Array
    slack: jax.Array
    """The least slack with the given forces, N; -inf where none hold."""


@partial(compiled, static_argnums=(0,), pace=lambda *_: "brief")
def _run(
    question: _Question,
    data: GraspData,
    options: Options,
    forces: jax.Array | None,
    uncertainty: Uncertainty,
    thresholds: jax.Array,
    seed: jax.Array,
) -> MarginDistribution:
    dtype = data.contacts.positions.dtype
    draws = draw(uncertainty, data.contacts.n_c, question.count, seed, dtype)
    batch = lay_out(data, options).batch
    grasps, own = lanes_of(data, options, forces, batch)
    leaves, structure = jax.tree.flatten((grasps, draws, thresholds.astype(dtype)))
    own = jax.tree.leaves(own)
    shared = [not has_lanes for has_lanes in own] + [True] * (len(leaves) - len(own))
    # Few grasps at a time, so that their margins can be kept.
    count = math.prod(batch)
    chunks = max(1, -(-count // max(1, min(_SOLVED, _KEPT // question.count))))
    size = max(1, -(-count // chunks))

    def all_lanes(*leaves: jax.Array) -> MarginDistribution:
        @jax.checkpoint
        def one(some: list[jax.Array]) -> MarginDistribution:
            rest = iter(some)
            parts = [x if is_shared else next(rest) for x, is_shared in zip(leaves, shared, strict=True)]
            return _of_some(question, *jax.tree.unflatten(structure, parts))

        some = [divided(x, chunks, size) for x, is_shared in zip(leaves, shared, strict=True) if not is_shared]
        found = jax.lax.map(one, some)
        return jax.tree.map(lambda x: x.reshape(-1, *x.shape[2:])[:count], found)

    found = with_automatic_axes(all_lanes, leaves, shared)
    return jax.tree.map(lambda x: x.reshape(*batch, *x.shape[1:]), found)


def _of_some(question: _Question, grasps: Grasps, draws: Draws, thresholds: jax.Array) -> MarginDistribution:
    """The distributions of some grasps (lanes,)."""
    lanes, count = len(grasps.margin), question.count
    # Few samples at a time, so that solving them fits a cache.
    steps = -(-count // max(1, _SOLVED // lanes))
    size = -(-count // steps)

    @jax.checkpoint
    def solve(_: None, some: Draws) -> tuple[None, _Solved]:
        return None, _solve(question, grasps, some)

    _, found = jax.lax.scan(solve, None, jax.tree.map(lambda x: divided(x, steps, size), draws), length=steps)
    solved = jax.tree.map(lambda x: jnp.moveaxis(x, 0, 1).reshape(lanes, -1)[:, :count], found)

    margins, scale = solved.margin, grasps.margin[:, 0]
    ranked = jnp.sort(jax.lax.stop_gradient(margins), -1)
    beside = lambda estimates: jax.tree.map(lambda *parts: jnp.stack(parts, -1), *estimates)
    mean = mean_of(margins)
    quantiles = beside([quantile_of(margins, ranked, level) for level in question.levels])
    hold = (margins, scale) if grasps.forces is None else (solved.slack, jnp.zeros_like(scale))
    still = jax.lax.stop_gradient((grasps, draws, thresholds, mean, quantiles))
    distribution = MarginDistribution(
        mean=mean,
        quantiles=quantiles,
        at_least=beside([probability_of(margins, jnp.broadcast_to(x, lanes)) for x in thresholds]),
        tail_mean=tail_mean_of(margins, ranked, question.tail),
        p_hold=probability_of(*hold),
        first_order=_first_order(question, *still),
        clipped=solved.clipped.mean(-1),
        unanswered=_unanswered(solved.status).sum(-1).astype(jnp.int32),
        status=_status_of(solved.status),
    )
    # A grasp that is not admissible has no distribution.
    invalid = distribution.status == Status.INVALID_INPUT

    def hide(x: jax.Array) -> jax.Array:
        floats = jnp.issubdtype(x.dtype, jnp.floating)
        return jnp.where(invalid.reshape(-1, *[1] * (x.ndim - 1)), jnp.nan, x) if floats else x

    return jax.tree.map(hide, distribution)


def _solve(question: _Question, grasps: Grasps, draws: Draws) -> _Solved:
    """Solve (21) for grasps (lanes, 1) with draws (samples,)."""
    data = grasps.data
    drawn = apply(data.contacts, data.required_wrench, draws)
    actuation = data.actuation
    if actuation is not None and "normal" in draws:
        actuation = replace(actuation, jacobian=turn_jacobian(actuation.jacobian, draws["normal"]))
    found = largest_disturbance(
        drawn.contacts,
        data.disturbances,
        drawn.required_wrench,
        data.compliance,
        question.cone_edges,
        0.0 if data.cone_margin is None else data.cone_margin,
        actuation=actuation,
    )
    # Where even the load cannot be borne, how much is missing is told by the upper bound, if by anything.
    missing = (found.status == Status.INFEASIBLE) & jnp.isnan(found.margin)
    margin = jnp.where(missing, jnp.minimum(found.upper_bound, 0), found.margin)
    margin = jnp.where(jnp.isnan(margin), -jnp.inf, margin)
    slack = jnp.zeros_like(margin)
    if grasps.forces is not None:
        assert not isinstance(data.compliance, Compliance)
        slack = slack_of(
            drawn.contacts,
            data.disturbances,
            drawn.required_wrench,
            data.compliance,
            jnp.zeros((1, 1)) if data.cone_margin is None else jnp.atleast_2d(data.cone_margin),
            question.cone_edges,
            (data.contacts.frames * grasps.forces[..., None, :]).sum(-1),
            grasps.margin,
        )
        # Disturbances, or a load, that these contacts cannot reach.
        slack = jnp.where(found.upper_bound >= grasps.margin * (1 - _ROUNDING), slack, -jnp.inf)
    return _Solved(margin, found.status, jnp.broadcast_to(drawn.clipped, margin.shape), slack)


def _unanswered(status: jax.Array) -> jax.Array:
    answers = (Status.SOLVED, Status.INFEASIBLE, Status.UNBOUNDED)
    return ~jnp.isin(status, jnp.array(answers, status.dtype))


def _status_of(status: jax.Array) -> jax.Array:
    """The status of distributions, of those of their draws (lanes, samples)."""
    worst = jnp.where(_unanswered(status), status, Status.SOLVED).max(-1)
    for every in (Status.INFEASIBLE, Status.UNBOUNDED):
        worst = jnp.where((status == every).all(-1), every, worst)
    return jnp.where((status == Status.INVALID_INPUT).any(-1), Status.INVALID_INPUT, worst).astype(jnp.int32)


def _first_order(
    question: _Question, grasps: Grasps, draws: Draws, thresholds: jax.Array, mean: Estimate, quantiles: Estimate
) -> FirstOrder:
    """The estimate from the margins' gradients at the mean of the draws."""
    lanes = len(grasps.margin)
    middle = jax.tree.map(lambda x: jnp.broadcast_to(x.mean(0), (lanes, 1, *x.shape[1:])), draws)
    bare = replace(grasps, forces=None)
    value, pull = jax.vjp(lambda at: _solve(question, bare, at).margin, middle)
    (gradient,) = pull(jnp.ones_like(value))
    together = lambda tree: jnp.concatenate([x.reshape(len(x), -1) for x in jax.tree.leaves(tree)], -1)
    g, apart = together(gradient), together(draws)
    apart = apart - apart.mean(0)
    covariance = apart.T @ apart / max(question.count - 1, 1)
    center = jnp.where(jnp.isfinite(value[:, 0]), value[:, 0], jnp.nan)
    std = jnp.sqrt(jnp.maximum((g * (g @ covariance)).sum(-1), 0))
    divisor = jnp.where(std > 0, std, 1)
    above = (center[:, None] - thresholds) / divisor[:, None]
    above = jnp.where(std[:, None] > 0, ndtr(above), (above >= 0).astype(above.dtype))
    levels = center[:, None] + std[:, None] * ndtri(jnp.array(question.levels, std.dtype))
    room = _NEAR * mean.error * math.sqrt(question.count)
    fits = lambda x, near, room: ((x >= near.low - room) & (x <= near.high + room)) | (x == near.value)
    good = fits(center, mean, room) & fits(levels, quantiles, room[:, None]).all(-1)
    return FirstOrder(
        mean=center,
        std=jnp.where(jnp.isnan(center), jnp.nan, std),
        quantiles=levels,
        at_least=jnp.where(jnp.isnan(center)[:, None], jnp.nan, above),
        good=good,
    )
