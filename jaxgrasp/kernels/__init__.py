"""Fused kernels: one jaxpr as native code, with one lane of the batch per SIMD lane of a CPU or per thread of a GPU.

README.md in this folder is the map of the compiler.
"""

from jaxgrasp.kernels.primitive import allowed, distrust, fused, usable, without

__all__ = ["allowed", "distrust", "fused", "usable", "without"]
