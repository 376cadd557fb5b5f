"""The scaled form of (21) and (22) that the solver sees.

Per contact with F = f_max: tangential forces in units of mu F, normal forces in units of F, so that all facet rows
become the same constants and forces are of order one. sigma = -Lambda S_1 / (mu F) and Lambda S_2 / F, with Lambda such
that the largest is 1: lambda = Lambda * lambda_hat. The six rows of G are orthonormalised, and rows that add nothing
are dropped.
"""

import math
from dataclasses import dataclass, field, replace
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from jaxgrasp.arrays import fold, literal
from jaxgrasp.contact.friction import pyramid_facets
from jaxgrasp.contact.row_space import RANK_TOLERANCE, Basis, whitened
from jaxgrasp.lanes.fence import fenced
from jaxgrasp.robustness.actuators import EffortRows, effort_unit, joined_rows, packed, unpacked
from jaxgrasp.robustness.grasps import Grasps
from jaxgrasp.robustness.worst_case import reach_outside, worst_rows
from jaxgrasp.solvers.block.kkt import Blocks, Record, Rows, total
from jaxgrasp.solvers.interior_point import Iterate

# Friction below this is scaled like this: tangential forces then stay below it in units of f_max, as good as none.
LEAST_FRICTION = {"float64": 1e-9, "float32": 1e-6}
# The most that dropping rows may turn those that are kept: as much as rows of an answer may be missed by.
_TURNED = 1e-7


class Equalities(NamedTuple):
    """Rows of G f = b, and of J'f - B u = 0, for scaled unknowns: forces in units of `Program.mean`.

    columns: (eq, k, n, *lanes) a group.
    wrench: (eq, *lanes), the right-hand side.
    """

    columns: Rows
    wrench: jax.Array

    def equality(self, x: Rows) -> jax.Array:
        """N x, (eq, *lanes)."""
        products = [total(jnp.moveaxis(c * x_g, 0, 2)) for c, x_g in zip(self.columns, x, strict=True)]
        return fold(jnp.add, products)


@jax.tree_util.register_dataclass
@dataclass(frozen=True, kw_only=True)
class Program:
    """Scaled data of a batch of grasps; lanes trail."""

    cone_edges: int = field(metadata={"static": True})
    """n_e."""
    columns: jax.Array
    """(eq, 3, n, *lanes), the orthonormal equality rows, those of G and of J'f - B u; zero where dropped or absent."""
    sigma: jax.Array
    """(n_e + 1, n, *lanes), what the disturbances take from the rows of C and E, scaled."""
    h: jax.Array
    """(n_e + 1, n, *lanes), right-hand sides."""
    present: jax.Array
    """(n, *lanes), 1 or 0."""
    rhs: jax.Array
    """(eq, *lanes), coordinates of b in the orthonormal rows; zero where dropped."""
    dropped: jax.Array
    """(eq, *lanes), 1 where a row was dropped."""
    scale: jax.Array
    """Lambda, (*lanes), N per unit of disturbance."""
    tangential: jax.Array
    """mu F, (n, *lanes), N."""
    normal: jax.Array
    """F, (n, *lanes), N."""
    given: "Equalities"
    """The equality rows as they came, before `columns` were made of them."""
    basis: Basis
    """Row operations from the rows in newtons to the orthonormal ones, for forces in units of `mean`."""
    mean: jax.Array
    """Mean of F, (*lanes), N."""
    rank: jax.Array
    """Rank of G, (*lanes)."""
    least_ratio: jax.Array
    """What was left of the shortest row of G that counts, in lengths of the longest, (*lanes)."""
    doubtful: jax.Array
    """bool (*lanes): the rank cannot be told, see `_doubtful`."""
    undisturbed: jax.Array
    """bool (*lanes): S_1 = S_2 = 0."""
    disturbance_outside: jax.Array
    """bool (*lanes): the set has wrenches outside the range of G."""
    wrench_outside: jax.Array
    """bool (*lanes): b is outside the range of G."""
    slippery: jax.Array
    """bool (*lanes): a contact without friction has to bear tangential force, so the margin cannot be positive."""

    efforts: EffortRows | None
    """What the actuators add."""
    joint_sizes: jax.Array | None
    """(n_v, *lanes), what the rows of J'f - B u were divided by."""

    @property
    def groups(self) -> tuple[Blocks, ...]:
        """The contacts, and the actuators where there are any."""
        return (self.blocks,) if self.efforts is None else (self.blocks, self.efforts.blocks)

    @property
    def blocks(self) -> Blocks:
        """Contacts with their rows: n_e facets, then the bound on the normal force."""
        patterns = np.concatenate([pyramid_facets(self.cone_edges), [[0.0, 0.0, -1.0]]])
        return Blocks(
            patterns=literal(patterns, self.h.dtype),
            columns=self.columns,
            sigma=self.sigma,
            h=self.h,
            present=self.present,
            hessian=None,
            start=literal(np.array([0.0, 0.0, -0.6]), self.h.dtype),
        )

    @property
    def radius(self) -> float:
        """|x|_inf <= 1 + radius * max(0, -lambda_hat) at the optimum."""
        return 1 + 1 / math.cos(math.pi / self.cone_edges)

    def forces(self, x: jax.Array) -> jax.Array:
        """Contact forces (n, 3, *lanes), N, from scaled ones (3, n, *lanes)."""
        return jnp.stack([x[0] * self.tangential, x[1] * self.tangential, x[2] * self.normal], 1)

    def row_units(self) -> jax.Array:
        """What one unit of every scaled row is in newtons, (n_e + 1, n, *lanes)."""
        edges = jnp.broadcast_to(self.tangential, (self.cone_edges, *self.tangential.shape))
        return jnp.concatenate([edges, self.normal[None]])

    def wrench_multipliers(self, y: jax.Array, units: jax.Array) -> jax.Array:
        """Multipliers of G f = b (6, *lanes) from those of the orthonormal rows, per unit of the scaled objective."""
        return self.row_multipliers(y)[:6] / self.mean * units

    def joint_multipliers(self, y: jax.Array, units: jax.Array) -> jax.Array:
        """The same of J'f - B u = 0, (n_v, *lanes), where there are actuators."""
        assert self.joint_sizes is not None
        return self.row_multipliers(y)[6:] / self.mean / self.joint_sizes * units[5]

    def row_multipliers(self, y: jax.Array) -> jax.Array:
        """T'y, (eq, *lanes): multipliers of the rows as they came from those of the orthonormal ones."""
        kept = self.basis.kept * y
        return fold(jnp.add, [row * k for row, k in zip(self.basis.operations, kept, strict=True)])

    def wrench_multipliers_adjoint(self, y: jax.Array, units: jax.Array) -> jax.Array:
        """The transpose of `wrench_multipliers`."""
        y = y * units / self.mean
        return fold(jnp.add, [self.basis.operations[:, c] * y[c] for c in range(6)]) * self.basis.kept


