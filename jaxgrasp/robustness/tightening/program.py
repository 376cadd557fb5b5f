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
from jaxgrasp.contact.contacts import LEAST_FRICTION
from jaxgrasp.contact.friction import contact_facets
from jaxgrasp.contact.row_space import RANK_TOLERANCE, Basis, whitened
from jaxgrasp.lanes.fence import fenced, in_loops
from jaxgrasp.robustness.actuators import (
    ActuatorRows,
    HandBasis,
    JoinedRows,
    actuator_unit,
    join_rows,
    pack,
    unpack,
    whiten_efforts,
)
from jaxgrasp.robustness.grasps import Grasps
from jaxgrasp.robustness.worst_case import RowLosses, reach_outside, worst_rows
from jaxgrasp.solvers.block.joined import Joined
from jaxgrasp.solvers.block.kkt import Blocks, Record, Rows, total
from jaxgrasp.solvers.interior_point import Iterate

# The most that dropping rows may turn those that are kept: as much as rows of an answer may be missed by.
_MOST_TURNED = 1e-7


class Equalities(NamedTuple):
    """Rows of G f = b, and of J'f - B u = 0, for scaled unknowns: forces in units of `ScaledProgram.mean`.

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
class ScaledProgram:
    """Scaled data of a batch of grasps; lanes trail."""

    cone_edges: int = field(metadata={"static": True})
    """n_e."""
    columns: jax.Array
    """(eq, k, n, *lanes), the orthonormal equality rows, those of G and of J'f - B u; zero where dropped or absent."""
    sigma: jax.Array
    """(m, n, *lanes), what the disturbances take from the rows, scaled; m = n_e + 1, of soft contacts 2 n_e + 1."""
    h: jax.Array
    """(m, n, *lanes), right-hand sides."""
    present: jax.Array
    """(n, *lanes), 1 or 0."""
    rough: jax.Array
    """(n, *lanes), 1 where there is friction, else 0."""
    turning: jax.Array | None
    """(n, *lanes), 1 where a contact bears a moment, else 0; None for hard contacts."""
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
    original: Equalities
    """The equality rows before `columns` were made of them."""
    basis: Basis | HandBasis
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
    actuators: ActuatorRows | None
    """What the actuators add; None where there are none."""
    joint_sizes: jax.Array | None
    """(n_v, *lanes), what the rows of J'f - B u were divided by; None without actuators."""

    @property
    def joined(self) -> Joined | None:
        """The layout of E where the rows of J'f - B u stand below those of G; None where all rows are orthonormal."""
        return Joined(6) if isinstance(self.basis, HandBasis) else None

    @property
    def groups(self) -> tuple[Blocks, ...]:
        """The contacts, and the actuators where there are any."""
        return (self.blocks,) if self.actuators is None else (self.blocks, self.actuators.blocks)

    @property
    def blocks(self) -> Blocks:
        """Contacts with their rows: the facets, then the bound on the normal force."""
        components = self.columns.shape[1]
        bound = np.array([[0.0, 0.0, -1.0, 0.0][:components]])
        patterns = np.concatenate([contact_facets(self.cone_edges, components), bound])
        return Blocks(
            patterns=literal(patterns, self.h.dtype),
            columns=self.columns,
            sigma=self.sigma,
            h=self.h,
            present=self.present,
            hessian_root=None,
            start=literal(0.6 * bound[0], self.h.dtype),
        )

    @property
    def radius(self) -> float:
        """|x|_inf <= 1 + radius * max(0, -lambda_hat) at the optimum."""
        return 1 + 1 / math.cos(math.pi / self.cone_edges)

    @property
    def force_units(self) -> jax.Array:
        """What scaled forces are worth, (k, n, *lanes), N: along the normal F, else mu F, 0 without friction."""
        tangential = self.tangential * self.rough
        turning = [] if self.turning is None else [self.tangential * self.turning]
        return jnp.stack([tangential, tangential, self.normal, *turning])

    def forces(self, x: jax.Array) -> jax.Array:
        """Turn scaled forces (k, n, *lanes) into contact forces (n, k, *lanes), N."""
        return jnp.swapaxes(x * self.force_units, 0, 1)

    def row_units(self) -> jax.Array:
        """The unit of every scaled row, (m, n, *lanes), N."""
        edges = jnp.broadcast_to(self.tangential, (self.h.shape[0] - 1, *self.tangential.shape))
        return jnp.concatenate([edges, self.normal[None]])

    def wrench_multipliers(self, y: jax.Array, units: jax.Array) -> jax.Array:
        """Turn multipliers of the orthonormal rows into those of G f = b, (6, *lanes), for the scaled objective."""
        return self.row_multipliers(y)[:6] / self.mean * units

    def joint_multipliers(self, y: jax.Array, units: jax.Array) -> jax.Array:
        """Turn multipliers of the orthonormal rows into those of J'f - B u = 0, (n_v, *lanes); with actuators alone."""
        assert self.joint_sizes is not None
        return self.row_multipliers(y)[6:] / self.mean / self.joint_sizes * units[5]

    def row_multipliers(self, y: jax.Array) -> jax.Array:
        """T'y, (eq, *lanes): the multipliers of the original rows that belong to those of the orthonormal ones."""
        return self.basis.multipliers(y)

    def wrench_multipliers_adjoint(self, y: jax.Array, units: jax.Array) -> jax.Array:
        """The transpose of `wrench_multipliers`."""
        assert isinstance(self.basis, Basis)
        y = y * units / self.mean
        return fold(jnp.add, [self.basis.operations[:, c] * y[c] for c in range(6)]) * self.basis.kept


