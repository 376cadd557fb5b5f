"""How the answers of (21) and (22) vary with everything that they depend on.

The margin of (21) by the envelope theorem: d margin is the partial derivative of the Lagrangian

    lambda - z_1'(C f_0 - S_1 lambda + d) - z_2'(-E f_0 + S_2 lambda - f_max) - y'(G f_0 - b)

with forces, margin and multipliers held: no linear system is solved, and the margin may be negative. Everything else,
and the margin itself where smoothing is asked for, by the implicit function theorem at a central point, see
`sensitivity`.
"""

from dataclasses import dataclass, replace
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxgrasp.arrays import fold, literal
from jaxgrasp.contact.friction import pyramid_facets
from jaxgrasp.lanes.differentiable import Along, OfPyramids
from jaxgrasp.robustness.grasps import Grasps
from jaxgrasp.robustness.tightening.objectives import LargestMargin, LeastEffort, Objective, weighed
from jaxgrasp.robustness.tightening.points import Point, central_kappa, centred, iterate_of, point_of
from jaxgrasp.robustness.tightening.program import ScaledProgram, prepare, scale_program
from jaxgrasp.robustness.worst_case import reach_adjoint
from jaxgrasp.solvers.block.kkt import total
from jaxgrasp.solvers.block.sensitivity import solve_symmetric
from jaxgrasp.solvers.interior_point import Iterate, reduce_rows


class RowWeights(NamedTuple):
    """What a cotangent asks of the rows: of C f + h lambda + d and -f_n + h lambda - f_max, with h = -S_1 or S_2.

    cone, bound: (n_e, n, *lanes) and (n, *lanes), of the rows' values.
    cone_reach, bound_reach: the same, of h.
    friction: (n, *lanes).
    columns: (6, 3, n, *lanes), of the blocks of G, moments as in `Grasps`.
    wrench: (6, *lanes), of b.
    weights: (n, 3, 3, *lanes), of Q_0; None where there is none.
    margin: (*lanes), of the margin that is asked for; None where none is.
    """

    cone: jax.Array
    bound: jax.Array
    cone_reach: jax.Array
    bound_reach: jax.Array
    friction: jax.Array
    columns: jax.Array
    wrench: jax.Array
    weights: jax.Array | None = None
    margin: jax.Array | None = None


def envelope_adjoint(cone_edges: int, with_terms: bool, grasps: Grasps, point: Point, cotangents: tuple) -> Grasps:
    """The gradient of (21)'s Lagrangian with respect to the data, times a cotangent (*lanes)."""
    weight = jnp.where(point.usable, cotangents[0], 0)
    if grasps.actuated is not None:
        return _lagrangian_gradient(cone_edges, grasps, point, weight)
    clean = lambda x: jnp.where(point.usable, x, 0)
    force, z_cone = clean(jnp.moveaxis(point.forces, 1, 0)), clean(jnp.moveaxis(point.cone_multipliers, 1, 0))
    z_cone, z_bound = -z_cone * weight * grasps.present, -clean(point.bound_multipliers) * weight * grasps.present
    y = clean(point.wrench_multipliers) * weight
    margin = clean(point.margin)
    normal = literal(pyramid_facets(cone_edges)[:, 2], force.dtype)[:, None, None]
    rows = RowWeights(
        cone=z_cone,
        bound=z_bound,
        cone_reach=z_cone * margin,
        bound_reach=z_bound * margin,
        friction=fold(jnp.add, z_cone * normal) * force[2],
        columns=-(y / grasps.units)[:, None, None] * force,
        wrench=y / grasps.units,
    )
    return _to_grasps(grasps, rows, cone_edges, with_terms)


def _to_grasps(grasps: Grasps, rows: RowWeights, cone_edges: int, with_terms: bool) -> Grasps:
    """Cotangents of the data, from those of the rows."""
    zero = jax.tree.map(_nothing, grasps)
    columns, friction, inverse_root, terms = reach_adjoint(
        grasps, rows.cone_reach, rows.bound_reach, cone_edges, with_terms
    )
    if grasps.vertex_inverse_roots is not None:
        zero = replace(zero, vertex_inverse_roots=inverse_root)
    elif grasps.inverse_root is not None:
        zero = replace(zero, inverse_root=inverse_root)
    if rows.weights is not None:
        zero = replace(zero, options=replace(zero.options, effort_weights=rows.weights))
    if rows.margin is not None:
        zero = replace(zero, options=replace(zero.options, margin=rows.margin))
    return replace(
        zero,
        friction=rows.friction + friction,
        max_force=-rows.bound,
        reserve=fold(jnp.add, fold(jnp.add, rows.cone)),
        columns=rows.columns + columns,
        wrench=rows.wrench,
        terms=zero.terms if terms is None else terms,
    )


