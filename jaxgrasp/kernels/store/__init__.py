"""The code cache: compiled kernels on disk, and the keys that they are found by."""
