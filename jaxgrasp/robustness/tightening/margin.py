"""The robustness margin with its tightening forces: the largest-minimum resisted disturbance, program (21)."""

from functools import partial

import jax.numpy as jnp
from jax.typing import ArrayLike

from jaxgrasp.contact.actuation import Actuation
from jaxgrasp.contact.compliance import Compliance
from jaxgrasp.contact.contacts import Contacts
from jaxgrasp.contact.friction import pyramid_facets
from jaxgrasp.disturbance import DisturbanceSet
from jaxgrasp.lanes.differentiable import Along
from jaxgrasp.robustness.auditing.multipliers import Evidence
from jaxgrasp.robustness.auditing.setting import chosen_form
from jaxgrasp.robustness.grasps import Grasps, over_grasps
from jaxgrasp.robustness.interface.arguments import GraspData, Options, optional_float
from jaxgrasp.robustness.interface.solution import Solution, with_moments
from jaxgrasp.robustness.tightening.decisions import at_centre, solve_margin
from jaxgrasp.robustness.tightening.derivatives import envelope_adjoint, is_compact, set_changes
from jaxgrasp.robustness.tightening.kernel import Tightening, change_of_results
from jaxgrasp.robustness.tightening.objectives import LargestMargin
from jaxgrasp.robustness.tightening.program import ScaledProgram
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

    A contact with friction exactly 0 transmits its normal force alone: f_0 and G* have no tangential forces there, Q
    and Q_0 no rows and columns, and its rows of C are cos(pi / n_e) f_n <= -d, since (1) would let it pull. Fewer than
    seven such contacts do not close a grasp, but disturbances in the range of their G are withstood.

    lambda is left free: where even b cannot be borne the status is INFEASIBLE and a negative margin is the proof. A
    grasp without force closure and without load has margin 0.

    Args:
        contacts: the grasps; their dtype is the precision.
        disturbances: the set D; without batch axes it is shared by all grasps.
        required_wrench: b (*batch, 6), N and N m, see `required_wrench`; None is zero.
        compliance: Q of (14), contact frames, symmetric positive definite: blocks (*batch, n_c, 3, 3), full
            (*batch, 3 n_c, 3 n_c), or `Compliance.per_direction`; None is the identity. For soft contacts 4 in place of
            3, with moments fourth (rad/(N m)); None then counts a moment m as the force m mu / gamma.
        cone_edges: n_e, edges of the friction pyramid, which is inscribed in Coulomb's cone.
        cone_margin: d, N, >= 0, what facet rows keep in reserve: one value a grasp (*batch,), a contact (*batch, n_c)
            or a row (*batch, n_c, n_e). Row k is (cos a_k, sin a_k, mu cos(pi/n_e)) f <= -d with a_k = (2 k + 1) pi /
            n_e from t1: d is the tangential force along that facet that is left before the row gives way. Its number
            of axes decides: as many as the batch of all other arguments, or less, is one value a grasp, one more a
            contact, two more a row. `jax.vmap` tries several on one grasp. Values of absent contacts do not count.
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
        smoothing all are those of the answer. Exactly zero for grasps without a finite margin. At friction 0 the
        margin jumps, as G* takes tangential forces up: there the derivative by friction is 0, all others are those of
        the frictionless contact.
    """
    pyramid_facets(cone_edges)
    data = GraspData.from_arguments(
        contacts, disturbances, required_wrench, compliance, cone_margin, actuation, cone_edges
    )
    options = Options(smoothing=optional_float("smoothing", smoothing), cutoff=optional_float("cutoff", cutoff))
    found = over_grasps(_LargestDisturbance(cone_edges, smoothing is not None, chosen_form() != "off"), data, options)
    return with_moments(found[0], contacts)


class _LargestDisturbance(Tightening):
    objective = LargestMargin()

    def _solve(self, grasps: Grasps, program: ScaledProgram) -> tuple[Solution, Evidence | None]:
        best, record, iterate = solve_margin(grasps, program)
        solution = best
        if grasps.options.smoothing is not None:
            possible = ~(program.wrench_outside | program.disturbance_outside | program.undisturbed)
            solution = at_centre(self.objective, grasps, program, iterate, best, grasps.valid & possible)
        return solution, self._evidence(grasps, program, record)

    def tangents(self, along: Along, found: tuple) -> tuple:
        out = found[0]
        point = self._point(out, jnp.isfinite(out.margin) & (out.status != Status.PRUNED))
        change = self._central(along, point)
        if not self.smooth:
            adjoint = partial(envelope_adjoint, self.cone_edges, set_changes(along))
            compact = is_compact(along)
            change = change._replace(margin=along.adjoint(adjoint, point, (out.margin,), compact)[0])
        return change_of_results(found, change, change.margin)
