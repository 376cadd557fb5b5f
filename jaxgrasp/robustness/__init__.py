"""The paper: worst cases (17)-(18), robustness margin (21), least effort (22), blocking forces (15)."""

from jaxgrasp.robustness.blocking import blocking_forces
from jaxgrasp.robustness.solution import Solution
from jaxgrasp.robustness.tightening import largest_disturbance, least_effort
from jaxgrasp.robustness.worst_case import worst_case

__all__ = ["Solution", "blocking_forces", "largest_disturbance", "least_effort", "worst_case"]
