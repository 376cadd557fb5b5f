"""The files that grasps come in by, and a built-in object to sample grasps on."""

from jaxgrasp.candidates.candidates import Candidates, concatenate
from jaxgrasp.candidates.plausibility import doubtful_conventions
from jaxgrasp.candidates.reader import CandidateError, read_candidates
from jaxgrasp.candidates.superquadric import Superquadric, sample_grasps
from jaxgrasp.candidates.wrenches import read_wrenches

__all__ = [
    "CandidateError",
    "Candidates",
    "Superquadric",
    "concatenate",
    "doubtful_conventions",
    "read_candidates",
    "read_wrenches",
    "sample_grasps",
]
