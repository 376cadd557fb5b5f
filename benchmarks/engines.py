"""Do the engines of contact geometry find C MuJoCo's contacts? `python -m benchmarks.engines [HAND.xml ...]`.

Random configurations of hands and objects of every kind, moved along a random line until they touch, at most 3 mm deep.
Engine `mujoco` has to give what mj_forward gives, exactly; engine `mjx` is compared pair by pair of geoms that
penetrate. Writes engines.md beside this file after every scene.
"""

from __future__ import annotations

import argparse
import os
import platform
import time
from collections import defaultdict
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

import jax
import mujoco
import numpy as np

jax.config.update("jax_enable_x64", True)

from jaxgrasp.hands import HandObject, Scene  # noqa: E402
from jaxgrasp.hands.engines import Geometry  # noqa: E402
from jaxgrasp.hands.hand_names import hand_file  # noqa: E402
from jaxgrasp.hands.mujoco_engine import MujocoEngine  # noqa: E402
from jaxgrasp.hands.object_files import PRIMITIVES  # noqa: E402

COUNT = 1000
WIDTH = 0.06
"""Of the objects, m."""
DEEPEST = 3e-3
TILE = 50
"""Configurations at a time of the engines in JAX."""
NEAR = 1e-4
"""Depths count as equal up to here, m."""
KINDS = (*PRIMITIVES, "mesh", "pieces")
HANDS = ("four_fingers", "shadow_hand")


@dataclass
class Row:
    """One hand and one object."""

    hand: str
    object: str
    exact: int = 0
    """Configurations in which engine `mujoco` gives mj_forward's numbers bit by bit."""
    touching: int = 0
    rate: dict[str, float] = field(default_factory=dict)
    """Configurations a second."""
    first: dict[str, float] = field(default_factory=dict)
    """Seconds of the first call, compilation included."""
    pairs: dict[str, list[float]] = field(default_factory=lambda: defaultdict(list))
    """Errors of the depth, m, by kinds of geoms; inf where MJX finds no contact."""
    refused: str = ""


def cuboid(corner: np.ndarray, size: np.ndarray) -> np.ndarray:
    """Corners (8, 3)."""
    return corner + np.stack(np.meshgrid([0, 1], [0, 1], [0, 1], indexing="ij"), -1).reshape(8, 3) * size


def ball(count: int) -> np.ndarray:
    """Points (count, 3) of a unit sphere, spread evenly."""
    height = (2 * np.arange(count) + 1) / count - 1
    azimuth = np.pi * (3 - np.sqrt(5)) * np.arange(count)
    ring = np.sqrt(1 - height**2)
    return np.stack([ring * np.cos(azimuth), ring * np.sin(azimuth), height], -1)


def object_of(kind: str) -> str | mujoco.MjSpec:
    """A primitive by name, a convex mesh of 24 corners, or an L of three convex pieces; 1 wide."""
    if kind in PRIMITIVES:
        return kind
    spec = mujoco.MjSpec()
    body = spec.worldbody.add_body(name="solid")
    hulls = [ball(24) * [0.5, 0.4, 0.6]]
    if kind == "pieces":
        starts = np.array([[-0.5, -0.2, -0.5], [-0.5, -0.2, -0.1], [-0.1, -0.2, -0.5]])
        sizes = np.array([[0.4, 0.4, 0.4], [0.4, 0.4, 0.6], [0.6, 0.4, 0.4]])
        hulls = [cuboid(*parts) for parts in zip(starts, sizes, strict=True)]
    for number, corners in enumerate(hulls):
        spec.add_mesh(name=f"hull-{number}", uservert=(WIDTH * corners).ravel())
        body.add_geom(type=mujoco.mjtGeom.mjGEOM_MESH, meshname=f"hull-{number}")
    return spec


def scene_of(hand: str, kind: str) -> Scene:
    """The scene; MJX collides no cylinder with boxes and meshes, so the palm of the four fingers does not collide."""
    spec = mujoco.MjSpec.from_file(str(hand_file(hand)))
    if hand == "four_fingers":
        spec.geom("palm").contype = spec.geom("palm").conaffinity = 0
    scale = WIDTH if kind in PRIMITIVES else 1.0
    return Scene.build(hand=spec, object=object_of(kind), scale=scale, mass=0.1)


def depths(geometry: Geometry) -> np.ndarray:
    """The deepest penetration (n,), m; negative where there is none."""
    return -np.asarray(geometry.points.distance).min(-1)


