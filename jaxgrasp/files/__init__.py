"""The field's files of grasps: every format becomes one record, and the record is written back."""

from jaxgrasp.files.formats import FORMATS
from jaxgrasp.files.grasp_set import GRASP, GraspSet, HandPoses, concatenate
from jaxgrasp.files.paths import grasp_files
from jaxgrasp.files.reading import read_grasps
from jaxgrasp.files.writing import WRITTEN, write_grasps

__all__ = [
    "FORMATS",
    "GRASP",
    "WRITTEN",
    "GraspSet",
    "HandPoses",
    "concatenate",
    "grasp_files",
    "read_grasps",
    "write_grasps",
]
