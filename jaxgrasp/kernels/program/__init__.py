"""From a jaxpr to scalar operations in the order in which they are computed."""
