"""The GPU target: kernels with one lane of the batch per thread."""
