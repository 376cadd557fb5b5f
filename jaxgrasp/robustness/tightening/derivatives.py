"""How the results of (21) and (22) vary with everything that they depend on.

The margin of (21) by the envelope theorem: d margin is the partial derivative of the Lagrangian

    lambda - z_1'(C f - S_1 lambda + d) - z_2'(-E f + S_2 lambda - f_max) - y'(G f - b)

with forces, margin and multipliers held. No linear system is solved, and the margin may be negative.

Everything else, and the margin itself where smoothing is asked for, by the implicit function theorem at a central point
u = (x, lambda, y, z), where F(u, data) = 0: F is the gradient of the Lagrangian

    L = objective + y'(E x - b) + sum_i z_i (a_i'x + sigma_i lambda - h_i)

with respect to u, but for kappa / z_i in the rows, which no data enter. K = dF/du is the symmetric matrix of
`solvers.block.sensitivity`, so a cotangent c of u becomes

    c'du = -m'dF,   K m = c,

with dF taken at u held. As F is a gradient, m'F is the derivative of L along m: a row r_i = a_i'x + sigma_i lambda -
h_i adds m_z r_i + z_i (a_i'm_x + sigma_i m_lambda), the equalities add m_y'(E x - b) + y'E m_x, and the objective of
(22) adds m_x'H x. From this follow the cotangents of the data, `RowWeights`:

    row value      -m_z                          sigma    -(m_z lambda + z m_lambda)
    b               m_y                          G        -(y m_x' + m_y x')
    Q_0            -1/2 (x m_x' + m_x x')        mu       -(m_z f_n + z m_n) times the facet's share of mu f_n

and (22)'s lambda, which is data there, gets -m_z'sigma. `reach_adjoint` takes S_1 and S_2 back to the grasps.

Without actuators both are written out and can be native kernels. JAX's transpose of the scaled program has operations
that kernels do not know: with it 16,384 margins and their gradients took 10.4 (float64) and 9.4 (float32) times as
long. With actuators it is used all the same.
"""

from dataclasses import dataclass, replace
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxgrasp.arrays import fold, literal
from jaxgrasp.contact.friction import contact_facets
from jaxgrasp.lanes.differentiable import Along, OfPyramids
from jaxgrasp.robustness.grasps import Grasps
from jaxgrasp.robustness.tightening.objectives import LargestMargin, LeastEffort, Objective, apply_weights
from jaxgrasp.robustness.tightening.points import Point, build_point, central_kappa, find_central_point, scale_point
from jaxgrasp.robustness.tightening.program import ScaledProgram, prepare, scale_program
from jaxgrasp.robustness.worst_case import reach_adjoint
from jaxgrasp.solvers.block.kkt import BlockProblem, total
from jaxgrasp.solvers.block.sensitivity import solve_symmetric
from jaxgrasp.solvers.interior_point import Iterate, reduce_rows
from jaxgrasp.solvers.small_matrices import flatten


class RowWeights(NamedTuple):
    """Cotangents of what the rows C f + h lambda + d <= 0 and -f_n + h lambda - f_max <= 0 are made of, h = -S_1, S_2.

    cone, bound: (n_e, n, *lanes), 2 n_e of soft contacts, and (n, *lanes), of the rows' values.
    cone_reach, bound_reach: of h, in the same shapes.
    friction: (n, *lanes), of mu in C.
    columns: (6, k, n, *lanes), of the blocks of G, moments as in `Grasps`.
    wrench: (6, *lanes), of b.
    weights: (n, k, k, *lanes) or (k n, k n, *lanes), of Q_0; None where there is none.
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
    """Find the gradient of (21)'s Lagrangian with respect to the data, times the cotangent (*lanes) of the margin."""
    weight = jnp.where(point.usable, cotangents[0], 0)
    if grasps.actuated is not None:
        return _lagrangian_gradient(cone_edges, grasps, point, weight)
    usable = lambda x: jnp.where(point.usable, x, 0)
    force, z_cone = usable(jnp.moveaxis(point.forces, 1, 0)), usable(jnp.moveaxis(point.cone_multipliers, 1, 0))
    z_cone, z_bound = -z_cone * weight * grasps.present, -usable(point.bound_multipliers) * weight * grasps.present
    y = usable(point.wrench_multipliers) * weight
    margin = usable(point.margin)
    normal = literal(contact_facets(cone_edges, len(force))[:, 2], force.dtype)[:, None, None]
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
    """Turn cotangents of the rows into those of the data."""
    zero = jax.tree.map(_zero_cotangent, grasps)
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
    assert grasps.reserve is not None
    reserve = rows.cone
    while reserve.ndim > grasps.reserve.ndim:
        reserve = fold(jnp.add, reserve)
    return replace(
        zero,
        friction=rows.friction + friction,
        max_force=-rows.bound,
        reserve=reserve,
        columns=rows.columns + columns,
        wrench=rows.wrench,
        terms=zero.terms if terms is None else terms,
    )


