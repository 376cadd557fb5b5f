"""Fused kernels: one jaxpr, compiled to vector code with one problem per SIMD lane."""

from jaxgrasp.kernels.native import fused, usable, without

__all__ = ["fused", "usable", "without"]
