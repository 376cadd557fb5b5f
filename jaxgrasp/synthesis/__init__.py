"""Better grasps by gradient: contacts that move over an object's surface, and compliances that are optimised."""

from jaxgrasp.synthesis.compliance import ComplianceResult, optimize_compliance
from jaxgrasp.synthesis.grasps import Record, Synthesis, synthesize
from jaxgrasp.synthesis.hand_energy import Weights
from jaxgrasp.synthesis.hand_grasps import HandSynthesis, synthesize_hand_grasps
from jaxgrasp.synthesis.hand_judgement import Verdict

__all__ = [
    "ComplianceResult",
    "HandSynthesis",
    "Record",
    "Synthesis",
    "Verdict",
    "Weights",
    "optimize_compliance",
    "synthesize",
    "synthesize_hand_grasps",
]
