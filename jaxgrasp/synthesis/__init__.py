"""Better grasps by gradient: contacts that move over an object's surface, and compliances that are optimised."""

from jaxgrasp.synthesis.compliance import ComplianceResult, optimize_compliance
from jaxgrasp.synthesis.grasps import Record, Synthesis, synthesize
from jaxgrasp.synthesis.hand.energy import Weights
from jaxgrasp.synthesis.hand.judgement import Verdict
from jaxgrasp.synthesis.hand.synthesis import HandSynthesis, synthesize_hand_grasps

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
