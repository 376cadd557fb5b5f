"""The field's other measures of grasps, on the same contacts, each with its paper and its conventions."""

from jaxgrasp.metrics.closure import ForceClosure, force_closure, min_weight
from jaxgrasp.metrics.hulls import wrench_space_volume
from jaxgrasp.metrics.largest_ball import ferrari_canny_bound
from jaxgrasp.metrics.matrices import closure_residual, isotropy, smallest_singular_value
from jaxgrasp.metrics.nearest_facet import NearestFacet, ferrari_canny, nearest_facet
from jaxgrasp.metrics.table import METRICS, Metric, Setting
from jaxgrasp.metrics.task import task_wrench
from jaxgrasp.metrics.wrench_space import WrenchSpace, edge_wrenches

__all__ = [
    "METRICS",
    "ForceClosure",
    "Metric",
    "NearestFacet",
    "Setting",
    "WrenchSpace",
    "closure_residual",
    "edge_wrenches",
    "ferrari_canny",
    "ferrari_canny_bound",
    "force_closure",
    "isotropy",
    "min_weight",
    "nearest_facet",
    "smallest_singular_value",
    "task_wrench",
    "wrench_space_volume",
]
