"""Fused kernels: one jaxpr, compiled to vector code with one problem per SIMD lane."""

from jaxgrasp.kernels.fused import call, usable, without

__all__ = ["call", "usable", "without"]
