"""Which parts of a hand can run into each other, and how near they are: capsules and boxes in place of the geoms."""

from dataclasses import dataclass

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from jax import lax

from jaxgrasp.arrays import fold, safe_divide, safe_norm
from jaxgrasp.geometry.pairs import Geom, touch
from jaxgrasp.hands.kinematics import Poses, matrices, place

_BOX, _SPHERE, _CAPSULE = (int(getattr(mujoco.mjtGeom, f"mjGEOM_{name}")) for name in ("BOX", "SPHERE", "CAPSULE"))
# A capsule needs some length for its axis to have a direction, m.
_SHORTEST = 1e-6
# Rounds in which the nearest point of a capsule's axis to a box is sought: each leaves two thirds of it.
_THIRDS = 14
# Parts are flat where one of the two shorter half widths is below this share of the other.
_FLAT = 0.5
# Random configurations to see which parts can meet, and how near counts, m.
_CONFIGURATIONS, _NEAR = 300, 0.005
# The x, y or z axis of a geom, to be turned to z.
_TURNS = {0: ((0, 0, 1), (0, 1, 0), (-1, 0, 0)), 1: ((1, 0, 0), (0, 0, 1), (0, -1, 0)), 2: np.eye(3)}


@dataclass(frozen=True)
class SelfPairs:
    """Parts of a hand that can meet. Arrays have one entry for each part, pairs index them by kind."""

    bodies: np.ndarray
    offsets: np.ndarray
    """(3, parts), in their bodies, m."""
    turns: np.ndarray
    """(3, 3, parts)."""
    sizes: np.ndarray
    """(3, parts): radius and half length of a capsule, half extents of a box, m."""
    pairs: dict[tuple[str, str], np.ndarray]
    """(2, pairs) of parts, by the kinds of the two."""

    def distances(self, poses: Poses) -> jax.Array:
        """(pairs, *lanes), m, negative where parts are inside each other."""
        lanes, dtype = poses.positions.shape[2:], poses.positions.dtype
        rotations, positions = place(
            poses.rotations[:, :, self.bodies], poses.positions[:, self.bodies], self.offsets, self.turns
        )
        sizes = jnp.asarray(self.sizes, dtype).reshape(*self.sizes.shape, *[1] * len(lanes))
        sizes = jnp.broadcast_to(sizes, (*self.sizes.shape, *lanes))
        found = [jnp.full((1, *lanes), jnp.inf, dtype)]
        for kinds, pairs in self.pairs.items():
            one, other = (Geom(positions[:, of], rotations[:, :, of], sizes[:, of]) for of in pairs)
            found.append(_DISTANCES[kinds](one, other))
        return jnp.concatenate(found)


def _capsules(a: Geom, b: Geom) -> jax.Array:
    half_a, half_b = a.rotation[:, 2] * a.size[1], b.rotation[:, 2] * b.size[1]
    apart = a.position - b.position

    # How a distance changes does not depend on how its points move along the parts: these count as constant.
    aa, ab, bb = _dot(half_a, half_a), _dot(half_a, half_b), _dot(half_b, half_b)
    u, v = _dot(half_a, apart), _dot(half_b, apart)
    determinant = aa * bb - ab * ab
    x = jnp.clip(safe_divide(ab * v - bb * u, determinant), -1, 1)
    y = jnp.clip((ab * x + v) / bb, -1, 1)
    x, y = (lax.stop_gradient(z) for z in (jnp.clip((ab * y - u) / aa, -1, 1), y))
    return safe_norm(apart + x * half_a - y * half_b, 0) - a.size[0] - b.size[0]


def _capsule_and_box(a: Geom, b: Geom) -> jax.Array:
    turned = lambda vector: fold(jnp.add, [b.rotation[i] * vector[i] for i in range(3)])
    centre, half = turned(a.position - b.position), turned(a.rotation[:, 2] * a.size[1])

    def distance(at: jax.Array, centre: jax.Array, half: jax.Array) -> jax.Array:
        beyond = jnp.abs(centre + at * half) - b.size
        return safe_norm(jnp.maximum(beyond, 0), 0) + jnp.minimum(fold(jnp.maximum, beyond), 0)

    fixed = lax.stop_gradient((centre, half))

    def shorten(_: int, ends: tuple[jax.Array, jax.Array]) -> tuple[jax.Array, jax.Array]:
        low, high = ends
        first, second = (2 * low + high) / 3, (low + 2 * high) / 3
        left = distance(first, *fixed) < distance(second, *fixed)
        return jnp.where(left, low, first), jnp.where(left, second, high)

    # The distance from a box is convex along the capsule's axis.
    start = -jnp.ones_like(centre[0]), jnp.ones_like(centre[0])
    low, high = lax.fori_loop(0, _THIRDS, shorten, start)
    return distance(0.5 * (low + high), centre, half) - a.size[0]


