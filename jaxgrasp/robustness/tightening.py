"""Tightening forces: the largest-minimum resisted disturbance (21) and the least effort (22)."""

from abc import ABC, abstractmethod
from dataclasses import dataclass, fields, replace
from functools import partial

import jax
import jax.numpy as jnp
from jax.typing import ArrayLike

from jaxgrasp.contact.actuation import Actuation
from jaxgrasp.contact.compliance import Compliance
from jaxgrasp.contact.contacts import Contacts
from jaxgrasp.contact.friction import pyramid_facets
from jaxgrasp.disturbance import DisturbanceSet
from jaxgrasp.robustness.arguments import Arguments
from jaxgrasp.robustness.auditing import Audited
from jaxgrasp.robustness.auditing.pyramids import Evidence, Verdict, corrected, judge, spot
from jaxgrasp.robustness.auditing.setting import chosen_form
from jaxgrasp.robustness.derivatives import CentralPoint, Point, envelope_adjoint
from jaxgrasp.robustness.grasps import Grasps, over_grasps
from jaxgrasp.robustness.kernels import Along, OfPyramids, Tree
from jaxgrasp.robustness.program import Program, prepared
from jaxgrasp.robustness.solution import Solution
from jaxgrasp.robustness.tightening_lanes import at_centre, evidence, solve_effort, solve_margin
from jaxgrasp.solvers.block_kkt import Record
from jaxgrasp.solvers.status import Status


def largest_disturbance(
    contacts: Contacts,
    disturbances: DisturbanceSet,
    required_wrench: ArrayLike | None = None,
    compliance: ArrayLike | Compliance | None = None,
    cone_edges: int = 8,
    cone_margin: ArrayLike = 0.0,
    smoothing: ArrayLike | None = None,
    actuation: Actuation | None = None,
    cutoff: ArrayLike | None = None,
) -> Solution:
    """The robustness margin (21): the largest factor by which the disturbances may be scaled while the grasp holds.

    max lambda over (f_0, lambda) subject to G f_0 = b, C f_0 - S_1 lambda <= -d, -E f_0 + S_2 lambda <= f_max.

    The rows are those of (19), which the paper prints with + for the first -; they are equivalent to (16). They bound
    |f_n|, where the paper's section V-A speaks of the force norm: f_max / sqrt(1 + mu^2) keeps |f| below f_max, too.
    docs/paper.md has what that changes.

    lambda is left free: where even b cannot be borne the status is INFEASIBLE and a negative margin is the proof. A
    grasp without force closure and without load has margin 0.

    Args:
        contacts: the grasps; their dtype is the precision.
        disturbances: the set D; without batch axes it is shared by all grasps.
        required_wrench: b (*batch, 6), N and N m, see `required_wrench`; None is zero.
        compliance: Q of (14), contact frames, symmetric positive definite: blocks (*batch, n_c, 3, 3), full
            (*batch, 3 n_c, 3 n_c), or `Compliance.per_direction`; None is the identity.
        cone_edges: n_e, edges of the friction pyramid, which is inscribed in Coulomb's cone.
        cone_margin: d (*batch,), N, >= 0: what every facet row keeps in reserve.
        smoothing: kappa (*batch,), > 0, in units of the margin: answer with the central point, where s z = kappa in
            every row, instead of the optimum. Margin and forces are then smooth and unique, and the margin is below
            the optimum by about kappa for every active row. None is the exact optimum.
        actuation: what the hand can do: efforts u with J'f_0 = B u that stay within their limits while the worst
            disturbance acts join the unknowns, and G* leaves joint directions that no actuator reaches without torque.
            None lets every finger push at will.
        cutoff: (*batch,), in units of the margin: grasps are given up as soon as a certified upper bound is below, with
            the bounds found so far. None (or NaN) gives up none.

    Returns:
        Solution with `*batch` axes. `margin` is attained by `forces`, and no forces reach more than `upper_bound`.

    Raises:
        ValueError: shapes or options that do not fit; at trace time.

    Status:
        SOLVED; INFEASIBLE (b cannot be borne); UNBOUNDED (nothing disturbs, margin inf); INVALID_INPUT (data not
        admissible, for that grasp alone); PRUNED (below the cutoff); MAX_ITERATIONS, ILL_CONDITIONED (the rank cannot
        be told). With smoothing, SOLVED means that the central point was found; its margin may be negative, which then
        proves nothing.

    Derivatives:
        Of margin (and upper_bound), forces, effort and multipliers with respect to everything that is continuous, of
        any order. The exact margin's gradient is that of the Lagrangian (envelope theorem), at kinks a subgradient;
        that of exact forces belongs to the central point for 1e-6 (float32: 1e-4) of the margin's natural scale. With
        smoothing all are those of the answer. Exactly zero for grasps without a finite margin.
    """
    pyramid_facets(cone_edges)
    return over_grasps(
        _LargestDisturbance(cone_edges, smoothing is not None, chosen_form() != "off"),
        contacts,
        disturbances,
        required_wrench=required_wrench,
        compliance=compliance,
        cone_margin=cone_margin,
        smoothing=smoothing,
        cutoff=cutoff,
        actuation=actuation,
    )[0]


