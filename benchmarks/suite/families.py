"""Twenty-seven families of grasps to try the truth of answers on: random, degenerate and ill-scaled.

Every family has one shape: a number of contacts, of edges, and one kind of disturbance set. Disturbances are of the
order of a newton, moments over the grasp's size.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from benchmarks.suite.grasps import (
    DIRECTIONS,
    Generator,
    ellipsoid,
    grasps,
    loaded,
    log_uniform,
    size_of,
    units,
    with_vertices,
)
from benchmarks.suite.lanes import Lanes

SIX_FORCES = np.vstack([np.eye(6)[:3], -np.eye(6)[:3]])[None]


@dataclass(frozen=True, kw_only=True)
class Family:
    """A recipe, `make(rng, lanes, n_c)`, and what its lanes have in common."""

    n_c: int = 4
    make: Callable[[Generator, int, int], Lanes]
    decades: int = 0
    """Over how many decades max_force spreads within a grasp."""


def plain(rng: Generator, lanes: int, n_c: int) -> Lanes:
    return grasps(rng, *ellipsoid(rng, units(rng, lanes, n_c)), vertices=SIX_FORCES)


def pairs(rng: Generator, lanes: int, n_c: int) -> Lanes:
    """Opposite contacts, one pair after the other."""
    half = units(rng, lanes, n_c // 2)
    positions, normals = ellipsoid(rng, np.concatenate([half, -half], axis=1))
    return with_vertices(rng, grasps(rng, positions, normals))


def jaws(rng: Generator, lanes: int, n_c: int) -> Lanes:
    """Two contacts whose normals lie in their line, in half of the lanes along an axis."""
    line = units(rng, lanes, 1)
    along = rng.random(lanes) < 0.5
    line[along, 0] = np.eye(3)[rng.integers(0, 3, along.sum())]
    normals = np.concatenate([line, -line], axis=1)
    return with_vertices(rng, grasps(rng, log_uniform(rng, 0.01, 0.2, (lanes, 1, 1)) * normals, normals))


def collinear(rng: Generator, lanes: int, n_c: int, off: float | np.ndarray = 0.0) -> Lanes:
    """Contacts on a line, in half of the lanes not through the centre of mass; or hardly off it."""
    line = units(rng, lanes, 1)
    line[: lanes // 4, 0] = np.eye(3)[rng.integers(0, 3, lanes // 4)]
    start = 0.5 * units(rng, lanes, 1) * (rng.random((lanes, 1, 1)) < 0.5)
    positions = start + line * rng.uniform(-1, 1, (lanes, n_c, 1)) + off * units(rng, lanes, n_c)
    size = log_uniform(rng, 0.01, 0.2, (lanes, 1, 1))
    return with_vertices(rng, grasps(rng, size * positions, units(rng, lanes, n_c)))


def coincident(rng: Generator, lanes: int, n_c: int, off: float | np.ndarray = 0.0) -> Lanes:
    """Two or more contacts in one point, in some lanes the centre of mass; or hardly apart."""
    positions, normals = ellipsoid(rng, units(rng, lanes, n_c))
    together = np.arange(n_c) < rng.integers(2, n_c + 1, lanes)[:, None]
    point = positions[:, :1] * (rng.random((lanes, 1, 1)) < 0.8)
    spread = np.where(together[..., None], point + off * positions, positions)
    return with_vertices(rng, grasps(rng, spread, normals))


def planar(rng: Generator, lanes: int, n_c: int, off: float | np.ndarray = 0.0) -> Lanes:
    """Contacts and normals in a plane, in half of the lanes a coordinate plane; or hardly out of it."""
    u = units(rng, lanes, n_c)
    u[..., 2] *= off if np.ndim(off) == 0 else off[..., 0]
    u /= np.linalg.norm(u, axis=-1, keepdims=True)
    positions, normals = ellipsoid(rng, u)
    turn = np.linalg.qr(rng.normal(size=(lanes, 3, 3)))[0]
    turn[: lanes // 2] = np.eye(3)
    positions, normals = (np.einsum("lij,lcj->lci", turn, x) for x in (positions, normals))
    return with_vertices(rng, grasps(rng, positions, normals / np.linalg.norm(normals, axis=-1, keepdims=True)))


def nearly(rng: Generator, lanes: int, n_c: int) -> Lanes:
    """Nearly collinear, coincident or planar, by 1e-15 to 1e-1 of the size."""
    which = rng.integers(0, 3, lanes)
    off = log_uniform(rng, 1e-15, 0.1, (lanes, 1, 1))
    made = [recipe(rng, lanes, n_c, off) for recipe in (collinear, coincident, planar)]
    stacks = {name: np.stack([m.arrays()[name] for m in made]) for name in made[0].arrays()}
    return replace(made[0], **{name: s[which, np.arange(lanes)] for name, s in stacks.items()})


def one_side(rng: Generator, lanes: int, n_c: int) -> Lanes:
    """Normals within 60 degrees of a direction, or parallel: most of them without closure."""
    u = units(rng, lanes, n_c)
    u[..., 2] = np.abs(u[..., 2]) + 0.6
    u /= np.linalg.norm(u, axis=-1, keepdims=True)
    positions, normals = ellipsoid(rng, u)
    normals[: lanes // 3] = normals[: lanes // 3, :1]
    return with_vertices(rng, grasps(rng, positions, normals))


def twins(rng: Generator, lanes: int, n_c: int) -> Lanes:
    """Every contact twice, in half of the lanes with the same tangents."""
    positions, normals = ellipsoid(rng, units(rng, lanes, n_c // 2))
    twice = lambda x: np.concatenate([x, x], axis=1)  # noqa: E731
    made = grasps(rng, twice(positions), twice(normals), edges=5)
    made.frames[: lanes // 2, n_c // 2 :] = made.frames[: lanes // 2, : n_c // 2]
    return with_vertices(rng, made)


def sizes(rng: Generator, lanes: int, n_c: int) -> Lanes:
    """From a nanometre to a thousand kilometres, strength from a micronewton to a meganewton."""
    made = grasps(rng, *ellipsoid(rng, units(rng, lanes, n_c), size=(1e-9, 1e6)))
    return with_vertices(
        rng, replace(made, max_force=log_uniform(rng, 1e-6, 1e6, (lanes, 1)) * np.ones(n_c)), kinds=(0, 1, 2)
    )


def off_centre(rng: Generator, lanes: int, n_c: int) -> Lanes:
    """The centre of mass outside, up to ten thousand sizes away."""
    positions, normals = ellipsoid(rng, units(rng, lanes, n_c))
    away = log_uniform(rng, 0.1, 1e4, (lanes, 1, 1)) * np.abs(positions).max((1, 2), keepdims=True)
    return with_vertices(rng, grasps(rng, positions + away * units(rng, lanes, 1), normals), kinds=(0, 1, 2))


def rough(rng: Generator, lanes: int, n_c: int) -> Lanes:
    """Friction from 0 to 5, another for each contact."""
    friction = np.where(
        rng.random((lanes, 1)) < 0.5, rng.uniform(0, 5, (lanes, n_c)), log_uniform(rng, 1e-4, 5, (lanes, n_c))
    )
    friction[rng.random((lanes, n_c)) < 0.05] = 0.0
    made = grasps(rng, *ellipsoid(rng, units(rng, lanes, n_c)), edges=6, friction=friction)
    return with_vertices(rng, made, kinds=(0, 1, 2))


def frictionless(rng: Generator, lanes: int, n_c: int) -> Lanes:
    """Eight contacts without friction, or one finger with a little."""
    friction = np.zeros((lanes, n_c))
    friction[: lanes // 2, 0] = 0.1
    return with_vertices(rng, grasps(rng, *ellipsoid(rng, units(rng, lanes, n_c)), friction=friction))


def spread_over(decades: int) -> Callable[[Generator, int, int], Lanes]:
    def make(rng: Generator, lanes: int, n_c: int) -> Lanes:
        force = 10.0 ** (decades * rng.uniform(-0.5, 0.5, (lanes, n_c)))
        # The whole spread in every lane.
        force[:, 0], force[:, 1] = 10.0 ** (decades / 2), 10.0 ** (-decades / 2)
        made = grasps(rng, *ellipsoid(rng, units(rng, lanes, n_c)), max_force=rng.permuted(force, axis=-1))
        made = with_vertices(rng, made, kinds=(0, 1, 2))
        some = loaded(rng, made, np.ones(lanes, bool))
        return replace(made, wrench=np.where(rng.random((lanes, 1)) < 0.25, some.wrench, 0))

    return make


def absent(rng: Generator, lanes: int, n_c: int) -> Lanes:
    """None to all of the contacts absent, their data any numbers, NaN or infinite."""
    made = plain(rng, lanes, n_c)
    active = rng.permuted(np.arange(n_c) < rng.integers(0, n_c + 1, lanes)[:, None], axis=-1)
    made = with_vertices(rng, replace(made, active=active), kinds=(0, 1, 2))
    junk = rng.choice([np.nan, np.inf, -1.0, 1e30, 0.0], made.active.shape)
    arrays = {name: made.arrays()[name].copy() for name in ("positions", "frames", "friction", "max_force")}
    for value in arrays.values():
        value[~active] = junk[~active].reshape(-1, *[1] * (value.ndim - 2))
    return replace(made, **arrays)


def loads(rng: Generator, lanes: int, n_c: int) -> Lanes:
    """Loads, borne and not."""
    made = with_vertices(rng, grasps(rng, *ellipsoid(rng, units(rng, lanes, n_c))))
    return loaded(rng, made, rng.random(lanes) < 0.5)


def one_sided(rng: Generator, lanes: int, n_c: int) -> Lanes:
    """One to three wrenches, or one force alone, half of them with a load; a few lanes without any disturbance."""
    made = with_vertices(rng, grasps(rng, *ellipsoid(rng, units(rng, lanes, n_c))), kinds=(0, 2, 4))
    keep = np.arange(DIRECTIONS) < rng.choice([0, 1, 2, 3], lanes, p=[0.05, 0.4, 0.3, 0.25])[:, None]
    vertices = np.where(keep[..., None], rng.permuted(made.vertices, axis=1), 0.0)
    return loaded(rng, replace(made, vertices=vertices), rng.random(lanes) < 0.7) if lanes else made


def boxes(rng: Generator, lanes: int, n_c: int) -> Lanes:
    made = grasps(rng, *ellipsoid(rng, units(rng, lanes, n_c)))
    half = rng.uniform(0, 1, (lanes, 6)) * (rng.random((lanes, 6)) < 0.8)
    half[:, 3:] *= size_of(made)
    return replace(made, half_extents=half)


def balls(rng: Generator, lanes: int, n_c: int) -> Lanes:
    half = units(rng, lanes, n_c // 2)
    made = grasps(rng, *ellipsoid(rng, np.concatenate([half, -half], axis=1)))
    radii = rng.uniform(0, 1, (lanes, 2)) * (rng.random((lanes, 2)) < 0.8)
    radii[:, 1:] *= size_of(made)
    return replace(made, radii=radii)


def ellipsoids(rng: Generator, lanes: int, n_c: int) -> Lanes:
    """Of any rank."""
    made = grasps(rng, *ellipsoid(rng, units(rng, lanes, n_c)))
    matrix = rng.normal(size=(lanes, 6, 6)) * (np.arange(6) < rng.integers(1, 7, lanes)[:, None])[:, None]
    matrix /= np.linalg.norm(matrix, axis=(1, 2), keepdims=True)
    matrix[:, 3:] *= size_of(made)[..., None]
    return replace(made, shape_matrix=matrix)


def smoothed(rng: Generator, lanes: int, n_c: int) -> Lanes:
    """Smoothed sets; two thirds of the grasps are pairs, collinear or planar."""
    which = rng.integers(0, 3, lanes)
    made = [with_vertices(rng, plain(rng, lanes, n_c)), collinear(rng, lanes, n_c), planar(rng, lanes, n_c)]
    stacks = {name: np.stack([m.arrays()[name] for m in made]) for name in made[1].arrays()}
    chosen = replace(made[1], **{name: s[which, np.arange(lanes)] for name, s in stacks.items()})
    return replace(chosen, width=log_uniform(rng, 1e-6, 1e-1, lanes))


def reserved(rng: Generator, lanes: int, n_c: int) -> Lanes:
    """Facet rows that keep something in reserve, in some lanes more than there is."""
    made = loaded(rng, plain(rng, lanes, n_c), np.ones(lanes, bool))
    made = replace(made, wrench=np.where(rng.random((lanes, 1)) < 0.5, made.wrench, 0))
    return replace(with_vertices(rng, made), reserve=made.max_force.min(-1) * log_uniform(rng, 1e-4, 2.0, lanes))


FAMILIES = {
    "plain, 3 contacts": Family(n_c=3, make=plain),
    "plain, 8 contacts": Family(n_c=8, make=plain),
    "antipodal pairs": Family(n_c=2, make=pairs),
    "parallel jaws": Family(n_c=2, make=jaws),
    "two pairs": Family(make=pairs),
    "collinear": Family(make=collinear),
    "coincident": Family(make=coincident),
    "planar": Family(make=planar),
    "one side": Family(make=one_side),
    "twins": Family(n_c=6, make=twins),
    "nearly degenerate": Family(make=nearly),
    "sizes 1e-9 to 1e6 m": Family(make=sizes),
    "off centre": Family(make=off_centre),
    "friction 0 to 5": Family(n_c=5, make=rough),
    "frictionless": Family(n_c=8, make=frictionless),
    "2 decades": Family(make=spread_over(2), decades=2),
    "4 decades": Family(make=spread_over(4), decades=4),
    "8 decades": Family(make=spread_over(8), decades=8),
    "16 decades": Family(make=spread_over(16), decades=16),
    "absent contacts": Family(n_c=8, make=absent),
    "loads": Family(make=loads),
    "one-sided sets": Family(make=one_sided),
    "boxes": Family(make=boxes),
    "balls": Family(make=balls),
    "ellipsoids": Family(make=ellipsoids),
    "smoothed sets": Family(make=smoothed),
    "reserve": Family(make=reserved),
}


def make(name: str, lanes: int, seed: tuple[int, ...]) -> Lanes:
    """One batch of a family; the same for the same seed."""
    family = FAMILIES[name]
    rng = np.random.default_rng([list(FAMILIES).index(name), *seed])
    made = family.make(rng, lanes, family.n_c)
    order = rng.permutation(lanes)
    shared = made.vertices is not None and len(made.vertices) == 1
    return replace(made[order], vertices=made.vertices) if shared else made[order]
