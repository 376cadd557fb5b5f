"""Kernels for CPUs: vectors of lanes."""
