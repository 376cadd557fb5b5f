"""The middle of the compiler: from a jaxpr to scalar operations in the order in which they are computed."""
