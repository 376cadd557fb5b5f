"""Better grasps by gradient."""

from jaxgrasp.synthesis.compliance import ComplianceResult, optimize_compliance

__all__ = ["ComplianceResult", "optimize_compliance"]