def force_units(tangential: jax.Array, normal: jax.Array, components: int) -> jax.Array:
    """The units of the components of contact forces, (k, n, *lanes)."""
    return jnp.stack([tangential, tangential, normal, tangential][:components])


def scale_program(grasps: Grasps, cone_edges: int) -> ScaledProgram:
    """Scale the programs of a batch of grasps."""
    present, dtype = grasps.present, grasps.present.dtype
    losses = worst_rows(grasps, cone_edges)

    # Inequality rows: forces in units of the most that a contact exerts, actuator efforts in units of their limits.
    tangential = jnp.maximum(grasps.friction, LEAST_FRICTION[dtype.name]) * grasps.max_force
    normal = grasps.max_force
    unit = None if grasps.actuated is None else actuator_unit(grasps.actuated)
    rows = _scale_rows(grasps, losses, tangential, unit)

    # Equality rows: in newtons over the mean largest force, then orthonormal. No derivative depends on the mean.
    mean = fold(jnp.add, normal * present) / jnp.maximum(fold(jnp.add, present), 1)
    mean = lax.stop_gradient(jnp.where(mean > 0, mean, 1))
    scales = force_units(tangential, normal, grasps.columns.shape[1]) / mean
    equalities = _scale_equalities(grasps, scales, grasps.wrench / mean, None if unit is None else unit / mean)
    wrench = equalities.original.wrench
    actuators = None
    if grasps.actuated is not None and unit is not None and equalities.actuators is not None:
        limits = jnp.stack([grasps.actuated.upper, -grasps.actuated.lower]) / unit
        assert rows.actuator_sigma is not None
        actuators = ActuatorRows(equalities.actuators, rows.actuator_sigma, limits, unit)
    coordinates, kept = equalities.basis.coordinates(wrench), equalities.basis.kept

    # What lies outside the range of G: more of it than rounding leaves.
    largest = fold(jnp.maximum, jnp.abs(wrench))
    tolerance = 10 * RANK_TOLERANCE[dtype.name]
    wrench_outside = fold(jnp.maximum, jnp.abs(coordinates) * (1 - kept)) > tolerance * largest
    reach = reach_outside(grasps, losses.basis)
    doubtful = _doubtful(grasps, losses.basis, reach, tolerance)
    return ScaledProgram(
        cone_edges=cone_edges,
        columns=equalities.forces,
        sigma=rows.sigma,
        h=rows.h,
        present=present,
        rough=grasps.rough,
        turning=grasps.turning,
        rhs=coordinates * kept,
        dropped=1 - kept,
        scale=rows.scale,
        tangential=tangential,
        normal=normal,
        original=equalities.original,
        basis=equalities.basis,
        mean=mean,
        rank=fold(jnp.add, losses.basis.kept[:6]).astype(jnp.int32),
        least_ratio=fold(jnp.minimum, jnp.where(losses.basis.kept > 0, losses.basis.ratios, 1)[:6]),
        doubtful=doubtful if equalities.doubtful is None else doubtful | equalities.doubtful,
        undisturbed=rows.undisturbed,
        disturbance_outside=reach > tolerance,
        wrench_outside=wrench_outside,
        actuators=actuators,
        joint_sizes=equalities.joint_sizes,
    )


