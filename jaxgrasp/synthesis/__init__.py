"""Better grasps by gradient: contacts that move over an object's surface, and compliances that are optimised."""

from jaxgrasp.synthesis.compliance import ComplianceResult, optimize_compliance
from jaxgrasp.synthesis.grasps import Record, Synthesis, synthesize

__all__ = ["ComplianceResult", "Record", "Synthesis", "optimize_compliance", "synthesize"]
