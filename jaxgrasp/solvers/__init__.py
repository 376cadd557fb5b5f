"""Mathematics that knows nothing of grasps."""

from jaxgrasp.solvers.dense.quadratic_program import QPSolution, solve_qp

__all__ = ["QPSolution", "solve_qp"]
