"""The paper: worst cases (17)-(18), margin (21), least effort (22), blocking forces (15), and the way to them."""

from jaxgrasp.robustness.auditing import audit
from jaxgrasp.robustness.blocking import blocking_forces, weighted_pseudo_inverse
from jaxgrasp.robustness.chain.comparison import (
    Comparison,
    SpecifiedDisturbances,
    compare_formulations,
    specified_disturbances,
)
from jaxgrasp.robustness.chain.formulations import formulation_margin
from jaxgrasp.robustness.chain.total_effort import TotalEffortSolution, least_total_effort
from jaxgrasp.robustness.chain.verdicts import FormulationSolution
from jaxgrasp.robustness.interface.solution import Solution
from jaxgrasp.robustness.tightening.effort import least_effort
from jaxgrasp.robustness.tightening.margin import largest_disturbance
from jaxgrasp.robustness.worst_case import worst_case

__all__ = [
    "Comparison",
    "FormulationSolution",
    "Solution",
    "SpecifiedDisturbances",
    "TotalEffortSolution",
    "audit",
    "blocking_forces",
    "compare_formulations",
    "formulation_margin",
    "largest_disturbance",
    "least_effort",
    "least_total_effort",
    "specified_disturbances",
    "weighted_pseudo_inverse",
    "worst_case",
]
