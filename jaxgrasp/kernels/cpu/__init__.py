"""The CPU target: kernels with one lane of the batch per lane of a vector register."""