def _boxes(a: Geom, b: Geom) -> jax.Array:
    return touch("box", "box", a, b).distance.min(0)


_DISTANCES = {("capsule", "capsule"): _capsules, ("capsule", "box"): _capsule_and_box, ("box", "box"): _boxes}


def _dot(a: jax.Array, b: jax.Array) -> jax.Array:
    """Of vectors (3, ...), one a lane."""
    return fold(jnp.add, a * b)


def self_pairs(model: mujoco.MjModel, joints: np.ndarray, moved: np.ndarray, geoms: np.ndarray) -> SelfPairs:
    """Finds which parts of a hand can run into each other.

    MuJoCo's masks do not tell: they are set so that what need not be simulated is left out (the fingertips of the
    Shadow Hand pass through each other there). So all pairs count, but for parts of one body or of two bodies with
    one joint between them or none that is to be moved, those that overlap in the reference configuration already, and
    those that come nowhere near each other in random configurations. Boxes are themselves; all else becomes the capsule
    along its longest side, whose radius is the mean of its other two half widths, or, where it is flat, the box around
    it.

    Args:
        model: The scene.
        joints: Those of the hand that are to be moved.
        moved: (bodies, joints), bool: which of them move a body.
        geoms: Geoms of the hand that count.
    """
    kinds, sizes, centres, turns = zip(*[_part(model, geom) for geom in geoms], strict=True)
    bodies, turned = model.geom_bodyid[geoms], matrices(model.geom_quat[geoms])
    candidates = [
        (a, b) if kinds[a] != "box" else (b, a)
        for a in range(len(geoms))
        for b in range(a)
        if not _neighbours(model, int(bodies[a]), int(bodies[b])) and (moved[bodies[a]] != moved[bodies[b]]).any()
    ]
    found: dict[tuple[str, str], list[tuple[int, int]]] = {}
    for pair, meets in zip(
        candidates, _meet(model, joints, geoms[np.array(candidates, int).reshape(-1, 2)]), strict=True
    ):
        if meets:
            found.setdefault((kinds[pair[0]], kinds[pair[1]]), []).append(pair)
    return SelfPairs(
        bodies=bodies,
        offsets=model.geom_pos[geoms].T + np.einsum("ijn,nj->in", turned, np.array(centres)),
        turns=np.einsum("ijn,njk->ikn", turned, np.array(turns)),
        sizes=np.array(sizes).T,
        pairs={kinds: np.array(pairs).T for kinds, pairs in found.items()},
    )


def _meet(model: mujoco.MjModel, joints: np.ndarray, pairs: np.ndarray) -> np.ndarray:
    """Which pairs of geoms (n, 2) are apart in the reference configuration and come near in some other."""
    data, random = mujoco.MjData(model), np.random.default_rng(0)
    low, high = np.where(model.jnt_limited[joints, None], model.jnt_range[joints], (-np.pi, np.pi)).T
    configurations = np.tile(model.qpos0, (_CONFIGURATIONS + 1, 1))
    configurations[1:, model.jnt_qposadr[joints]] = random.uniform(low, high, (_CONFIGURATIONS, len(joints)))
    meet, apart = np.zeros(len(pairs), bool), np.zeros(len(pairs), bool)
    for number, qpos in enumerate(configurations):
        data.qpos[:] = qpos
        mujoco.mj_kinematics(model, data)
        for row in np.flatnonzero(~meet):
            near = mujoco.mj_geomDistance(model, data, *pairs[row], _NEAR, None)
            if number == 0:
                apart[row] = near > 0
            elif near < _NEAR:
                meet[row] = True
    return meet & apart


def _part(model: mujoco.MjModel, geom: int) -> tuple[str, tuple[float, float, float], np.ndarray, np.ndarray]:
    """Kind and size, and centre and rotation in the geom's frame."""
    kind, size, middle = model.geom_type[geom], model.geom_size[geom], np.zeros(3)
    if kind == _BOX:
        return "box", tuple(size), middle, np.eye(3)
    if kind in (_SPHERE, _CAPSULE):
        return "capsule", (size[0], max(size[1] if kind == _CAPSULE else 0.0, _SHORTEST), 0.0), middle, np.eye(3)
    middle, half = np.split(model.geom_aabb[geom], 2)
    along = int(half.argmax())
    across = np.delete(half, along)
    if across.min() < _FLAT * across.max():
        return "box", tuple(half), middle, np.eye(3)
    radius = float(across.mean())
    return "capsule", (radius, max(float(half[along]) - radius, _SHORTEST), 0.0), middle, np.array(_TURNS[along], float)


def _neighbours(model: mujoco.MjModel, a: int, b: int) -> bool:
    """Whether at most one joint is between two bodies."""
    a, b = int(model.body_weldid[a]), int(model.body_weldid[b])
    above = lambda body: int(model.body_weldid[model.body_parentid[body]])
    return a == b or above(a) == b or above(b) == a