def configurations(scene: Scene, hand: HandObject, seed: int) -> np.ndarray:
    """(n, nq): random joints, and the object as deep as is wanted along a line through the hand."""
    model, rng = scene.model, np.random.default_rng(seed)
    low, high = model.jnt_range[hand.joints].T
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    touching = np.flatnonzero(np.isin(model.geom_bodyid, hand.touching_links) & (model.geom_contype > 0))
    engine = finder(hand)
    kept = []
    while sum(map(len, kept)) < COUNT:
        joints = rng.uniform(low, high, (COUNT, len(low)))
        turn = rng.normal(size=(COUNT, 4))
        turn /= np.linalg.norm(turn, axis=-1, keepdims=True)
        aim = data.geom_xpos[rng.choice(touching, COUNT)] + rng.normal(scale=0.01, size=(COUNT, 3))
        line = rng.normal(size=(COUNT, 3))
        line /= np.linalg.norm(line, axis=-1, keepdims=True)
        place = lambda way: scene.qpos(joints=joints, object=np.c_[aim + way[:, None] * line, turn])  # noqa: B023, E731
        inside, outside, wanted = np.zeros(COUNT), np.full(COUNT, 0.5), rng.uniform(0, DEEPEST, COUNT)
        for _ in range(20):
            middle = (inside + outside) / 2
            deep = depths(engine.find(place(middle))) > wanted
            inside, outside = np.where(deep, middle, inside), np.where(deep, outside, middle)
        qpos = place(outside)
        depth = depths(engine.find(qpos))
        kept.append(qpos[(depth > 0) & (depth <= DEEPEST)])
    return np.concatenate(kept)[:COUNT]


def finder(hand: HandObject) -> MujocoEngine:
    """Engine `mujoco`."""
    engine = hand.engine("mujoco")
    assert isinstance(engine, MujocoEngine)
    return engine


def reference(hand: HandObject, qpos: np.ndarray) -> Iterator[tuple[np.ndarray, dict[tuple[int, int], float]]]:
    """By mj_forward: rows (points, 7) of position, normal out of the object and distance, and depths of pairs."""
    model = hand.model
    data = mujoco.MjData(model)
    mine = np.isin(model.geom_bodyid, hand.bodies)
    # Of bodies that are welded to it, too.
    object = model.body_weldid[model.geom_bodyid] == model.body_weldid[hand.object_body]
    for row in qpos:
        data.qpos = row
        mujoco.mj_forward(model, data)
        points, pairs = [], {}
        for contact in data.contact:
            one, other = contact.geom.tolist()
            if not (mine[one] and object[other] or mine[other] and object[one]):
                continue
            points.append([*contact.pos, *(contact.frame[:3] if object[one] else -contact.frame[:3]), contact.dist])
            pair = (other, one) if object[one] else (one, other)
            pairs[pair] = max(pairs.get(pair, -np.inf), -contact.dist)
        yield np.array(points).reshape(-1, 7), {pair: depth for pair, depth in pairs.items() if depth > 0}


def compare_mujoco(row: Row, hand: HandObject, qpos: np.ndarray) -> list[dict[tuple[int, int], float]]:
    """Counts configurations in which the engine's points are those of mj_forward; returns the depths of pairs."""
    points = finder(hand).find(qpos).points
    kept = []
    for k, (theirs, pairs) in enumerate(reference(hand, qpos)):
        there = np.isfinite(points.distance[k])
        ours = np.c_[points.position[k], points.normal[k], points.distance[k]][there]
        row.exact += bool(np.array_equal(ours, theirs))
        kept.append(pairs)
    row.touching = sum(map(len, kept))
    return kept


def compare_mjx(row: Row, hand: HandObject, distance: np.ndarray, pairs: list[dict[tuple[int, int], float]]) -> None:
    """Errors of MJX's depths by kinds."""
    places = defaultdict(list)
    for slot, pair in enumerate(hand.engine("mjx").slots.pairs):
        places[pair].append(slot)
    kind = lambda g: mujoco.mjtGeom(hand.model.geom_type[g]).name[7:].lower()  # noqa: E731
    for k, found in enumerate(pairs):
        for pair, depth in found.items():
            error = abs(-distance[k, places[pair]].min() - depth)
            row.pairs[" and ".join(map(kind, pair))].append(float(error))


