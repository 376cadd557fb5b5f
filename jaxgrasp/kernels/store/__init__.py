"""Compiled kernels on disk, and the names under which they are found again."""
