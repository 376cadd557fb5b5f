"""Fused kernels: one jaxpr, as vector code with one problem per SIMD lane, or a GPU's with one per thread."""

from jaxgrasp.kernels.primitive import allowed, distrust, fused, usable, without

__all__ = ["allowed", "distrust", "fused", "usable", "without"]
