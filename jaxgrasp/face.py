"""The public face: what `import jaxgrasp` offers."""

from importlib import import_module
from typing import TYPE_CHECKING

from jaxgrasp import metrics, solvers, uncertainty
from jaxgrasp.contact import Actuation, Compliance, Contacts, grasp_map, required_wrench
from jaxgrasp.disturbance import DisturbanceSet
from jaxgrasp.explanation import Explanation, explain
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
    weighted_pseudo_inverse,
    worst_case,
)
from jaxgrasp.solvers.status import Status
from jaxgrasp.uncertainty import MarginDistribution, Uncertainty, margin_distribution

if TYPE_CHECKING:
    from jaxgrasp.evaluation import evaluate
    from jaxgrasp.squeezing import squeeze_grasps

# What needs MuJoCo is imported when it is used.
_LATER = {"evaluate": "jaxgrasp.evaluation", "squeeze_grasps": "jaxgrasp.squeezing"}

__all__ = [
    "Actuation",
    "Comparison",
    "Compliance",
    "Contacts",
    "DisturbanceSet",
    "Explanation",
    "FormulationSolution",
    "MarginDistribution",
    "Solution",
    "SpecifiedDisturbances",
    "Status",
    "TotalEffortSolution",
    "Uncertainty",
    "audit",
    "blocking_forces",
    "compare_formulations",
    "evaluate",
    "explain",
    "formulation_margin",
    "grasp_map",
    "largest_disturbance",
    "least_effort",
    "least_total_effort",
    "margin_distribution",
    "metrics",
    "required_wrench",
    "solvers",
    "specified_disturbances",
    "squeeze_grasps",
    "uncertainty",
    "weighted_pseudo_inverse",
    "without_kernels",
    "worst_case",
]


def __getattr__(name: str) -> object:
    if name not in _LATER:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(_LATER[name]), name)
