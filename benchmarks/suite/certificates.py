"""What a lane's own forces and multipliers prove, put into the rows of `rows`: bounds by weak duality."""

from __future__ import annotations

import numpy as np

from benchmarks.suite.lanes import Claims
from benchmarks.suite.rows import Model


def bounds(m: Model, claims: Claims, polish: bool = False) -> tuple[np.ndarray, np.ndarray]:
    """What forces attain and what multipliers exclude, (lanes,) each: lower <= lambda* <= upper.

    -inf and inf where they say nothing. The upper one holds for lambda >= 0: below zero it says that b is not borne.
    `polish`: after forces have been moved, as little as can be, to G f = b, and y to what z leaves least of.
    """
    balanced = balancing(m) if polish else None
    lower, upper = attained(m, claims, balanced), excluded(m, claims, balanced)
    # What G does not reach allows nothing.
    return tuple(np.where(m.set_outside, np.minimum(bound, 0.0), bound) for bound in (lower, upper))


def balancing(m: Model) -> np.ndarray:
    """(G R^2 G')^+, (lanes, 6, 6), with R the largest admissible forces."""
    G, R = m.G.reshape(len(m.b), 6, -1), m.radii.reshape(len(m.b), 1, -1)
    return np.linalg.pinv((G * R**2) @ np.swapaxes(G, 1, 2), rcond=1e-14, hermitian=True)


def attained(m: Model, claims: Claims, balanced: np.ndarray | None) -> np.ndarray:
    """The largest lambda that the forces allow, (lanes,)."""
    forces = np.where(np.isfinite(claims.forces), claims.forces, 0.0)
    if balanced is not None:
        missed = np.einsum("lrs,ls->lr", balanced, m.b - np.einsum("lrcj,lcj->lr", m.G, forces))
        forces = forces + m.radii**2 * np.einsum("lrcj,lr->lcj", m.G, missed)
    cone, bound = m.slacks(forces)
    tangential = (m.friction * m.max_force)[..., None]
    slack = np.concatenate([cone, bound[..., None]], axis=-1)
    sigma = np.concatenate([-m.S_1, m.S_2[..., None]], axis=-1)
    unit = np.concatenate([np.broadcast_to(tangential, cone.shape), m.max_force[..., None]], axis=-1)
    felt = sigma * m.scale[:, None, None] > 1e-9 * unit
    ratio = np.where(felt, slack / np.where(felt, sigma, 1.0), np.where(slack >= -1e-9 * unit, np.inf, -np.inf))
    lower = np.where(m.active[..., None], ratio, np.inf).min((1, 2))
    return np.where(np.isfinite(claims.forces).all((1, 2)) & (m.imbalance(forces) <= 1e-9), lower, -np.inf)


def excluded(m: Model, claims: Claims, balanced: np.ndarray | None) -> np.ndarray:
    """What no lambda >= 0 exceeds, (lanes,): the rows weighed by multipliers, what is left over times its bounds."""
    z, bound_z, y = multipliers(m, claims)
    pull = np.sum(-m.S_1 * z, axis=(1, 2)) + np.sum(m.S_2 * bound_z, axis=-1)
    usable = (pull > 0) & np.isfinite(pull)
    over = np.where(usable, pull, 1.0)
    z, bound_z, y = z / over[:, None, None], bound_z / over[:, None], y / over[:, None]
    left = -weighed(m, z, bound_z)
    rest = left - np.einsum("lrcj,lr->lcj", m.G, y)
    if balanced is not None:
        y = y + np.einsum("lrs,ls->lr", balanced, np.einsum("lrcj,lcj->lr", m.G, m.radii**2 * rest))
        rest = left - np.einsum("lrcj,lr->lcj", m.G, y)
    value = np.sum(m.max_force * bound_z, -1) - m.reserve * z.sum((1, 2)) + np.sum(y * m.b, -1)
    value = value + np.sum(m.radii * np.abs(rest), (1, 2))
    return np.where(usable & ~np.isnan(value), value, np.inf)


def multipliers(m: Model, claims: Claims) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """z of C and of E, none negative, and y of G f = b with moments over the grasp's size."""
    z = np.maximum(np.nan_to_num(claims.cone_multipliers), 0.0) * m.active[..., None]
    bound_z = np.maximum(np.nan_to_num(claims.bound_multipliers), 0.0) * m.active
    units = np.repeat(np.stack([np.ones_like(m.length), m.length], axis=-1), 3, axis=-1)
    return z, bound_z, np.nan_to_num(claims.wrench_multipliers) * units


def weighed(m: Model, z: np.ndarray, bound_z: np.ndarray) -> np.ndarray:
    """C'z - E'z, (lanes, n_c, 3)."""
    pull = np.concatenate([z @ m.facets[:, :2], (m.friction * (z @ m.facets[:, 2]))[..., None]], axis=-1)
    pull[..., 2] -= bound_z
    return pull


def least_effort(m: Model, claims: Claims, asked: np.ndarray) -> np.ndarray:
    """(lanes,): no forces that hold at `asked` have less effort, by the lane's multipliers."""
    z, bound_z, y = multipliers(m, claims)
    pull = weighed(m, z, bound_z) + np.einsum("lrcj,lr->lcj", m.G, y)
    held = np.sum(z * (m.S_1 * asked[:, None, None] - m.reserve[:, None, None]), (1, 2))
    held = held + np.sum(bound_z * (m.max_force - m.S_2 * asked[:, None]), -1)
    return -0.5 * np.sum(pull**2, (1, 2)) - held - np.sum(y * m.b, -1)
