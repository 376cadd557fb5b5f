"""The formulations (12), (13), (16) and their like as conic programs in scaled form.

The programs have two shapes. Where the reaction delta f_j to a disturbance is free, f_0 + delta f_j is a force of its
own: the directions decouple, one program each, max lambda with G f = b - lambda W_j, and f_0 has another program. Where
delta f_j is the blocking force (15), all directions share f_0. Coulomb's cones then come in copies, one for each
direction and one for rest; of linear rows that differ only in what lambda takes from them, the strictest is enough,
since lambda >= 0 is asked for.

Per contact forces are scaled as in `program`: tangential by mu F, normal by F.
"""

from dataclasses import dataclass, replace
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from jaxgrasp.arrays import fold
from jaxgrasp.contact.compliance import pseudo_inverse
from jaxgrasp.contact.contacts import LEAST_FRICTION
from jaxgrasp.contact.friction import contact_facets
from jaxgrasp.contact.row_space import RANK_TOLERANCE, whitened
from jaxgrasp.disturbance.vertices import wrenches_of
from jaxgrasp.robustness.grasps import Grasps
from jaxgrasp.robustness.tightening.program import force_units
from jaxgrasp.solvers.conic.margin import ConeRows, ConicMargin


class Formulation(NamedTuple):
    """The properties in which the formulations differ.

    exact: Coulomb's cones, not pyramids.
    free: delta f_j is free, not the blocking force (15).
    one_f0: there has to be one f_0 for all directions.
    """

    exact: bool
    free: bool
    one_f0: bool


FORMULATIONS = {
    "12": Formulation(exact=True, free=True, one_f0=True),
    "12_fixed": Formulation(exact=True, free=False, one_f0=True),
    "13": Formulation(exact=False, free=True, one_f0=True),
    "16": Formulation(exact=False, free=False, one_f0=True),
    "per_direction": Formulation(exact=False, free=True, one_f0=False),
    "per_direction_prestrained": Formulation(exact=False, free=False, one_f0=False),
}


@jax.tree_util.register_dataclass
@dataclass(frozen=True, kw_only=True)
class Basics:
    """The scaled data that all formulations share; lanes trail."""

    sizes: jax.Array
    """(k, n, *lanes), the units of forces, N: f = sizes * x."""
    columns: jax.Array
    """(6, k, n, *lanes), the orthonormal rows of G for scaled forces; zero where dropped."""
    dropped: jax.Array
    """(6, *lanes), 1 where a row was dropped."""
    wrenches: jax.Array
    """(6, n_d, *lanes), W_j in the units of G's rows."""
    load: jax.Array
    """(6, *lanes), b in the orthonormal rows."""
    targets: jax.Array
    """(6, n_d, *lanes), W_j in the orthonormal rows."""
    blocking_forces: jax.Array | None
    """(n_d, k, n, *lanes), the blocking forces for lambda = 1, N; None where no formulation asks for them."""
    disturbed: jax.Array
    """bool (n_d, *lanes), whether W_j is not zero."""
    outside: jax.Array
    """bool (n_d, *lanes), whether W_j is outside the range of G."""
    load_outside: jax.Array
    """bool (*lanes), whether b is outside the range of G."""


@jax.tree_util.register_dataclass
@dataclass(frozen=True, kw_only=True)
class Scaled:
    """The programs of one formulation; lanes are (programs of a grasp, grasps).

    Free reactions: one program a direction, then that of f_0. Blocking forces: one program, or one a direction.
    """

    problem: ConicMargin
    scale: jax.Array
    """(D, *lanes): lambda = scale * lambda_hat."""