def _zero_cotangent(x: jax.Array) -> jax.Array | np.ndarray:
    return jnp.zeros_like(x) if jnp.issubdtype(x.dtype, jnp.floating) else np.zeros(x.shape, jax.dtypes.float0)


@dataclass(frozen=True)
class CentralPoint(OfPyramids):
    """The function that finds the central point next to a point of (21) or (22)."""

    objective: Objective
    """Which of the two programs it is."""

    @property
    def stages(self) -> tuple:
        """Scale the grasps, then find the point next to the one that is held."""
        return (lambda grasps, point: (*prepare(grasps, self.cone_edges), point), lambda scaled: self._find(*scaled))

    def _find(self, grasps: Grasps, program: ScaledProgram, point: Point) -> Point:
        problem, unit = self.objective.problem(grasps, program)
        start = scale_point(problem, program, point, unit, None)
        return find_central_point(self.objective, grasps, program, start, point.usable)

    def tangents(self, along: Along, out: Point) -> Point:
        """The derivative by the implicit function theorem."""
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


class _Units(NamedTuple):
    """Units of the solver in newtons: of forces (k, n, *lanes), of rows (m, n, *lanes), of the objective."""

    forces: jax.Array
    rows: jax.Array
    objective: jax.Array


def _central_adjoint(
    objective: Objective, cone_edges: int, with_terms: bool, grasps: Grasps, point: Point, cotangents: Point
) -> Grasps:
    """Turn cotangents of a central point into those of the data, by one solve with the symmetric matrix."""
    if grasps.actuated is not None:
        return _actuated_adjoint(objective, cone_edges, grasps, point, cotangents)
    program = scale_program(grasps, cone_edges)
    problem, unit = objective.problem(grasps, program)
    iterate = scale_point(problem, program, point, unit, central_kappa(objective, grasps, unit))
    where_usable = lambda x: None if x is None else jnp.where(point.usable, x, 0)
    forces = jnp.where(point.usable, point.forces, 0)
    units = _Units(program.force_units, program.row_units(), unit)
    ct = cotangents._replace(**{name: where_usable(part) for name, part in cotangents._asdict().items()})

    # K m = c.
    right, weights = _right_side(problem, program, grasps, forces, ct, units)
    (move_x,), move_lambda, move_y, (move_z,) = solve_symmetric(problem, iterate.s, iterate.z, right)

    # -m'dF: m and the point back in newtons, multipliers for an objective in the solver's unit.
    values = -move_z * grasps.present / units.rows
    z = iterate.z[0] / units.rows
    margin = jnp.where(point.usable, point.margin, 0)
    reach = values * margin
    if move_lambda is not None:
        reach = reach - z * (move_lambda * program.scale)
    force, move = jnp.moveaxis(forces, 1, 0), move_x * units.forces
    y = jnp.where(point.usable, point.wrench_multipliers, 0) / grasps.units / unit
    move_y = program.wrench_multipliers(move_y, jnp.ones_like(grasps.units))
    normal = literal(contact_facets(cone_edges, len(force))[:, 2], z.dtype)[:, None, None]
    asked = None
    if isinstance(objective, LeastEffort):
        # lambda is data, and H = Q_0 / unit in the stationarity of f.
        asked = total(values * problem.groups[0].sigma * units.rows) / program.scale
        asked = asked if ct.margin is None else asked + ct.margin
        a, b = (flatten(force), flatten(move)) if grasps.full_weights else (force, move)
        bend = -0.5 / unit * (a[:, None] * b + b[:, None] * a)
        bend = bend if grasps.full_weights else jnp.moveaxis(bend, 2, 0)
        weights = bend if weights is None else bend + weights
    rows = RowWeights(
        cone=values[:-1],
        bound=values[-1],
        cone_reach=reach[:-1],
        bound_reach=reach[-1],
        friction=fold(jnp.add, normal * (values[:-1] * force[2] - z[:-1] * move[2])),
        columns=-(y[:, None, None] * move + move_y[:, None, None] * force),
        wrench=move_y,
        weights=None if grasps.options.effort_weights is None else weights,
        margin=asked,
    )
    return _to_grasps(grasps, rows, cone_edges, with_terms)