def clock(row: Row, hand: HandObject, qpos: np.ndarray, name: str) -> np.ndarray:
    """Distances (n, slots) that an engine finds; the first call's time and the rate of the second go into the row."""
    start = time.perf_counter()
    engine = hand.engine(name)
    find = engine.find
    if name != "mujoco":
        tiles = qpos.reshape(-1, TILE, qpos.shape[-1])
        mapped = jax.jit(lambda rows: jax.lax.map(engine.find, rows))
        find = lambda _: jax.block_until_ready(mapped(tiles))  # noqa: E731
    found = find(qpos)
    row.first[name] = time.perf_counter() - start
    start = time.perf_counter()
    find(qpos)
    row.rate[name] = len(qpos) / (time.perf_counter() - start)
    return np.asarray(found.points.distance).reshape(len(qpos), -1)


def study(hand_name: str, kind: str, engines: tuple[str, ...]) -> Row:
    """One row of the tables."""
    row = Row(Path(hand_name).parent.name if Path(hand_name).suffix else hand_name, kind)
    scene = scene_of(hand_name, kind)
    # Contacts up to 0 m: what MJX can tell of all kinds.
    hand = scene.hand_object(contact_distance=0.0)
    qpos = configurations(scene, hand, 0)
    pairs = compare_mujoco(row, hand, qpos)
    for engine in engines:
        try:
            distance = clock(row, hand, qpos, engine)
        except ValueError as error:
            row.refused = str(error)
            continue
        if engine == "mjx":
            compare_mjx(row, hand, distance, pairs)
    return row


def report(rows: list[Row], engines: tuple[str, ...]) -> str:
    """The tables, in Markdown."""
    number = lambda table, name, digits: f"{table[name]:,.{digits}f}" if name in table else "-"  # noqa: E731
    lines = [
        "# Engines of contact geometry",
        "",
        f"{COUNT:,} random configurations each, touching, at most {1000 * DEEPEST:g} mm deep; contact distance 0. "
        f"Made by `python -m benchmarks.engines --engines {' '.join(engines)}`.",
        "",
        f"{platform.machine()}, {os.cpu_count()} cores, load {os.getloadavg()[0]:.1f}; jax {jax.__version__}, mujoco "
        f"{mujoco.__version__}, float64.",
        "",
        "| hand | object | `mujoco` = mj_forward | penetrating pairs | `mjx` within 0.1 mm | "
        + " | ".join(f"`{e}`: first call, s; then a second" for e in engines)
        + " |",
        "|" + "---|" * (5 + len(engines)),
    ]
    for row in rows:
        errors = np.concatenate([np.array(x) for x in row.pairs.values()]) if row.pairs else np.zeros(0)
        share = f"{(errors <= NEAR).mean():.2%}" if len(errors) else "refused" if row.refused else "-"
        times = [f"{number(row.first, e, 1)}; {number(row.rate, e, 0)}" for e in engines]
        cells = [row.hand, row.object, f"{row.exact} of {COUNT}", str(row.touching), share, *times]
        lines.append("| " + " | ".join(cells) + " |")
    lines += ["", "## Kinds of pairs, hand and object, by MJX", ""]
    lines += ["| pair | penetrating | within 0.1 mm | not found | median error of others, mm | worst, mm |"]
    lines += ["|---|---|---|---|---|---|"]
    together: dict[str, list[float]] = defaultdict(list)
    for row in rows:
        for kind, errors in row.pairs.items():
            together[kind] += errors
    for kind, values in sorted(together.items()):
        errors = np.array(values)
        off = errors[(errors > NEAR) & np.isfinite(errors)]
        some = [f"{1000 * f(off):.2f}" if len(off) else "-" for f in (np.median, np.max)]
        share, lost = (errors <= NEAR).mean(), np.isinf(errors).mean()
        lines.append(f"| {kind} | {len(errors)} | {share:.2%} | {lost:.2%} | {some[0]} | {some[1]} |")
    if refused := [row for row in rows if row.refused]:
        lines += ["", "## Refused", ""]
        lines += [f"- {row.hand}, {row.object}: {row.refused}" for row in refused]
    return "\n".join([*lines, ""])


def main() -> None:
    """Runs all scenes."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("hands", nargs="*", help="more hands, MJCF files")
    parser.add_argument("--objects", nargs="*", default=KINDS, choices=KINDS)
    parser.add_argument("--engines", nargs="*", default=["mujoco", "mjx", "distance"])
    options = parser.parse_args()
    engines, rows = tuple(options.engines), []
    for hand in (*HANDS, *options.hands):
        for kind in options.objects:
            rows.append(study(hand, kind, engines))
            text = report(rows, engines)
            Path(__file__).with_suffix(".md").write_text(text)
            print(hand, kind, rows[-1].first, rows[-1].refused, flush=True)
    print(text)


if __name__ == "__main__":
    main()
