"""Why grasps have the margins that they have, in words and numbers."""

from jaxgrasp.explanation.explain import Explanation, explain
from jaxgrasp.explanation.zero_margins import is_zero, why_zero

__all__ = ["Explanation", "explain", "is_zero", "why_zero"]