class _ScaledRows(NamedTuple):
    """The scaled inequality rows A x + sigma lambda <= h.

    sigma, h: (m, n, *lanes), of the contacts.
    actuator_sigma: (2, n_u, *lanes), of the actuators; None without any.
    scale: (*lanes), Lambda.
    undisturbed: bool (*lanes), sigma = 0.
    """

    sigma: jax.Array
    h: jax.Array
    actuator_sigma: jax.Array | None
    scale: jax.Array
    undisturbed: jax.Array


def _scale_rows(grasps: Grasps, losses: RowLosses, tangential: jax.Array, unit: jax.Array | None) -> _ScaledRows:
    """Divide every row by the force that it bounds, and sigma by its largest entry."""
    present = grasps.present

    @fenced
    def scale_rows(
        cone: jax.Array,
        bound: jax.Array,
        actuators: jax.Array | None,
        tangential: jax.Array,
        normal: jax.Array,
        reserve: jax.Array,
    ) -> tuple:
        sigmas = [jnp.concatenate([cone / tangential, (bound / normal)[None]])]
        if actuators is not None:
            sigmas.append(actuators)
        largest = fold(jnp.maximum, [fold(jnp.maximum, fold(jnp.maximum, sigma)) for sigma in sigmas])
        undisturbed = largest == 0
        # A choice of units: no derivative depends on it.
        scale = lax.stop_gradient(1 / jnp.where(undisturbed, 1, largest))
        ones = [present, 1]
        sigmas = [jnp.where(undisturbed, one, sigma * scale) for one, sigma in zip(ones, sigmas, strict=False)]
        # What is left of a zero after rounding is a zero.
        sigmas = [jnp.where(sigma > 8 * jnp.finfo(present.dtype).eps, sigma, 0) for sigma in sigmas]
        lost = jnp.where(present > 0, -reserve / tangential, 1)
        h = jnp.concatenate([jnp.broadcast_to(lost, cone.shape), jnp.ones_like(bound)[None]])
        return sigmas, h, scale, undisturbed

    actuators = None if losses.actuators is None or unit is None else losses.actuators / unit
    assert grasps.reserve is not None
    sigmas, h, scale, undisturbed = scale_rows(
        losses.cone, losses.bound, actuators, tangential, grasps.max_force, grasps.reserve
    )
    return _ScaledRows(sigmas[0], h, sigmas[1] if len(sigmas) > 1 else None, scale, undisturbed)


class _ScaledEqualities(NamedTuple):
    """The orthonormal equality rows, and where they come from.

    forces: (eq, k, n, *lanes), columns of the contact forces.
    actuators: (eq, 1, n_u, *lanes), columns of the actuator efforts; None without any.
    joint_sizes: (n_v, *lanes), what the rows of J'f - B u were divided by; None without actuators.
    basis: row operations from the original rows to the orthonormal ones.
    original: the rows before.
    doubtful: bool (*lanes), whether efforts answer all forces is in doubt; None where that does not matter.
    """

    forces: jax.Array
    actuators: jax.Array | None
    joint_sizes: jax.Array | None
    basis: Basis | HandBasis
    original: Equalities
    doubtful: jax.Array | None = None


def _scale_equalities(
    grasps: Grasps, scales: jax.Array, wrench: jax.Array, unit: jax.Array | None
) -> _ScaledEqualities:
    """Make the rows of G f = b orthonormal, and those of J'f - B u = 0.

    For kernels these are kept apart where efforts reach all joints: one step then takes a fifth of the operations.

    Args:
        grasps: the grasps.
        scales: (k, n, *lanes), units of the forces over their mean.
        wrench: (6, *lanes), b over the mean.
        unit: (n_u, *lanes), units of the actuator efforts over the mean of forces; None without actuators.
    """
    if grasps.actuated is None or unit is None:
        columns = (grasps.columns * scales,)
        basis = whitened(columns[0])
        return _ScaledEqualities(basis.rows, None, None, basis, Equalities(columns, wrench))
    joined = join_rows(grasps.actuated, grasps.columns * scales, scales, unit)
    if in_loops() and grasps.actuated.unreached is None:
        return _joint_rows_apart(joined, wrench)
    basis = whitened(pack(joined))
    forces, actuators = unpack(basis.rows, grasps.present.shape[0], unit.shape[0])
    wrench = jnp.concatenate([wrench, jnp.zeros_like(joined.sizes)])
    original = Equalities((joined.forces, joined.actuators), wrench)
    return _ScaledEqualities(forces, actuators, joined.sizes, basis, original)


