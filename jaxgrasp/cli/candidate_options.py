"""The options of subcommands that take candidates and find their margins."""

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

from jaxgrasp.cli.checks import check_options
from jaxgrasp.cli.setting import Reading

if TYPE_CHECKING:
    from jaxgrasp.candidates import Candidates

SAMPLED = 10_000
"""Number of grasps that are sampled where no file is given."""


@dataclass(frozen=True, kw_only=True)
class CandidateOptions(Reading):
    """Options that complete candidates, and name the disturbances of their margins."""

    friction: float | None = None
    """Coulomb's friction coefficient for files without any."""

    max_force: float | None = None
    """Largest normal force for files without any, N."""

    gravity: float = 0.0
    """Gravity along the object's -z, m/s^2, under which the mass of each candidate must be borne; 0 for none."""

    disturbances: str = "forces"
    """forces: 1 N along the six axes; ball: 1 N in any direction; box: 1 N along each axis together with 0.02 N m about
    each; or a FILE of wrenches, .npy or .npz with the field wrenches (n_d, 6), N and N m. The margin is the factor by
    which they may grow."""

    cone_edges: int = 8
    """Edges of the friction pyramid."""

    share: float = 0.75
    """The part of its margin for which the tightening forces of a grasp are found."""

    def check_candidates(self) -> None:
        """Finds what cannot be used before any long work.

        Raises:
            CommandError: An option cannot be used.
        """
        check_options(
            ("--friction", self.friction, self.friction is None or 0.0 <= self.friction < math.inf, "a number >= 0"),
            ("--max-force", self.max_force, self.max_force is None or 0.0 < self.max_force < math.inf, "newtons > 0"),
            ("--gravity", self.gravity, math.isfinite(self.gravity), "a finite number of m/s^2"),
            ("--cone-edges", self.cone_edges, self.cone_edges >= 3, "at least 3"),
            ("--share", self.share, 0.0 < self.share <= 1.0, "a number in (0, 1]"),
        )

    def sampled(self, count: int | None = None) -> "Candidates":
        """Grasps on a built-in object, as many as the package samples without a file where no count is given."""
        from jaxgrasp.candidates import sample_grasps

        return sample_grasps(
            SAMPLED if count is None else count,
            friction=0.6 if self.friction is None else self.friction,
            max_force=10.0 if self.max_force is None else self.max_force,
        )