def scaled_program(grasps: Grasps, cone_edges: int) -> Program:
    """Scale the programs of a batch of grasps."""
    present, dtype = grasps.present, grasps.present.dtype
    cone, bound, effort, basis = worst_rows(grasps, cone_edges)
    tangential = jnp.maximum(grasps.friction, LEAST_FRICTION[dtype.name]) * grasps.max_force
    normal = grasps.max_force

    @fenced
    def scale_rows(
        cone: jax.Array,
        bound: jax.Array,
        effort: jax.Array | None,
        tangential: jax.Array,
        normal: jax.Array,
        reserve: jax.Array,
    ) -> tuple:
        sigmas = [jnp.concatenate([cone / tangential, (bound / normal)[None]])]
        if effort is not None:
            sigmas.append(effort)
        largest = fold(jnp.maximum, [fold(jnp.maximum, fold(jnp.maximum, sigma)) for sigma in sigmas])
        undisturbed = largest == 0
        # A choice of units, like the mean below: no derivative depends on it.
        scale = lax.stop_gradient(1 / jnp.where(undisturbed, 1, largest))
        ones = [present, 1]
        sigmas = [jnp.where(undisturbed, one, sigma * scale) for one, sigma in zip(ones, sigmas, strict=False)]
        # What is left of a zero after rounding is a zero.
        sigmas = [jnp.where(sigma > 8 * jnp.finfo(dtype).eps, sigma, 0) for sigma in sigmas]
        lost = jnp.where(present > 0, -reserve / tangential, 1)
        h = jnp.concatenate([jnp.broadcast_to(lost, cone.shape), jnp.ones_like(bound)[None]])
        return sigmas, h, scale, undisturbed

    unit = None if grasps.actuated is None else effort_unit(grasps.actuated)
    effort = None if effort is None or unit is None else effort / unit
    sigmas, h, scale, undisturbed = scale_rows(cone, bound, effort, tangential, normal, grasps.reserve)
    mean = fold(jnp.add, normal * present) / jnp.maximum(fold(jnp.add, present), 1)
    mean = lax.stop_gradient(jnp.where(mean > 0, mean, 1))
    scales = jnp.stack([tangential, tangential, normal]) / mean
    wrench = grasps.wrench / mean
    if grasps.actuated is None or unit is None:
        given = (grasps.columns * scales,)
        rows = whitened(given[0])
        columns, efforts, sizes = rows.rows, None, None
    else:
        joined = joined_rows(grasps.actuated, grasps.columns * scales, scales, unit / mean)
        rows, sizes, given = whitened(packed(joined)), joined.sizes, (joined.forces, joined.efforts)
        columns, effort_columns = unpacked(rows.rows, present.shape[0], unit.shape[0])
        limits = jnp.stack([grasps.actuated.upper, -grasps.actuated.lower]) / unit
        efforts = EffortRows(effort_columns, sigmas[1], limits, unit)
        wrench = jnp.concatenate([wrench, jnp.zeros_like(sizes)])
    coordinates, kept = rows.coordinates(wrench), rows.kept
    largest = fold(jnp.maximum, jnp.abs(wrench))
    tolerance = 10 * RANK_TOLERANCE[dtype.name]
    outside = fold(jnp.maximum, jnp.abs(coordinates) * (1 - kept)) > tolerance * largest
    reach = reach_outside(grasps, basis)
    return Program(
        cone_edges=cone_edges,
        columns=columns,
        sigma=sigmas[0],
        h=h,
        present=present,
        rhs=coordinates * kept,
        dropped=1 - kept,
        scale=scale,
        tangential=tangential,
        normal=normal,
        given=Equalities(given, wrench),
        basis=rows,
        mean=mean,
        rank=fold(jnp.add, basis.kept[:6]).astype(jnp.int32),
        least_ratio=fold(jnp.minimum, jnp.where(basis.kept > 0, basis.ratios, 1)[:6]),
        doubtful=_doubtful(grasps, basis, reach, tolerance),
        undisturbed=undisturbed,
        disturbance_outside=reach > tolerance,
        wrench_outside=outside,
        slippery=((grasps.friction <= 0) & (fold(jnp.maximum, cone) > 0)).any(0),
        efforts=efforts,
        joint_sizes=sizes,
    )


