"""Fused kernels: one jaxpr, as vector code with one problem per SIMD lane, or a GPU's with one per thread."""

from jaxgrasp.kernels.native import distrust, fused, usable, without

__all__ = ["distrust", "fused", "usable", "without"]
