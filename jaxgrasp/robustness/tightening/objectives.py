"""(21) and (22) as problems for the solver; the type of an `Objective` tells which of the two is meant."""

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import Any, ClassVar, NamedTuple

import jax
import jax.numpy as jnp
from jax import lax

from jaxgrasp.arrays import fold
from jaxgrasp.contact.compliance import is_full
from jaxgrasp.robustness.grasps import Grasps
from jaxgrasp.robustness.tightening.program import ScaledProgram, force_units
from jaxgrasp.solvers.block.effort import EffortProblem, curvature_of
from jaxgrasp.solvers.block.kkt import BlockProblem, Blocks, Rows
from jaxgrasp.solvers.block.margin import MarginProblem
from jaxgrasp.solvers.small_matrices import flatten

_REFINEMENTS = {"float64": 0, "float32": 1}


def margin_problem(program: ScaledProgram, cutoff: jax.Array | None = None) -> MarginProblem:
    """(21) as a problem for the solver; it gives up margins below the cutoff, in units of the disturbances."""
    refinements = _REFINEMENTS[program.rhs.dtype.name]
    cutoff = None if cutoff is None else cutoff / program.scale
    return MarginProblem(
        program.groups, program.rhs, program.dropped, program.radius, refinements, program.joined, cutoff
    )


class ScaledEffort(NamedTuple):
    """(22) as a problem for the solver."""

    problem: EffortProblem
    """The problem, without a guess where to start."""
    margin: jax.Array
    """The margin that is asked for, scaled, (*lanes)."""
    unit: jax.Array
    """The root of the unit of effort, (*lanes)."""


def effort_problem(grasps: Grasps, program: ScaledProgram, guess: Rows = ()) -> ScaledEffort:
    """(22) as a problem for the solver, which starts from the guess."""
    blocks, *others = program.groups
    dtype, asked = program.rhs.dtype, grasps.options.margin
    assert asked is not None
    margin = jnp.where(program.disturbance_outside, 0, asked / program.scale)
    eye = jnp.eye(program.columns.shape[1], dtype=dtype)[..., None, None]
    # H = D Q_0 D = root'root with root = R D, Q_0 = R'R and the units D of forces.
    root = eye if grasps.weight_roots is None else grasps.weight_roots
    units = force_units(program.tangential, program.normal, program.columns.shape[1])
    if root.ndim < blocks.columns.ndim:
        root = root * flatten(units * blocks.present)
        largest = fold(jnp.maximum, fold(jnp.maximum, jnp.abs(root)))
    else:
        root = root * units * blocks.present
        largest = fold(jnp.maximum, fold(jnp.maximum, fold(jnp.maximum, jnp.abs(root))))
    largest = lax.stop_gradient(largest)
    largest = jnp.where(largest > 0, largest, 1)

    def with_margin(group: Blocks, root: jax.Array) -> Blocks:
        return group._replace(h=group.h - jnp.where(program.undisturbed, 0, group.sigma) * margin, hessian_root=root)

    # Actuator efforts cost nothing.
    groups = (
        with_margin(blocks, root / largest),
        *[with_margin(g, jnp.zeros_like(g.present)[None, None]) for g in others],
    )
    problem = EffortProblem(
        groups,
        program.rhs,
        program.dropped,
        program.radius,
        _REFINEMENTS[dtype.name],
        program.joined,
        guess,
        tuple(curvature_of(g) for g in groups),
    )
    return ScaledEffort(problem, margin, largest)


def apply_weights(forces: jax.Array, weights: jax.Array | None) -> jax.Array:
    """Q_0 f of forces (n, k, *lanes), with blocks or a full Q_0; None for the weights is Q_0 = I."""
    if weights is None:
        return forces
    if is_full(weights, len(forces)):
        return jnp.einsum("pq...,q...->p...", weights, forces.reshape(-1, *forces.shape[2:])).reshape(forces.shape)
    return jnp.einsum("nab...,nb...->na...", weights, forces)


def compute_effort(forces: jax.Array, weights: jax.Array | None) -> jax.Array:
    """1/2 f' Q_0 f of forces (n, k, *lanes)."""
    return 0.5 * fold(jnp.add, fold(jnp.add, forces * apply_weights(forces, weights)))


class Objective(ABC):
    """The objective of one of the two programs."""

    kappa: ClassVar[dict[str, float]]
    """The kappa of the central points whose derivatives stand for those of exact forces, in the solver's units."""

    @abstractmethod
    def problem(self, grasps: Grasps, program: ScaledProgram) -> tuple[BlockProblem, jax.Array]:
        """The problem, and the unit of its objective, (*lanes)."""

    @abstractmethod
    def forces_and_margin(self, x: Any, grasps: Grasps, program: ScaledProgram) -> tuple[Rows, jax.Array]:
        """The scaled forces and efforts of unknowns x, and the margin that belongs to them, (*lanes)."""


@dataclass(frozen=True)
class LargestMargin(Objective):
    """(21): max lambda."""

    # Many forces may be optimal; the term that selects one is of order kappa^2, which drowns in rounding below 1e-6.
    kappa = {"float64": 1e-6, "float32": 1e-4}

    def problem(self, grasps: Grasps, program: ScaledProgram) -> tuple[BlockProblem, jax.Array]:
        """(21), in units of the natural scale of margins."""
        return margin_problem(program), program.scale

    def forces_and_margin(self, x: Any, grasps: Grasps, program: ScaledProgram) -> tuple[Rows, jax.Array]:
        """The margin is an unknown."""
        blocks, margin = x
        return blocks, margin * program.scale


@dataclass(frozen=True)
class LeastEffort(Objective):
    """(22): min 1/2 f'Q_0 f, with the margin that the options ask for."""

    kappa = {"float64": 1e-8, "float32": 1e-5}

    def problem(self, grasps: Grasps, program: ScaledProgram) -> tuple[BlockProblem, jax.Array]:
        """(22), in units of the effort."""
        effort = effort_problem(grasps, program)
        return effort.problem, effort.unit**2

    def forces_and_margin(self, x: Any, grasps: Grasps, program: ScaledProgram) -> tuple[Rows, jax.Array]:
        """The margin is given."""
        assert grasps.options.margin is not None
        return x, grasps.options.margin