def _joint_rows_apart(rows: JoinedRows, wrench: jax.Array) -> _ScaledEqualities:
    """Make the rows of G f = b orthonormal, and those of J'f - B u = 0 so that B has orthonormal rows."""
    wrenches, hand = whitened(rows.forces[:6]), whiten_efforts(rows)
    kept = jnp.concatenate([wrenches.kept, hand.kept])
    original = Equalities((rows.forces, rows.actuators), jnp.concatenate([wrench, jnp.zeros_like(rows.sizes)]))
    return _ScaledEqualities(
        forces=jnp.concatenate([wrenches.rows, hand.forces]),
        actuators=jnp.concatenate([rows.actuators[:6], hand.actuators[:, None]]),
        joint_sizes=rows.sizes,
        basis=HandBasis(wrenches, hand.factor, kept),
        original=original,
        doubtful=hand.lost > 10 * RANK_TOLERANCE[wrench.dtype.name],
    )


def prepare(grasps: Grasps, cone_edges: int) -> tuple[Grasps, ScaledProgram]:
    """Scale the programs; beside them, all of the grasps but the disturbance set is needed to solve them."""
    return replace(grasps, terms=(), extents=(), compliance=None), scale_program(grasps, cone_edges)


def actuated_values(
    program: ScaledProgram, x: Rows, multipliers: Record | Iterate, units: jax.Array, unit: jax.Array
) -> dict[str, jax.Array]:
    """The fields of a solution that come with actuators, multipliers for an objective in `unit`; empty without any."""
    if program.actuators is None:
        return {}
    return {
        "actuator_efforts": x[1][0] * program.actuators.unit,
        "actuator_multipliers": jnp.moveaxis(multipliers.z[1] / program.actuators.unit, 0, 1) * unit,
        "joint_multipliers": program.joint_multipliers(multipliers.y, units) * unit,
    }


def _doubtful(grasps: Grasps, basis: Basis, reach: jax.Array, tolerance: float) -> jax.Array:
    """Find where rounding leaves the rank of G, its range or its short rows in doubt, (*lanes).

    Dropping a row turns those that are kept by its length over that of the shortest one. Rows are taken in their order:
    beside a short one, what is left of a row that depends on it is rounding, eps over the short one's length. So in
    float64 the rank is in doubt where two rows are so short that one may be rounding, or where a dropped row that is
    more than rounding turns the others by more than 1e-7.

    In float32 a row that is nearly dependent makes S_1 and S_2 wrong by eps over what was left of it. One that was
    dropped may be dependent or not, unless the contacts themselves say so: all on one line, to the last bit, or, some
    without friction, with fewer components of force than rows, or with nothing at all left of a row. A disturbance set
    that leaves the range by little more than rounding has margin 0, or none of it at all. Rows of joints that no
    actuator reaches are dependent where they look so.
    """
    ratios, kept = basis.ratios, basis.kept > 0
    if ratios.dtype == jnp.float64:
        least = second = jnp.ones_like(ratios[0])
        for ratio in jnp.where(kept, ratios, 1)[:6]:
            least, second = jnp.minimum(least, ratio), jnp.minimum(second, jnp.maximum(least, ratio))
        most = fold(jnp.maximum, jnp.where(kept, 0, ratios)[:6])
        rounding = 16 * jnp.finfo(ratios.dtype).eps
        dependent = (most * least <= rounding) & (least > 1e-8)
        return (least * second <= rounding) | (most > _MOST_TURNED * least) & ~dependent
    short = (kept[:6] & (ratios[:6] < 3e-3)).any(0)
    rows, smooth = fold(jnp.add, kept[:6].astype(ratios.dtype)), (grasps.rough < grasps.present).any(0)
    certain = (rows == fold(jnp.add, fold(jnp.add, grasps.transmits))) | (kept[:6] | (ratios[:6] == 0)).all(0)
    doubtful = short | (~kept[:6].all(0) & ~grasps.lined & ~(smooth & certain))
    doubtful |= (reach > 64 * jnp.finfo(reach.dtype).eps) & (reach <= tolerance)
    return doubtful if len(ratios) == 6 else doubtful | ((ratios[6:] > 1e-5) & (ratios[6:] < 1e-3)).any(0)
