"""The common part of the batched programs (21) and (22): their results, the audit of these and their derivatives."""

from abc import ABC, abstractmethod
from dataclasses import dataclass, fields
from typing import ClassVar

import jax
import jax.numpy as jnp

from jaxgrasp.lanes.differentiable import Along, OfPyramids, Tree
from jaxgrasp.robustness.auditing import Audited
from jaxgrasp.robustness.auditing.multipliers import Evidence
from jaxgrasp.robustness.auditing.pyramids import Verdict, corrected, judge, spot
from jaxgrasp.robustness.grasps import Grasps
from jaxgrasp.robustness.interface.arguments import Arguments
from jaxgrasp.robustness.interface.solution import Solution
from jaxgrasp.robustness.tightening.decisions import evidence
from jaxgrasp.robustness.tightening.derivatives import CentralPoint
from jaxgrasp.robustness.tightening.objectives import Objective
from jaxgrasp.robustness.tightening.points import Point
from jaxgrasp.robustness.tightening.program import ScaledProgram, prepare
from jaxgrasp.solvers.block.kkt import Record
from jaxgrasp.solvers.status import Status


@dataclass(frozen=True)
class Tightening(OfPyramids, Audited, ABC):
    """The common part of (21) and (22) as batched functions; their results are a solution and evidence for an audit."""

    objective: ClassVar[Objective]
    """Which of the two programs this is."""
    smooth: bool
    """Whether the central point is asked for in place of the optimum."""
    evident: bool = True
    """Whether evidence is part of the results; without an audit nobody reads it."""

    @property
    def stages(self) -> tuple:
        """Scale the grasps, then solve them."""
        return (lambda grasps, _: prepare(grasps, self.cone_edges), lambda scaled: self._solve(*scaled))

    @abstractmethod
    def _solve(self, grasps: Grasps, program: ScaledProgram) -> tuple[Solution, Evidence | None]: ...

    def _evidence(self, grasps: Grasps, program: ScaledProgram, record: Record) -> Evidence | None:
        return evidence(grasps, program, record) if self.evident else None

    def judge(self, arguments: Arguments, out: tuple[Solution, Evidence], anew: bool) -> Verdict:
        """Hold every lane against the rules of the audit."""
        return judge(arguments, *out, anew, self.smooth)

    def spot(self, arguments: Arguments, out: tuple[Solution, Evidence]) -> jax.Array:
        """Find what the evidence of the lanes that are computed anew should have been."""
        return spot(arguments, *out)

    def correct(self, out: tuple[Solution, Evidence], verdicts: Verdict) -> tuple[Solution, Evidence]:
        """Take back what the audit does not confirm."""
        return corrected(out[0], verdicts), out[1]

    def _point(self, out: Solution, usable: jax.Array) -> Point:
        if self.smooth:
            # At a central point all multipliers are positive; where there is none they are zero, or it was not found.
            usable &= (out.status != Status.MAX_ITERATIONS) & jnp.any(out.bound_multipliers > 0, -1)
        return Point(usable=usable, **{name: getattr(out, name) for name in Point._fields if name != "usable"})

    def _central(self, along: Along, point: Point) -> Point:
        """The derivative of everything at the central point, which is the point itself where smoothing is asked for."""
        kernel = CentralPoint(self.cone_edges, self.objective)
        return kernel.tangents(along, point if self.smooth else along.value(kernel, point))


def change_of_results(found: tuple[Solution, Evidence | None], change: Point, upper_bound: jax.Array | None) -> tuple:
    """The change of the results; None for fields that do not vary, or count as if they did not."""
    varying = change._asdict() | {"upper_bound": upper_bound}
    still = jax.tree.map(lambda _: None, found[1])
    changes: dict[str, Tree] = {f.name: varying.get(f.name) for f in fields(Solution)}
    return Solution(**changes), still