def compute_basics(grasps: Grasps, with_blocking_forces: bool) -> Basics:
    """Scale a batch of grasps, as far as all formulations need it."""
    dtype, present = grasps.present.dtype, grasps.present
    tolerance = 10 * RANK_TOLERANCE[dtype.name]
    tangential = jnp.maximum(grasps.friction, LEAST_FRICTION[dtype.name]) * grasps.max_force
    sizes = force_units(tangential, grasps.max_force, grasps.columns.shape[1])
    mean = fold(jnp.add, grasps.max_force * present) / jnp.maximum(fold(jnp.add, present), 1)
    mean = lax.stop_gradient(jnp.where(mean > 0, mean, 1))
    rows = whitened(grasps.columns * (sizes / mean))
    (lanes,) = mean.shape
    vertices = wrenches_of(grasps.terms)
    wrenches = jnp.swapaxes(jnp.broadcast_to(vertices, (*vertices.shape[:2], lanes)), 0, 1) * grasps.units[:, None]

    def coordinates(wrench: jax.Array) -> tuple[jax.Array, jax.Array]:
        """Express a wrench in the orthonormal rows, and tell whether something of it is outside them."""
        spread = lambda x: x.reshape(*x.shape[:-1], *[1] * (wrench.ndim - 2), lanes)
        inside = fold(jnp.add, [spread(rows.operations[:, c]) * wrench[c] for c in range(6)])
        outside = fold(jnp.maximum, jnp.abs(lax.stop_gradient(inside)) * (1 - spread(rows.kept)))
        return inside * spread(rows.kept), outside > tolerance * fold(jnp.maximum, jnp.abs(wrench))

    load, load_outside = coordinates(grasps.wrench / mean)
    targets, outside = coordinates(wrenches / mean)
    return Basics(
        sizes=sizes,
        columns=rows.rows,
        dropped=1 - rows.kept,
        wrenches=wrenches,
        load=load,
        targets=targets,
        blocking_forces=compute_blocking_forces(grasps, wrenches) if with_blocking_forces else None,
        disturbed=fold(jnp.maximum, jnp.abs(wrenches)) > 0,
        outside=outside,
        load_outside=load_outside,
    )


def scale_formulation(grasps: Grasps, basics: Basics, form: Formulation, cone_edges: int, norm_bound: bool) -> Scaled:
    """The programs of one formulation for a batch of grasps."""
    present, dtype = grasps.present, grasps.present.dtype
    count, lanes = basics.disturbed.shape
    parts = contact_rows(grasps, basics, form.exact, cone_edges, norm_bound)
    identities = [_identity(part.second_order, len(part.h), dtype) * present[:, None] for part in parts]
    if form.free:
        length = jnp.sqrt(lax.stop_gradient(fold(jnp.add, basics.targets * basics.targets)))
        scale = jnp.where(length > 0, 1 / jnp.where(length > 0, length, 1), 1)
        border = jnp.concatenate([basics.targets * scale, jnp.zeros((6, 1, lanes), dtype)], 1)
        scale = jnp.concatenate([scale, jnp.ones((1, lanes), dtype)])
        # The last program is for f_0: how deep inside all rows it can be.
        last = (jnp.arange(count + 1) == count).astype(dtype)[:, None]
        sigmas = [identity * last for identity in identities]
    else:
        border = jnp.zeros((6, 1 if form.one_f0 else count, lanes), dtype)
        assert basics.blocking_forces is not None
        changes = jnp.moveaxis(basics.blocking_forces / basics.sizes, 0, 2)
        sigmas = [jnp.where(present[:, None] > 0, part.apply(changes), 0) for part in parts]
        if not form.exact:
            # The strictest of all directions and of rest, for which it is 0.
            sigmas = [jnp.maximum(sigma, 0) for sigma in sigmas]
            sigmas = [jnp.max(sigma, 3, keepdims=True) if form.one_f0 else sigma for sigma in sigmas]
        largest = fold(jnp.maximum, [jnp.max(jnp.abs(sigma), (0, 1, 2)) for sigma in sigmas])
        if form.one_f0 and form.exact:
            largest = jnp.max(largest, 0, keepdims=True)
            # Directions become copies, (d, n_d, n, 1, *lanes).
            sigmas = [jnp.swapaxes(sigma, 1, 3) for sigma in sigmas]
        # Where nothing disturbs, lambda asks how deep inside all rows f_0 can be.
        undisturbed = largest == 0
        scale = lax.stop_gradient(1 / jnp.where(undisturbed, 1, largest))
        if form.exact:
            sigmas = [jnp.concatenate([sigma, jnp.zeros_like(sigma[:, :1])], 1) for sigma in sigmas]
        sigmas = [jnp.where(undisturbed, one, sigma * scale) for sigma, one in zip(sigmas, identities, strict=True)]
    lift = lambda sigma: jnp.broadcast_to(sigma, (*sigma.shape[:3], *border.shape[1:]))
    problem = ConicMargin(
        rows=tuple(replace(part, sigma=lift(sigma)) for part, sigma in zip(parts, sigmas, strict=True)),
        columns=basics.columns[..., None, :],
        border=border,
        rhs=jnp.broadcast_to(basics.load[:, None], border.shape),
        dropped=basics.dropped[:, None],
    )
    return Scaled(problem=problem, scale=scale)


