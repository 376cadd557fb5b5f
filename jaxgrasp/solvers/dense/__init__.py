"""Quadratic programs without structure, `solve_qp`."""
