"""Rank multi-fingered grasps by how strong a disturbance they withstand, in batch, with the forces that do it."""

from jaxgrasp import metrics, solvers
from jaxgrasp.contact import Actuation, Compliance, Contacts, grasp_map, required_wrench
from jaxgrasp.disturbance import DisturbanceSet
from jaxgrasp.robustness import Solution, blocking_forces, largest_disturbance, least_effort, worst_case
from jaxgrasp.solvers.status import Status

__all__ = [
    "Actuation",
    "Compliance",
    "Contacts",
    "DisturbanceSet",
    "Solution",
    "Status",
    "blocking_forces",
    "grasp_map",
    "largest_disturbance",
    "least_effort",
    "metrics",
    "required_wrench",
    "solvers",
    "worst_case",
]
