"""Points of (21) and (22) with their multipliers: in newtons and metres, and as iterates of the solver."""

from typing import NamedTuple

import jax
import jax.numpy as jnp

from jaxgrasp.robustness.grasps import Grasps
from jaxgrasp.robustness.tightening.objectives import Objective, compute_effort
from jaxgrasp.robustness.tightening.program import ScaledProgram, actuated_values, force_units
from jaxgrasp.solvers.block.kkt import BlockProblem, adjoint_rows, apply_hessian, apply_rows
from jaxgrasp.solvers.block.sensitivity import central_point
from jaxgrasp.solvers.interior_point import Iterate

# The largest residual with which a central point counts as found, in the solver's units.
_CENTRE_TOLERANCE = {"float64": 1e-9, "float32": 1e-4}


class Point(NamedTuple):
    """A point of (21) or (22) with multipliers, in newtons and metres as in `Solution`; lanes trail or lead."""

    margin: jax.Array
    forces: jax.Array
    effort: jax.Array
    cone_multipliers: jax.Array
    bound_multipliers: jax.Array
    wrench_multipliers: jax.Array
    usable: jax.Array
    """bool (*lanes), whether the lane has such a point."""
    actuator_efforts: jax.Array | None = None
    actuator_multipliers: jax.Array | None = None
    joint_multipliers: jax.Array | None = None


def central_kappa(objective: Objective, grasps: Grasps, unit: jax.Array) -> jax.Array:
    """The product s z of every row at the central point, (*lanes), for an objective in the given unit."""
    if grasps.options.smoothing is not None:
        return grasps.options.smoothing / unit
    return jnp.full_like(grasps.length, objective.kappa[grasps.length.dtype.name])


def find_central_point(
    objective: Objective, grasps: Grasps, program: ScaledProgram, start: Iterate, active: jax.Array
) -> Point:
    """Find the central point by Newton's method from a start near by."""
    problem, unit = objective.problem(grasps, program)
    kappa = central_kappa(objective, grasps, unit)
    centre = central_point(problem, start, kappa, active)
    found = active & (centre.error <= _CENTRE_TOLERANCE[kappa.dtype.name])
    return build_point(objective, grasps, program, centre.iterate, unit, found)


def build_point(
    objective: Objective, grasps: Grasps, program: ScaledProgram, iterate: Iterate, unit: jax.Array, usable: jax.Array
) -> Point:
    """Turn a scaled iterate into newtons and metres, for an objective in the given unit."""
    blocks, margin = objective.forces_and_margin(iterate.x, grasps, program)
    forces = program.forces(blocks[0]) * grasps.present[:, None]
    multipliers = iterate.z[0] * unit / program.row_units()
    actuated = actuated_values(program, blocks, iterate, grasps.units, unit)
    return Point(
        margin=margin,
        forces=forces,
        effort=compute_effort(forces, grasps.options.effort_weights),
        cone_multipliers=jnp.moveaxis(multipliers[:-1], 0, 1),
        bound_multipliers=multipliers[-1],
        wrench_multipliers=program.wrench_multipliers(iterate.y, grasps.units) * unit,
        usable=usable,
        **actuated,
    )


def scale_point(
    problem: BlockProblem, program: ScaledProgram, point: Point, unit: jax.Array, kappa: jax.Array | None
) -> Iterate:
    """Turn a point into a scaled iterate, with harmless numbers in lanes that have none.

    The slacks s follow from s z = kappa, or from the rows where kappa is None.
    """
    usable = lambda x, other: jnp.where(point.usable, x, other)
    forces = usable(jnp.moveaxis(point.forces, 1, 0), 0) * program.present
    x = [forces / force_units(program.tangential, program.normal, len(forces))]
    z = jnp.concatenate([jnp.moveaxis(point.cone_multipliers, 1, 0), point.bound_multipliers[None]])
    z = [usable(z * program.row_units() / unit, 1) * program.present]
    if program.actuators is not None:
        assert point.actuator_multipliers is not None
        x.append((usable(point.actuator_efforts, 0) / program.actuators.unit)[None])
        z.append(usable(jnp.moveaxis(point.actuator_multipliers, 1, 0) * program.actuators.unit / unit, 1))
    lam = usable(point.margin, 0) / program.scale
    s, pull = [], []
    for group, x_g, z_g in zip(problem.groups, x, z, strict=True):
        if kappa is None:
            slack = group.h - apply_rows(group, x_g) - (group.sigma * lam if problem.bordered else 0)
        else:
            slack = kappa / jnp.where(group.present > 0, z_g, 1)
        s.append(jnp.where(group.present > 0, usable(slack, 1), 1))
        stationary = adjoint_rows(group, z_g)
        pull.append(stationary if group.hessian_root is None else stationary + apply_hessian(group, x_g))
    blocks, y = tuple(x), problem.balancing(tuple(pull))
    return Iterate((blocks, lam) if problem.bordered else blocks, y, tuple(s), tuple(z))