def _nothing(x: jax.Array) -> jax.Array | np.ndarray:
    return jnp.zeros_like(x) if jnp.issubdtype(x.dtype, jnp.floating) else np.zeros(x.shape, jax.dtypes.float0)


@dataclass(frozen=True)
class CentralPoint(OfPyramids):
    """The kernel that finds the central point next to a point of (21) or (22)."""

    objective: Objective
    """Which of the two programs it is."""

    @property
    def stages(self) -> tuple:
        """See `Kernel`; the point is held."""
        return (lambda grasps, point: (*prepare(grasps, self.cone_edges), point), lambda given: self._find(*given))

    def _find(self, grasps: Grasps, program: ScaledProgram, point: Point) -> Point:
        problem, unit = self.objective.problem(grasps, program)
        return centred(self.objective, grasps, program, iterate_of(problem, program, point, unit, None), point.usable)

    def tangents(self, along: Along, out: Point) -> Point:
        """See `Kernel`."""
        adjoint = partial(_central_adjoint, self.objective, self.cone_edges, set_changes(along))
        return along.adjoint(adjoint, out, out._replace(usable=None), is_compact(along))


def set_changes(along: Along) -> bool:
    """Whether the disturbance set changes."""
    return bool(jax.tree.leaves(along.changes.data.disturbances))


def is_compact(along: Along) -> bool:
    """Whether the adjoints below are free of library calls and large reductions, see `Along.adjoint`.

    With respect to the disturbance set there are reductions, and what comes with actuators is JAX's own transpose.
    """
    return along.arguments.data.actuation is None and not set_changes(along)


def _central_adjoint(
    objective: Objective, cone_edges: int, with_terms: bool, grasps: Grasps, point: Point, cotangents: Point
) -> Grasps:
    """From cotangents of a central point to those of the data: one solve with the symmetric matrix."""
    if grasps.actuated is not None:
        return _actuated_adjoint(objective, cone_edges, grasps, point, cotangents)
    program = scale_program(grasps, cone_edges)
    problem, unit = objective.problem(grasps, program)
    (group,), kappa = problem.groups, central_kappa(objective, grasps, unit)
    iterate = iterate_of(problem, program, point, unit, kappa)
    (z,), (s,) = iterate.z, iterate.s
    forces = jnp.where(point.usable, point.forces, 0)
    scales = jnp.stack([program.tangential, program.tangential, program.normal])
    row_units = program.row_units()
    given = lambda ct: None if ct is None else jnp.where(point.usable, ct, 0)
    ct = cotangents._replace(**{name: given(part) for name, part in cotangents._asdict().items()})

    pull = jnp.zeros_like(forces) if ct.forces is None else ct.forces
    effort_weights = None
    if ct.effort is not None:
        pull = pull + ct.effort * weighed(forces, grasps.options.effort_weights)
        effort_weights = 0.5 * ct.effort * forces[:, :, None] * forces[:, None]
    right_x = jnp.moveaxis(pull, 1, 0) * scales * grasps.present
    cone = jnp.zeros_like(z[:-1]) if ct.cone_multipliers is None else jnp.moveaxis(ct.cone_multipliers, 1, 0)
    bound = jnp.zeros_like(z[-1]) if ct.bound_multipliers is None else ct.bound_multipliers
    right_z = jnp.concatenate([cone, bound[None]]) * unit / row_units * grasps.present
    right_y, right_lambda = jnp.zeros_like(problem.rhs), None
    if ct.wrench_multipliers is not None:
        right_y = program.wrench_multipliers_adjoint(ct.wrench_multipliers, grasps.units) * unit
    if problem.bordered:
        right_lambda = jnp.zeros_like(unit) if ct.margin is None else ct.margin * program.scale
    right = ((right_x,), right_lambda, right_y, (right_z,))
    (move_x,), move_lambda, move_y, (values,) = solve_symmetric(problem, (s,), (z,), right)

    # Back in newtons: forces, margin, and multipliers for an objective in the solver's unit.
    values = -values * grasps.present / row_units
    z = z / row_units
    margin = jnp.where(point.usable, point.margin, 0)
    reach = values * margin
    if move_lambda is not None:
        reach = reach - z * (move_lambda * program.scale)
    force, move = jnp.moveaxis(forces, 1, 0), move_x * scales
    y = jnp.where(point.usable, point.wrench_multipliers, 0) / grasps.units / unit
    move_y = program.wrench_multipliers(move_y, jnp.ones_like(grasps.units))
    normal = literal(pyramid_facets(cone_edges)[:, 2], z.dtype)[:, None, None]
    asked = None
    if isinstance(objective, LeastEffort):
        asked = total(values * group.sigma * row_units) / program.scale
        asked = asked if ct.margin is None else asked + ct.margin
        bend = -0.5 / unit * (force[:, None] * move + move[:, None] * force)
        bend = jnp.moveaxis(bend, 2, 0)
        effort_weights = bend if effort_weights is None else bend + effort_weights
    rows = RowWeights(
        cone=values[:-1],
        bound=values[-1],
        cone_reach=reach[:-1],
        bound_reach=reach[-1],
        friction=fold(jnp.add, normal * (values[:-1] * force[2] - z[:-1] * move[2])),
        columns=-(y[:, None, None] * move + move_y[:, None, None] * force),
        wrench=move_y,
        weights=None if grasps.options.effort_weights is None else effort_weights,
        margin=asked,
    )
    return _to_grasps(grasps, rows, cone_edges, with_terms)