def _right_side(
    problem: BlockProblem, program: ScaledProgram, grasps: Grasps, forces: jax.Array, ct: Point, units: _Units
) -> tuple[tuple, jax.Array | None]:
    """The cotangent c of the scaled (x, lambda, y, z), and what the effort's asks of Q_0 itself, shaped like it."""
    (group,) = problem.groups
    pull = jnp.zeros_like(forces) if ct.forces is None else ct.forces
    weights = None
    if ct.effort is not None:
        pull = pull + ct.effort * apply_weights(forces, grasps.options.effort_weights)
        if grasps.full_weights:
            flat = forces.reshape(-1, *forces.shape[2:])
            weights = 0.5 * ct.effort * flat[:, None] * flat
        else:
            weights = 0.5 * ct.effort * forces[:, :, None] * forces[:, None]
    right_x = jnp.moveaxis(pull, 1, 0) * units.forces * grasps.present
    none = jnp.zeros_like(group.h)
    cone = none[:-1] if ct.cone_multipliers is None else jnp.moveaxis(ct.cone_multipliers, 1, 0)
    bound = none[-1] if ct.bound_multipliers is None else ct.bound_multipliers
    right_z = jnp.concatenate([cone, bound[None]]) * units.objective / units.rows * grasps.present
    right_y, right_lambda = jnp.zeros_like(problem.rhs), None
    if ct.wrench_multipliers is not None:
        right_y = program.wrench_multipliers_adjoint(ct.wrench_multipliers, grasps.units) * units.objective
    if problem.bordered:
        right_lambda = jnp.zeros_like(units.objective) if ct.margin is None else ct.margin * program.scale
    return ((right_x,), right_lambda, right_y, (right_z,)), weights


def _lagrangian_gradient(cone_edges: int, grasps: Grasps, point: Point, weight: jax.Array) -> Grasps:
    """`envelope_adjoint` for a hand with actuators: JAX differentiates the Lagrangian of the scaled program."""
    program = scale_program(grasps, cone_edges)
    objective = LargestMargin()
    problem, unit = objective.problem(grasps, program)
    iterate = scale_point(problem, program, point, unit, None)

    def value(grasps: Grasps) -> jax.Array:
        moved = objective.problem(grasps, scale_program(grasps, cone_edges))[0]
        residuals = moved.residuals(iterate)
        terms = jax.tree.map(jnp.multiply, (iterate.z, iterate.y), (residuals.rows, residuals.primal))
        return -jnp.sum(weight * unit * reduce_rows(jnp.add, terms, weight.ndim))

    return jax.grad(value, allow_int=True)(grasps)


def _actuated_adjoint(objective: Objective, cone_edges: int, grasps: Grasps, point: Point, cotangents: Point) -> Grasps:
    """`_central_adjoint` for a hand with actuators: JAX differentiates m'F of the scaled program."""
    program = scale_program(grasps, cone_edges)
    problem, unit = objective.problem(grasps, program)
    iterate = scale_point(problem, program, point, unit, central_kappa(objective, grasps, unit))

    def read(grasps: Grasps, iterate: Iterate) -> Point:
        moved = build_point(objective, grasps, scale_program(grasps, cone_edges), iterate, unit, point.usable)
        return moved._replace(usable=None)

    out, pull = jax.vjp(read, grasps, iterate)
    usable = lambda ct, like: jnp.zeros_like(like) if ct is None else jnp.where(point.usable, ct, 0)
    ct = {name: usable(getattr(cotangents, name), like) for name, like in out._asdict().items() if like is not None}
    direct, back = pull(out._replace(**ct))
    right_x, right_lambda = back.x if problem.bordered else (back.x, None)
    move_x, move_lambda, move_y, move_z = solve_symmetric(
        problem, iterate.s, iterate.z, (right_x, right_lambda, back.y, back.z)
    )
    moves = ((move_x, move_lambda) if problem.bordered else move_x, move_y, move_z)

    def along_moves(grasps: Grasps) -> jax.Array:
        residuals = objective.problem(grasps, scale_program(grasps, cone_edges))[0].residuals(iterate)
        terms = jax.tree.map(jnp.multiply, moves, (residuals.dual, residuals.primal, residuals.rows))
        return -jnp.sum(jnp.where(point.usable, reduce_rows(jnp.add, terms, unit.ndim), 0))

    indirect = jax.grad(along_moves, allow_int=True)(grasps)
    return jax.tree.map(lambda a, b: a if a.dtype == jax.dtypes.float0 else a + b, direct, indirect)