def least_effort(
    contacts: Contacts,
    disturbances: DisturbanceSet,
    margin: ArrayLike,
    required_wrench: ArrayLike | None = None,
    compliance: ArrayLike | Compliance | None = None,
    effort_weights: ArrayLike | None = None,
    cone_edges: int = 8,
    cone_margin: ArrayLike = 0.0,
    smoothing: ArrayLike | None = None,
    actuation: Actuation | None = None,
) -> Solution:
    """The tightening forces of least effort that give a chosen margin, program (22).

    min 1/2 f_0' Q_0 f_0 subject to the rows of (21) with lambda = margin. Solves (21) first, for a start and for the
    certificate where the margin cannot be had.

    Args:
        contacts: the grasps; their dtype is the precision.
        disturbances: the set D.
        margin: lambda (*batch,), >= 0; usually a share, say 75 %, of (21)'s.
        required_wrench: b (*batch, 6), N and N m; None is zero.
        compliance: Q, as in `largest_disturbance`.
        effort_weights: Q_0 as blocks (*batch, n_c, 3, 3), contact frames, symmetric positive definite; None is the
            identity.
        cone_edges: n_e.
        cone_margin: d (*batch,), N, >= 0.
        smoothing: kappa (*batch,), > 0, N^2: s z = kappa in every row, as in `largest_disturbance` but in units of the
            effort, this program's objective. None is the exact optimum.
        actuation: what the hand can do, as in `largest_disturbance`; actuator efforts cost nothing.

    Returns:
        Solution; `margin` is what `forces` certify, at least the one asked for up to rounding, `upper_bound` that of
        (21).

    Raises:
        ValueError: shapes or options that do not fit; at trace time.

    Status:
        As in `largest_disturbance`; INFEASIBLE where the margin is above what (21) allows; INVALID_INPUT where it is
        negative or NaN.

    Derivatives:
        As in `largest_disturbance`, the margin asked for included; of exact forces those of the central point for 1e-8
        (float32: 1e-5) of the effort's scale. `margin` varies like the one asked for, `upper_bound` counts as constant.
        Zero for grasps without an answer.
    """
    pyramid_facets(cone_edges)
    return over_grasps(
        _LeastEffort(cone_edges, smoothing is not None, chosen_form() != "off"),
        contacts,
        disturbances,
        required_wrench=required_wrench,
        compliance=compliance,
        cone_margin=cone_margin,
        effort_weights=effort_weights,
        margin=margin,
        smoothing=smoothing,
        actuation=actuation,
    )[0]


@dataclass(frozen=True)
class _Tightening(OfPyramids, Audited, ABC):
    """The common part of the kernels of (21) and (22), whose results are a solution and evidence for its audit."""

    smooth: bool
    evident: bool = True
    """Whether the kernel writes evidence; without an audit nobody reads it."""

    @property
    def stages(self) -> tuple:
        return (lambda grasps, _: prepared(grasps, self.cone_edges), lambda given: self._solve(*given))

    @abstractmethod
    def _solve(self, grasps: Grasps, program: Program) -> tuple[Solution, Evidence | None]: ...

    def _evidence(self, grasps: Grasps, program: Program, record: Record) -> Evidence | None:
        return evidence(grasps, program, record) if self.evident else None

    def judge(self, arguments: Arguments, out: tuple[Solution, Evidence], anew: bool) -> Verdict:
        return judge(arguments, *out, anew, self.smooth)

    def spot(self, arguments: Arguments, out: tuple[Solution, Evidence]) -> jax.Array:
        return spot(arguments, *out)

    def correct(self, out: tuple[Solution, Evidence], verdicts: Verdict) -> tuple[Solution, Evidence]:
        return corrected(out[0], verdicts), out[1]

    def _point(self, out: Solution, usable: jax.Array) -> Point:
        if self.smooth:
            # At a central point all multipliers are positive; where there is none they are zero, or it was not found.
            usable &= (out.status != Status.MAX_ITERATIONS) & jnp.any(out.bound_multipliers > 0, -1)
        return Point(usable=usable, **{name: getattr(out, name) for name in Point._fields if name != "usable"})

    def _central(self, along: Along, point: Point) -> Point:
        """The derivative of everything at the central point, which is the point itself where smoothing is asked for."""
        kernel = CentralPoint(self.cone_edges)
        return kernel.tangents(along, point if self.smooth else along.value(kernel, point))


class _LargestDisturbance(_Tightening):
    def _solve(self, grasps: Grasps, program: Program) -> tuple[Solution, Evidence | None]:
        best, record, iterate = solve_margin(grasps, program)
        solution = best
        if grasps.smoothing is not None:
            possible = ~(program.wrench_outside | program.disturbance_outside | program.undisturbed)
            solution = at_centre(grasps, program, iterate, best, grasps.valid & possible)
        return solution, self._evidence(grasps, program, record)

    def tangents(self, along: Along, found: tuple) -> tuple:
        out = found[0]
        point = self._point(out, jnp.isfinite(out.margin) & (out.status != Status.PRUNED))
        change = self._central(along, point)
        if not self.smooth:
            adjoint = partial(envelope_adjoint, self.cone_edges)
            change = change._replace(margin=along.adjoint(adjoint, point, (out.margin,))[0])
        return _changed(found, change, change.margin)


class _LeastEffort(_Tightening):
    def _solve(self, grasps: Grasps, program: Program) -> tuple[Solution, Evidence | None]:
        first, record, _ = solve_margin(replace(grasps, smoothing=None), program)
        return solve_effort(grasps, program, first, record), self._evidence(grasps, program, record)

    def tangents(self, along: Along, found: tuple) -> tuple:
        out = found[0]
        return _changed(found, self._central(along, self._point(out, jnp.isfinite(out.effort))), None)


def _changed(found: tuple[Solution, Evidence | None], change: Point, upper_bound: jax.Array | None) -> tuple:
    """A change of the results; None for what does not vary, or counts as if it did not."""
    varying = change._asdict() | {"upper_bound": upper_bound}
    still = jax.tree.map(lambda _: None, found[1])
    changes: dict[str, Tree] = {f.name: varying.get(f.name) for f in fields(Solution)}
    return Solution(**changes), still
