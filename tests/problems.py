"""Families of grasps to try the solvers on: deterministic, equal shapes within a group, nothing taken from the package.

A group is one batch: all its grasps have the same numbers of contacts, directions and edges, so that each program is
compiled once a group. A family is one recipe within a group, `SETTINGS` names what the recipes vary.
"""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from functools import cache
from pathlib import Path

import numpy as np
import oracles

SHARED_DATA = Path(__file__).resolve().parents[1].parent / "shared" / "data"
REAL_GRASPS = SHARED_DATA / "ycb_allegro_grasps.npz"


@dataclass(frozen=True, kw_only=True)
class Batch:
    """Grasps of equal shape, one lane each; absent contacts hold numbers without a meaning."""

    positions: np.ndarray
    """(lanes, n_c, 3)."""
    frames: np.ndarray
    """(lanes, n_c, 3, 3)."""
    friction: np.ndarray
    """(lanes, n_c)."""
    max_force: np.ndarray
    """(lanes, n_c)."""
    vertices: np.ndarray
    """(lanes, n_d, 6), padded with zero rows."""
    required_wrench: np.ndarray
    """(lanes, 6)."""
    active: np.ndarray
    """(lanes, n_c) bool."""
    cone_margin: np.ndarray
    """(lanes,)."""

    def __len__(self) -> int:
        return len(self.positions)

    def __getitem__(self, lanes) -> Batch:
        return replace(self, **{f.name: getattr(self, f.name)[lanes] for f in fields(self)})

    def grasp(self, lane: int, cone_edges: int) -> oracles.Grasp:
        """One lane as the oracles want it: without absent contacts and without the padding of the vertices."""
        on, vertices = self.active[lane], self.vertices[lane]
        return oracles.Grasp(
            positions=self.positions[lane][on],
            frames=self.frames[lane][on],
            friction=self.friction[lane][on],
            max_force=self.max_force[lane][on],
            vertices=vertices[np.any(vertices != 0, axis=-1)],
            required_wrench=self.required_wrench[lane],
            cone_edges=cone_edges,
            cone_margin=float(self.cone_margin[lane]),
        )


@dataclass(frozen=True, kw_only=True)
class Group:
    """Families of one shape, one after the other."""

    cone_edges: int
    family: np.ndarray
    """(lanes,) str: the family of each lane."""
    batch: Batch


def concatenate(batches: list[Batch]) -> Batch:
    return Batch(**{f.name: np.concatenate([getattr(b, f.name) for b in batches]) for f in fields(Batch)})


def unit_vectors(rng: np.random.Generator, *shape: int) -> np.ndarray:
    v = rng.normal(size=(*shape, 3))
    return v / np.linalg.norm(v, axis=-1, keepdims=True)


def rotations(rng: np.random.Generator, *shape: int) -> np.ndarray:
    q, _ = np.linalg.qr(rng.normal(size=(*shape, 3, 3)))
    return q * np.sign(np.linalg.det(q))[..., None, None]


def frames_from_normals(normals: np.ndarray, angle: np.ndarray) -> np.ndarray:
    """(..., 3, 3) contact frames, the tangents turned by an angle about the outward normal."""
    helper = np.eye(3)[np.argmin(np.abs(normals), axis=-1)]
    first = np.cross(helper, normals)
    first /= np.linalg.norm(first, axis=-1, keepdims=True)
    second = np.cross(normals, first)
    cos, sin = np.cos(angle)[..., None], np.sin(angle)[..., None]
    return np.stack([cos * first + sin * second, cos * second - sin * first, normals], axis=-1)


def ellipsoid_contacts(rng, lanes: int, n_c: int, closure: str) -> tuple[np.ndarray, np.ndarray]:
    """Points on random ellipsoids of size one and frames with random tangents.

    `closure` says where the fingers stand: "spread" anywhere, "around" in opposite pairs as far as there are pairs,
    "one side" within 60 degrees of a pole, where no friction up to 0.5 closes the grasp.
    """
    axes, turn = rng.uniform(0.4, 1.0, (lanes, 1, 3)), rotations(rng, lanes)
    u = unit_vectors(rng, lanes, n_c)
    if closure == "around":
        half = n_c // 2
        u[:, half : 2 * half] = -u[:, :half] + 0.3 * rng.normal(size=(lanes, half, 3))
    if closure == "one side":
        u[..., 2] = np.abs(u[..., 2]) + 0.6
    u /= np.linalg.norm(u, axis=-1, keepdims=True)
    normals = u / axes
    normals /= np.linalg.norm(normals, axis=-1, keepdims=True)
    frames = frames_from_normals(normals, rng.uniform(0, 2 * np.pi, (lanes, n_c)))
    return np.einsum("lij,lcj->lci", turn, u * axes), np.einsum("lij,lcjk->lcik", turn, frames)


