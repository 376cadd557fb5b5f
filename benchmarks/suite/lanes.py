"""Lanes of grasps as NumPy has them: what the package is given and answers, and lanes that are spoilt on purpose."""

from __future__ import annotations

from dataclasses import dataclass, fields, replace

import jax
import jax.numpy as jnp
import numpy as np

import jaxgrasp as jg


@dataclass(frozen=True, kw_only=True)
class Lanes:
    """Grasps of equal shape with their loads and disturbance sets, about the centre of mass.

    The disturbance set is the Minkowski sum of those of `vertices`, `half_extents`, `radii` and `shape_matrix` that are
    given. Vertices (1, n_d, 6) are shared by all lanes.
    """

    cone_edges: int
    positions: np.ndarray
    """(lanes, n_c, 3), m."""
    frames: np.ndarray
    """(lanes, n_c, 3, 3), columns t1, t2, n."""
    friction: np.ndarray
    """(lanes, n_c)."""
    max_force: np.ndarray
    """(lanes, n_c), N."""
    active: np.ndarray
    """(lanes, n_c) bool; absent contacts may hold anything."""
    wrench: np.ndarray
    """(lanes, 6), the required wrench, N and N m."""
    reserve: np.ndarray
    """(lanes,), what every facet row keeps, N."""
    vertices: np.ndarray | None = None
    """(lanes or 1, n_d, 6), padded with zero rows."""
    half_extents: np.ndarray | None = None
    """(lanes, 6), of a box."""
    radii: np.ndarray | None = None
    """(lanes, 2), of a ball of forces and one of moments."""
    shape_matrix: np.ndarray | None = None
    """(lanes, 6, 6), of an ellipsoid."""
    width: np.ndarray | None = None
    """(lanes,), N, of a smoothed set."""

    def __len__(self) -> int:
        return len(self.positions)

    def __getitem__(self, lanes) -> Lanes:
        own = {name: value[lanes] for name, value in self.arrays().items() if len(value) == len(self)}
        return replace(self, **own)

    def arrays(self) -> dict[str, np.ndarray]:
        values = {f.name: getattr(self, f.name) for f in fields(self)}
        return {name: value for name, value in values.items() if isinstance(value, np.ndarray)}

    def rounded(self, dtype: str) -> Lanes:
        """The same lanes in a precision."""
        return replace(self, **{n: v.astype(dtype) for n, v in self.arrays().items() if v.dtype != bool})

    def contacts(self) -> jg.Contacts:
        names = ("friction", "max_force", "active")
        return jg.Contacts.from_frames(
            jnp.asarray(self.positions),
            jnp.asarray(self.frames),
            **{name: jnp.asarray(getattr(self, name)) for name in names},
        )

    def disturbances(self) -> jg.DisturbanceSet:
        parts = []
        if self.vertices is not None:
            shared = len(self.vertices) == 1 < len(self)
            parts.append(jg.DisturbanceSet.vertices(jnp.asarray(self.vertices[0] if shared else self.vertices)))
        if self.half_extents is not None:
            parts.append(jg.DisturbanceSet.box(jnp.asarray(self.half_extents)))
        if self.radii is not None:
            parts.append(jg.DisturbanceSet.ball(*jnp.asarray(self.radii).T))
        if self.shape_matrix is not None:
            parts.append(jg.DisturbanceSet.ellipsoid(jnp.asarray(self.shape_matrix)))
        total = parts[0]
        for part in parts[1:]:
            total = total + part
        return total if self.width is None else total.smoothed(jnp.asarray(self.width))