def compute_blocking_forces(grasps: Grasps, wrenches: jax.Array) -> jax.Array:
    """Blocking forces -G*_j W_j (n_d, k, n, *lanes) against wrenches (6, n_d, *lanes), N."""
    if grasps.vertex_inverse_roots is None:
        inverse = pseudo_inverse(grasps.columns, grasps.inverse_root)[0]
        forces = -jnp.einsum("aen...,ed...->dan...", inverse, wrenches)
    else:
        one = lambda each: -jnp.einsum("aen...,e...->an...", pseudo_inverse(grasps.columns, each[0])[0], each[1])
        forces = lax.map(one, (grasps.vertex_inverse_roots, jnp.swapaxes(wrenches, 0, 1)))
    return jnp.where(grasps.present > 0, forces, 0)


def contact_rows(grasps: Grasps, basics: Basics, exact: bool, cone_edges: int, norm_bound: bool) -> list[ConeRows]:
    """The rows of a contact, without sigma: friction, then the bound on the force, in which moments do not count."""
    friction, components = grasps.friction, len(basics.sizes)
    none = jnp.zeros((1, 1, 1, 1, 1), friction.dtype)
    make = lambda kind, patterns, h, stretch=None, reserve=None: ConeRows(
        second_order=kind, patterns=tuple(map(tuple, patterns)), h=h, sigma=none, stretch=stretch, reserve=reserve
    )
    axes = np.eye(components).tolist()
    normal = (0 - np.eye(components)[2]).tolist()
    if not exact:
        facets = contact_facets(cone_edges, components).tolist()
        reserve = _reserve(grasps, basics, len(facets), 1)
        return [make(False, [*facets, normal], (*[0.0] * len(facets), 1.0), reserve=reserve)]
    # Of a soft contact the ellipsoid, |(f_t, m mu / gamma)| <= -mu f_n.
    sliding = (0 - np.delete(np.eye(components), 2, 0)).tolist()
    reserve = _reserve(grasps, basics, 1, components - 1)
    coulomb = make(True, [axes[2], *sliding], (0.0,) * components, reserve=reserve)
    if not norm_bound:
        return [coulomb, make(False, [normal], (1.0,))]
    slip = jnp.maximum(friction, LEAST_FRICTION[friction.dtype.name])[:, None]
    stretch = jnp.stack([slip, slip, jnp.ones_like(slip), slip][:components])
    forces = (-np.eye(components)[:3]).tolist()
    return [coulomb, make(True, [(0.0,) * components, *forces], (1.0, 0.0, 0.0, 0.0), stretch)]


def _reserve(grasps: Grasps, basics: Basics, rows: int, others: int) -> jax.Array | None:
    """What d takes from the first rows of a contact, and nothing from the others: (rows + others, 1, n, 1, *lanes)."""
    if grasps.reserve is None:
        return None
    taken = grasps.row_reserves(basics.sizes[0], rows)
    return jnp.concatenate([taken, jnp.zeros((others, *taken.shape[1:]), taken.dtype)])[:, None, :, None]


def _identity(second_order: bool, rows: int, dtype: jnp.dtype) -> jax.Array:
    """The identity of the rows' cones, (d, 1, 1, 1, 1)."""
    row = np.eye(rows)[0] if second_order else np.ones(rows)
    return jnp.asarray(row, dtype).reshape(-1, 1, 1, 1, 1)