def signed_axes(rng, lanes: int, length: float) -> np.ndarray:
    """The six unit forces and six torques of a newton at the given length."""
    half = np.vstack([np.eye(6), -np.eye(6)]) * np.repeat([1.0, length], 3)
    return np.tile(half, (lanes, 1, 1))


def _six_forces(rng, lanes, length):
    return signed_axes(rng, lanes, length)[:, [0, 1, 2, 6, 7, 8]]


def _six_torques(rng, lanes, length):
    return signed_axes(rng, lanes, length)[:, [3, 4, 5, 9, 10, 11]]


def _one_sided(rng, lanes, length):
    vertices = random_wrenches(rng, lanes, 3, length)
    vertices[: lanes // 3] = 0.0
    vertices[: lanes // 3, 0, 0] = 1.0
    return vertices


def random_wrenches(rng, lanes: int, count: int, length: float) -> np.ndarray:
    return np.concatenate([unit_vectors(rng, lanes, count), length * unit_vectors(rng, lanes, count)], axis=-1)


DISTURBANCES = {"forces": _six_forces, "torques": _six_torques, "wrenches": signed_axes, "one-sided": _one_sided}


@dataclass(frozen=True, kw_only=True)
class Setting:
    """One recipe: what a family of grasps has in common."""

    closure: str = "spread"
    load: tuple[float, float] = (0.0, 0.0)
    """Required force, and torque at the object's length, as a share of the sum of the largest normal forces."""
    friction: tuple[float, float] = (0.5, 0.5)
    """Range, drawn log-uniformly for each contact."""
    length: float = 0.05
    max_force: tuple[float, float] = (5.0, 5.0)
    disturbances: str = "forces"
    offset: float = 0.0
    """Distance of the centre of mass from the ellipsoid's centre, in lengths."""
    absent: bool = False
    cone_margin: float = 0.0
    """As a share of the largest normal force."""


SETTINGS = {
    "plain": Setting(),
    "around": Setting(closure="around", disturbances="wrenches"),
    "one side": Setting(closure="one side"),
    "one side, loaded": Setting(closure="one side", load=(0.0, 0.2)),
    "light load": Setting(closure="around", load=(0.0, 0.1)),
    "heavy load": Setting(closure="around", load=(0.05, 0.4)),
    "beyond bearable": Setting(load=(1.0, 4.0), disturbances="wrenches"),
    "slippery": Setting(closure="around", friction=(0.02, 0.1), load=(0.0, 0.005)),
    "rough": Setting(friction=(1.0, 1.5), load=(0.0, 0.3)),
    "uneven": Setting(closure="around", friction=(0.05, 1.5), max_force=(1.0, 30.0), disturbances="wrenches"),
    "millimetres": Setting(closure="around", length=1e-3, max_force=(1e-2, 1e-2), load=(0.0, 0.2)),
    "metres": Setting(closure="around", length=1.0, max_force=(1e4, 1e4), load=(0.0, 0.2), disturbances="wrenches"),
    "torques": Setting(closure="around", disturbances="torques", load=(0.0, 0.1)),
    "one-sided": Setting(disturbances="one-sided", load=(0.0, 0.3)),
    "off centre": Setting(closure="around", offset=3.0, friction=(0.5, 1.0), load=(0.0, 0.1)),
    "absent": Setting(closure="around", absent=True, friction=(0.3, 1.0), load=(0.0, 0.1)),
    "cone margin": Setting(closure="around", cone_margin=0.05, load=(0.0, 0.1)),
}


def _log_uniform(rng, low, high, shape):
    return np.exp(rng.uniform(np.log(low), np.log(high), shape))


def make_family(seed: int, lanes: int, n_c: int, setting: Setting, n_d: int, polytope: bool = False) -> Batch:
    """One family. A polytope has between n_d / 2 and n_d random wrenches in place of the setting's disturbances."""
    rng = np.random.default_rng(seed)
    points, frames = ellipsoid_contacts(rng, lanes, n_c, setting.closure)
    positions = setting.length * (points + setting.offset * unit_vectors(rng, lanes, 1))
    max_force = _log_uniform(rng, *setting.max_force, (lanes, n_c))
    load = rng.uniform(*setting.load, (lanes, 1)) * max_force.sum(axis=-1, keepdims=True)
    torque_share = setting.length * rng.uniform(0, 0.5, (lanes, 1))
    required = np.concatenate([unit_vectors(rng, lanes), torque_share * unit_vectors(rng, lanes)], axis=-1) * load
    vertices = np.zeros((lanes, n_d, 6))
    if polytope:
        vertices[:] = random_wrenches(rng, lanes, n_d, setting.length)
        vertices[np.arange(n_d) >= rng.integers(n_d // 2, n_d + 1, lanes)[:, None]] = 0.0
    else:
        some = DISTURBANCES[setting.disturbances](rng, lanes, setting.length)
        vertices[:, : some.shape[1]] = some
    active = np.ones((lanes, n_c), bool)
    if setting.absent:
        present = rng.integers(max(2, n_c - 3), n_c + 1, lanes)
        active = rng.permuted(np.arange(n_c) < present[:, None], axis=-1)
    return Batch(
        positions=positions,
        frames=frames,
        friction=_log_uniform(rng, *setting.friction, (lanes, n_c)),
        max_force=max_force,
        vertices=vertices,
        required_wrench=required,
        active=active,
        cone_margin=setting.cone_margin * max_force.min(axis=-1),
    )


def real_grasps(n_d: int) -> dict[str, Batch]:
    """The recorded grasps where they are present: without load, with their weight, and with five times that."""
    if not REAL_GRASPS.exists():
        return {}
    with np.load(REAL_GRASPS, allow_pickle=False) as data:
        positions, normals, mass = data["positions"], data["outward_normals"], data["mass"]
        friction = data["friction"]
    lanes, n_c = positions.shape[:2]
    frames = frames_from_normals(normals / np.linalg.norm(normals, axis=-1, keepdims=True), np.zeros((lanes, n_c)))
    vertices = np.zeros((lanes, n_d, 6))
    vertices[:, :6] = _six_forces(None, lanes, 1.0)
    plain = Batch(
        positions=positions,
        frames=frames,
        friction=np.tile(friction[:, None], (1, n_c)),
        max_force=np.full((lanes, n_c), 5.0),
        vertices=vertices,
        required_wrench=np.zeros((lanes, 6)),
        active=np.ones((lanes, n_c), bool),
        cone_margin=np.zeros(lanes),
    )
    weight = np.zeros((lanes, 6))
    weight[:, 2] = 9.81 * mass
    return {
        "real": plain,
        "real, weight": replace(plain, required_wrench=weight),
        "real, five weights": replace(plain, required_wrench=5 * weight),
    }


# lanes a family, n_d, n_e, by number of contacts; the largest grasps are the dearest for the independent solvers.
AXES_SHAPES = {3: (290, 12, 8), 4: (290, 12, 8), 5: (260, 12, 8), 8: (190, 12, 8), 12: (100, 12, 8), 20: (50, 12, 8)}
POLYTOPES = {"4 contacts, polytopes": (4, 300, 1000, 8), "8 contacts, hexagonal": (8, 300, 64, 6)}
POLYTOPE_SETTINGS = ("around", "heavy load", "uneven")

GROUPS = tuple(f"{n_c} contacts" for n_c in AXES_SHAPES) + tuple(POLYTOPES)


@cache
def group(name: str) -> Group:
    """All families of one shape, by a name from `GROUPS`."""
    families: dict[str, Batch] = {}
    seed = 1000 * GROUPS.index(name)
    if name in POLYTOPES:
        n_c, lanes, n_d, edges = POLYTOPES[name]
        for k, key in enumerate(POLYTOPE_SETTINGS):
            families[key] = make_family(seed + k, lanes, n_c, SETTINGS[key], n_d, polytope=True)
    else:
        n_c = int(name.split()[0])
        lanes, n_d, edges = AXES_SHAPES[n_c]
        for k, (key, setting) in enumerate(SETTINGS.items()):
            families[key] = make_family(seed + k, lanes, n_c, setting, n_d)
        if n_c == 4:
            families |= real_grasps(n_d)
    names = np.concatenate([np.full(len(b), key) for key, b in families.items()])
    return Group(cone_edges=edges, family=names, batch=concatenate(list(families.values())))


LANES_A_FAMILY = 8
SAMPLED = ("plain", "around", "light load", "uneven", "one side", "torques")


def sample(name: str = "4 contacts", families=SAMPLED, count: int = LANES_A_FAMILY) -> Batch:
    """The first lanes of some families; always the same shape, so that its program is compiled once."""
    known = group(name)
    return concatenate([known.batch[np.flatnonzero(known.family == f)[:count]] for f in families])
