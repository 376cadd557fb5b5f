"""The tightening forces of least effort that give a chosen margin, program (22)."""

from dataclasses import replace

import jax.numpy as jnp
from jax.typing import ArrayLike

from jaxgrasp.arrays import as_float
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
from jaxgrasp.robustness.tightening.decisions import solve_effort, solve_margin
from jaxgrasp.robustness.tightening.kernel import Tightening, change_of_results
from jaxgrasp.robustness.tightening.objectives import LeastEffort
from jaxgrasp.robustness.tightening.program import ScaledProgram


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
        effort_weights: Q_0, contact frames, symmetric positive definite: blocks (*batch, n_c, 3, 3) or full
            (*batch, 3 n_c, 3 n_c), for least joint torques `Actuation.joint_torque_weights`; None is the identity.
            Full ones take dense linear algebra, blocks do not. For soft contacts 4 in place of 3, as the compliance.
        cone_edges: n_e.
        cone_margin: d, N, >= 0: a grasp, a contact or a row, as in `largest_disturbance`.
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
    data = GraspData.from_arguments(
        contacts, disturbances, required_wrench, compliance, cone_margin, actuation, cone_edges
    )
    options = Options(
        margin=as_float("margin", margin, ()),
        smoothing=optional_float("smoothing", smoothing),
        effort_weights=optional_float("effort_weights", effort_weights),
    )
    found = over_grasps(_LeastEffort(cone_edges, smoothing is not None, chosen_form() != "off"), data, options)
    return with_moments(found[0], contacts)


class _LeastEffort(Tightening):
    objective = LeastEffort()

    def _solve(self, grasps: Grasps, program: ScaledProgram) -> tuple[Solution, Evidence | None]:
        first, record, _ = solve_margin(replace(grasps, options=replace(grasps.options, smoothing=None)), program)
        return solve_effort(grasps, program, first, record), self._evidence(grasps, program, record)

    def tangents(self, along: Along, found: tuple) -> tuple:
        out = found[0]
        return change_of_results(found, self._central(along, self._point(out, jnp.isfinite(out.effort))), None)