def prepared(grasps: Grasps, cone_edges: int) -> tuple[Grasps, Program]:
    """The programs, and what else of the grasps is needed to solve them: not the disturbance set."""
    return replace(grasps, terms=(), extents=()), scaled_program(grasps, cone_edges)


def actuated_values(
    program: Program, x: Rows, multipliers: Record | Iterate, units: jax.Array, unit: jax.Array
) -> dict[str, jax.Array]:
    """The part of a solution that comes with actuators: efforts, and multipliers for an objective in `unit`."""
    if program.efforts is None:
        return {}
    return {
        "actuator_efforts": x[1][0] * program.efforts.unit,
        "actuator_multipliers": jnp.moveaxis(multipliers.z[1] / program.efforts.unit, 0, 1) * unit,
        "joint_multipliers": program.joint_multipliers(multipliers.y, units) * unit,
    }


def _doubtful(grasps: Grasps, basis: Basis, reach: jax.Array, tolerance: float) -> jax.Array:
    """Where the rank cannot be told, or what is in the range, or rounding makes much of a short row.

    Dropping a row turns those that are kept by its length over that of the shortest one. Rows are taken in their order:
    beside a short one, what is left of a row that depends on it is rounding, eps over the short one's length. So in
    float64 the rank is in doubt where two rows are so short that one may be rounding, or where a dropped row that is
    more than rounding turns the others by more than 1e-7.

    In float32 a row that is nearly dependent makes S_1 and S_2 wrong by eps over what was left of it. One that was
    dropped may be dependent or not, unless the contacts themselves say so: all on one line, to the last bit. A
    disturbance set that leaves the range by little more than rounding has margin 0, or none of it at all. Rows of
    joints that no actuator reaches are dependent where they look so.
    """
    ratios, kept = basis.ratios, basis.kept > 0
    if ratios.dtype == jnp.float64:
        least = second = jnp.ones_like(ratios[0])
        for ratio in jnp.where(kept, ratios, 1)[:6]:
            least, second = jnp.minimum(least, ratio), jnp.minimum(second, jnp.maximum(least, ratio))
        most = fold(jnp.maximum, jnp.where(kept, 0, ratios)[:6])
        rounding = 16 * jnp.finfo(ratios.dtype).eps
        dependent = (most * least <= rounding) & (least > 1e-8)
        return (least * second <= rounding) | (most > _TURNED * least) & ~dependent
    short = (kept[:6] & (ratios[:6] < 3e-3)).any(0)
    doubtful = short | (~kept[:6].all(0) & ~grasps.lined)
    doubtful |= (reach > 64 * jnp.finfo(reach.dtype).eps) & (reach <= tolerance)
    return doubtful if len(ratios) == 6 else doubtful | ((ratios[6:] > 1e-5) & (ratios[6:] < 1e-3)).any(0)