@dataclass(frozen=True, kw_only=True)
class Claims:
    """What the package says of every lane; fields as in `jaxgrasp.Solution`."""

    status: np.ndarray
    margin: np.ndarray
    upper_bound: np.ndarray
    forces: np.ndarray
    effort: np.ndarray
    rank: np.ndarray
    cone_multipliers: np.ndarray
    bound_multipliers: np.ndarray
    wrench_multipliers: np.ndarray

    @classmethod
    def of(cls, solution: jg.Solution) -> Claims:
        values = jax.device_get({f.name: getattr(solution, f.name) for f in fields(cls)})
        return cls(**{name: np.asarray(value) for name, value in values.items()})

    def __len__(self) -> int:
        return len(self.status)

    def __getitem__(self, lanes) -> Claims:
        return replace(self, **{f.name: getattr(self, f.name)[lanes] for f in fields(self)})

    def wide(self) -> Claims:
        """In float64."""
        values = {f.name: getattr(self, f.name) for f in fields(self)}
        return Claims(**{n: v.astype(np.float64) if v.dtype.kind == "f" else v for n, v in values.items()})

    def differs(self, other: Claims, tolerance: float | None) -> np.ndarray:
        """Where two answers differ, (lanes,): in any bit (None), or in status or by a share of each field's size."""
        found = self.status != other.status
        for field in fields(self):
            a, b = (np.reshape(getattr(c, field.name), (len(self), -1)) for c in (self, other))
            if tolerance is None or a.dtype.kind != "f":
                unlike = (a != b) & ~((a != a) & (b != b))
            else:
                size = np.nanmax(np.abs(np.where(np.isfinite(b), b, 0)), axis=-1, keepdims=True, initial=0)
                with np.errstate(invalid="ignore"):
                    unlike = ~((np.abs(a - b) <= tolerance * size) | (a == b) | ((a != a) & (b != b)))
            found |= unlike.any(-1)
        return found


def largest_disturbance(lanes: Lanes, **options) -> Claims:
    return Claims.of(
        jg.largest_disturbance(
            lanes.contacts(),
            lanes.disturbances(),
            required_wrench=jnp.asarray(lanes.wrench),
            cone_edges=lanes.cone_edges,
            cone_margin=jnp.asarray(lanes.reserve),
            **options,
        )
    )


def least_effort(lanes: Lanes, asked: np.ndarray, **options) -> Claims:
    return Claims.of(
        jg.least_effort(
            lanes.contacts(),
            lanes.disturbances(),
            jnp.asarray(asked),
            required_wrench=jnp.asarray(lanes.wrench),
            cone_edges=lanes.cone_edges,
            cone_margin=jnp.asarray(lanes.reserve),
            **options,
        )
    )


# What one contact that is there (one coordinate, the normal) or the lane gets.
SPOILT_CONTACT = {
    "positions": (np.nan, np.inf),
    "friction": (-0.5, np.nan, np.inf),
    "max_force": (0.0, -1.0, np.inf, np.nan),
    "frames": (np.nan, 0.0),
}
SPOILT_LANE = {"wrench": (np.nan, np.inf), "reserve": (-1.0, np.nan)}
SPOILT_SET = ("vertices", "half_extents", "radii", "shape_matrix", "width")


def spoil(lanes: Lanes, rng: np.random.Generator) -> tuple[Lanes, np.ndarray]:
    """One lane in eight with data that are not admissible, and which: (lanes,) bool."""
    count = len(lanes)
    changed = {name: value.copy() for name, value in lanes.arrays().items()}
    own_sets = [n for n in SPOILT_SET if n in changed and len(changed[n]) == count]
    ways = [(n, v) for n, values in (SPOILT_CONTACT | SPOILT_LANE).items() for v in values]
    ways += [(name, np.nan) for name in own_sets]
    chosen, spoilt = rng.permutation(count)[: count // 8], np.zeros(count, bool)
    for way, (name, value) in enumerate(ways):
        rows = chosen[way :: len(ways)]
        if name in SPOILT_CONTACT:
            rows = rows[lanes.active[rows].any(-1)]
            which = np.argmax(rng.random((len(rows), lanes.active.shape[1])) * lanes.active[rows], axis=-1)
            if name == "frames":
                changed[name][rows, which, :, 2] = value
            elif name == "positions":
                changed[name][rows, which, rng.integers(0, 3, len(rows))] = value
            else:
                changed[name][rows, which] = value
        elif changed[name].ndim == 1:
            changed[name][rows] = value
        else:
            changed[name].reshape(count, -1)[rows, 0] = value
        spoilt[rows] = True
    return replace(lanes, **changed), spoilt
