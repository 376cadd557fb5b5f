"""The outcome of a solve for each element of a batch."""

import enum


class Status(enum.IntEnum):
    """The outcome of one solve; arrays of statuses hold these integers.

    ``Status(int(code)).advice`` says what a caller can do about it.
    """

    SOLVED = 0
    INFEASIBLE = 1
    UNBOUNDED = 2
    MAX_ITERATIONS = 3
    ILL_CONDITIONED = 4
    INVALID_INPUT = 5
    PRUNED = 6
    NOT_VERIFIED = 7

    @property
    def advice(self) -> str:
        """A sentence that says what the outcome means and what a caller can do."""
        return _ADVICE[self]


_ADVICE = {
    Status.SOLVED: "Solved to the tolerance; the bounds certify it.",
    Status.INFEASIBLE: "No admissible point exists; a negative margin or a certificate proves it.",
    Status.UNBOUNDED: "The objective has no bound: for a grasp, nothing disturbs it.",
    Status.MAX_ITERATIONS: "Not solved to the tolerance; the bounds still hold. Use float64 or rescale the data.",
    Status.ILL_CONDITIONED: "The rank of the grasp map cannot be told in this precision; in float32, use float64.",
    Status.INVALID_INPUT: "The data of this element are not admissible (NaN, zero normal, negative friction ...).",
    Status.PRUNED: "Given up early, since its upper bound is below the cutoff; the bounds hold.",
    Status.NOT_VERIFIED: "The audit could not confirm the answer; its margin is what it confirms, or NaN. Use float64.",
}
