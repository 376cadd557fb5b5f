"""The public face: what `import jaxgrasp` offers."""

from jaxgrasp import metrics, solvers
from jaxgrasp.contact import Actuation, Compliance, Contacts, grasp_map, required_wrench
from jaxgrasp.disturbance import DisturbanceSet
from jaxgrasp.kernels import without as without_kernels
from jaxgrasp.robustness import (
    Comparison,
    FormulationSolution,
    Solution,
    SpecifiedDisturbances,
    TotalEffortSolution,
    audit,
    blocking_forces,
    compare_formulations,
    formulation_margin,
    largest_disturbance,
    least_effort,
    least_total_effort,
    specified_disturbances,
    worst_case,
)
from jaxgrasp.solvers.status import Status

__all__ = [
    "Actuation",
    "Comparison",
    "Compliance",
    "Contacts",
    "DisturbanceSet",
    "FormulationSolution",
    "Solution",
    "SpecifiedDisturbances",
    "Status",
    "TotalEffortSolution",
    "audit",
    "blocking_forces",
    "compare_formulations",
    "formulation_margin",
    "grasp_map",
    "largest_disturbance",
    "least_effort",
    "least_total_effort",
    "metrics",
    "required_wrench",
    "solvers",
    "specified_disturbances",
    "without_kernels",
    "worst_case",
]
