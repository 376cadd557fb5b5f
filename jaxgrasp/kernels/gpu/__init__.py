"""Kernels for GPUs: a thread for every lane."""
