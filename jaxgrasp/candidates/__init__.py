"""The files that grasps come in by, and a built-in object to sample grasps on."""

from jaxgrasp.candidates.arrow import candidates_of_table, columns_of_table, table_of_candidates
from jaxgrasp.candidates.candidates import Candidates, concatenate
from jaxgrasp.candidates.plausibility import doubtful_conventions
from jaxgrasp.candidates.reader import CandidateError, read_candidates
from jaxgrasp.candidates.superquadric import Superquadric, sample_grasps
from jaxgrasp.candidates.wrenches import read_wrenches

__all__ = [
    "CandidateError",
    "Candidates",
    "Superquadric",
    "candidates_of_table",
    "columns_of_table",
    "concatenate",
    "doubtful_conventions",
    "read_candidates",
    "read_wrenches",
    "sample_grasps",
    "table_of_candidates",
]