def _lagrangian_gradient(cone_edges: int, grasps: Grasps, point: Point, weight: jax.Array) -> Grasps:
    """`envelope_adjoint` for a hand, through the scaled program by JAX's own hand."""
    program = scale_program(grasps, cone_edges)
    objective = LargestMargin()
    problem, unit = objective.problem(grasps, program)
    iterate = iterate_of(problem, program, point, unit, None)

    def value(grasps: Grasps) -> jax.Array:
        moved = objective.problem(grasps, scale_program(grasps, cone_edges))[0]
        residuals = moved.residuals(iterate)
        terms = jax.tree.map(jnp.multiply, (iterate.z, iterate.y), (residuals.rows, residuals.primal))
        return -jnp.sum(weight * unit * reduce_rows(jnp.add, terms, weight.ndim))

    return jax.grad(value, allow_int=True)(grasps)


def _actuated_adjoint(objective: Objective, cone_edges: int, grasps: Grasps, point: Point, cotangents: Point) -> Grasps:
    """`_central_adjoint` for a hand, through the scaled program by JAX's own hand."""
    program = scale_program(grasps, cone_edges)
    problem, unit = objective.problem(grasps, program)
    iterate = iterate_of(problem, program, point, unit, central_kappa(objective, grasps, unit))

    def read(grasps: Grasps, iterate: Iterate) -> Point:
        moved = point_of(objective, grasps, scale_program(grasps, cone_edges), iterate, unit, point.usable)
        return moved._replace(usable=None)

    out, pull = jax.vjp(read, grasps, iterate)
    given = lambda ct, like: jnp.zeros_like(like) if ct is None else jnp.where(point.usable, ct, 0)
    known = {name: given(getattr(cotangents, name), like) for name, like in out._asdict().items() if like is not None}
    direct, back = pull(out._replace(**known))
    right_x, right_lambda = back.x if problem.bordered else (back.x, None)
    move_x, move_lambda, move_y, move_z = solve_symmetric(
        problem, iterate.s, iterate.z, (right_x, right_lambda, back.y, back.z)
    )
    moves = ((move_x, move_lambda) if problem.bordered else move_x, move_y, move_z)

    def lack(grasps: Grasps) -> jax.Array:
        residuals = objective.problem(grasps, scale_program(grasps, cone_edges))[0].residuals(iterate)
        terms = jax.tree.map(jnp.multiply, moves, (residuals.dual, residuals.primal, residuals.rows))
        return -jnp.sum(jnp.where(point.usable, reduce_rows(jnp.add, terms, unit.ndim), 0))

    indirect = jax.grad(lack, allow_int=True)(grasps)
    return jax.tree.map(lambda a, b: a if a.dtype == jax.dtypes.float0 else a + b, direct, indirect)
