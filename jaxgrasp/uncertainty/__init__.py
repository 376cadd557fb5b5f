"""What is not known of grasps, and what that makes of their margins."""

from jaxgrasp.uncertainty.boxes import box_effort
from jaxgrasp.uncertainty.distribution import FirstOrder, MarginDistribution, margin_distribution
from jaxgrasp.uncertainty.files import read_uncertainty
from jaxgrasp.uncertainty.scenarios import ScenarioForces, scenario_effort
from jaxgrasp.uncertainty.spec import Distribution, Samples, Uncertainty, normal, samples, uniform
from jaxgrasp.uncertainty.statistics import Estimate

__all__ = [
    "Distribution",
    "Estimate",
    "FirstOrder",
    "MarginDistribution",
    "Samples",
    "ScenarioForces",
    "Uncertainty",
    "box_effort",
    "margin_distribution",
    "normal",
    "read_uncertainty",
    "samples",
    "scenario_effort",
    "uniform",
]
