"""Distances and winding numbers by a tree of triangles, against all triangles one by one."""

from __future__ import annotations

import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import trimesh

from jaxgrasp.geometry import Mesh, MeshError
from jaxgrasp.geometry.triangle_tree import BLOCK, LEAF, Blocks, TriangleTree
from jaxgrasp.geometry.triangles import _squared_distance
from jaxgrasp.storage import limited_to

# Of the whole extent: single precision.
ROUNDING = 2e-6
# Dipoles stand for what is far away; where the winding number is nearer to one half than this, its sign may be another.
DIPOLES = 0.01
DRAW = np.random.default_rng(0)


def soup(count: int) -> tuple[np.ndarray, np.ndarray]:
    vertices = DRAW.normal(size=(3 * count, 3)) + np.repeat(3 * DRAW.normal(size=(count, 1, 3)), 3, 1).reshape(-1, 3)
    return vertices, np.arange(3 * count).reshape(-1, 3)


def stretched(factor: float) -> tuple[np.ndarray, np.ndarray]:
    made = trimesh.creation.icosphere(subdivisions=4)
    return made.vertices * [1, 1, factor] + 7.0, made.faces


def fan() -> tuple[np.ndarray, np.ndarray]:
    made = trimesh.creation.cylinder(0.02, 0.2, sections=400)
    return made.vertices, made.faces


def torn() -> tuple[np.ndarray, np.ndarray]:
    made = trimesh.creation.torus(0.05, 0.02, major_sections=40, minor_sections=40)
    return made.vertices, made.faces[DRAW.permutation(len(made.faces))[:2800]]


SURFACES = {
    "one": lambda: (np.eye(3), np.array([[0, 1, 2]])),
    "tetrahedron": lambda: (np.eye(4, 3), np.array([*itertools.combinations(range(4), 3)])),
    "soup": lambda: soup(1000),
    "ball": lambda: stretched(1.0),
    "needle": lambda: stretched(100.0),
    "coin": lambda: stretched(0.01),
    "fan": fan,
    "torn": torn,
    "again": lambda: (np.eye(3), np.tile([[0, 1, 2]], (100, 1))),
    "flat": lambda: (np.concatenate([DRAW.random((60, 2)), np.zeros((60, 1))], 1), DRAW.integers(0, 60, (300, 3))),
}  # fmt: skip


def one_by_one(triangles: np.ndarray, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Distances and winding numbers, in double precision."""
    distance, winding = np.empty(len(points)), np.empty(len(points))
    for row, point in enumerate(points):
        nearest = trimesh.triangles.closest_point(triangles, np.tile(point, (len(triangles), 1)))
        distance[row] = np.linalg.norm(nearest - point, axis=-1).min()
        a, b, c = (triangles - point).swapaxes(0, 1)
        la, lb, lc = (np.linalg.norm(x, axis=-1) for x in (a, b, c))
        dot = lambda x, y: (x * y).sum(-1)
        level = la * lb * lc + dot(a, b) * lc + dot(b, c) * la + dot(c, a) * lb
        winding[row] = np.arctan2(dot(a, np.cross(b, c)), level).sum() / (2 * np.pi)
    return distance, winding


@pytest.mark.parametrize("name", SURFACES)
def test_every_distance_is_that_of_the_nearest_triangle(name):
    vertices, faces = SURFACES[name]()
    triangles = vertices[faces]
    lower, extent = vertices.min(0), np.ptp(vertices, axis=0).max()
    around = lower + DRAW.uniform(-0.5, 1.5, (100, 3)) * np.maximum(np.ptp(vertices, axis=0), 0.1 * extent)
    beside = triangles.mean(1)[DRAW.integers(0, len(faces), 100)] + DRAW.normal(scale=0.01 * extent, size=(100, 3))
    points = np.concatenate([around, beside, vertices[:20], [vertices.mean(0)]])
    found = Mesh(vertices=vertices, faces=faces).signed_distance(points)
    distance, winding = one_by_one(triangles, points)
    with np.errstate(invalid="ignore"):
        np.testing.assert_allclose(np.abs(found), distance, atol=ROUNDING * extent)
        sure = (distance > 1e-4 * extent) & (np.abs(winding - 0.5) > DIPOLES)
    np.testing.assert_array_equal(found[sure] < 0, winding[sure] > 0.5)
    assert sure.sum() > 150


@pytest.mark.parametrize("name", ["ball", "fan", "tetrahedron", "torn"])
def test_points_by_themselves_and_in_blocks_are_as_far_away(name, monkeypatch):
    vertices, faces = SURFACES[name]()
    points = vertices.min(0) + DRAW.uniform(-0.2, 1.2, (3000, 3)) * np.ptp(vertices, axis=0)
    found = []
    for size in (1, BLOCK):
        monkeypatch.setattr(TriangleTree, "blocks_for_nearest", lambda _, given, size=size: Blocks.of(given, size))
        found.append(Mesh(vertices=vertices, faces=faces).signed_distance(points))
    np.testing.assert_allclose(*found, atol=ROUNDING * np.ptp(vertices, axis=0).max())


def test_small_leaves_are_for_points_by_themselves():
    points = np.stack(np.meshgrid(*3 * [np.linspace(-0.5, 0.5, 20)]), -1).reshape(-1, 3).astype(np.float32)
    sizes = []
    for subdivisions in (2, 6):
        ball = trimesh.creation.icosphere(subdivisions=subdivisions)
        tree = TriangleTree(ball.vertices, ball.faces)
        sizes.append(tree.blocks_for_nearest(points).points.shape[1])
    assert sizes == [BLOCK, 1]


@pytest.mark.parametrize("count", [1, LEAF, LEAF + 1, 5 * LEAF, 1000])
@pytest.mark.parametrize("points", [1, BLOCK, BLOCK + 1, 300])
def test_every_triangle_counts_once_for_every_block(count, points):
    vertices, faces = soup(count)
    tree, blocks = TriangleTree(vertices, faces), Blocks.of(DRAW.normal(size=(points, 3)).astype(np.float32))
    assert sorted(blocks.order) == list(range(points))
    areas = np.zeros((len(blocks.points), 3))
    corners = tree.leaves
    own = 0.5 * np.cross(corners[..., 1, :] - corners[..., 0, :], corners[..., 2, :] - corners[..., 0, :]).sum(1)
    for near, far, level in tree.around(blocks):
        np.add.at(areas, near.blocks, own[near.parts])
        np.add.at(areas, far.blocks, level.area[far.parts])
    whole = np.cross(vertices[faces][:, 1] - vertices[faces][:, 0], vertices[faces][:, 2] - vertices[faces][:, 0]).sum(
        0
    )
    np.testing.assert_allclose(areas, np.broadcast_to(0.5 * whole / tree.extent**2, areas.shape), atol=1e-3)


def test_what_would_take_minutes_is_refused():
    vertices = DRAW.normal(size=(60, 3))
    mesh = Mesh(vertices=vertices, faces=np.array([*itertools.combinations(range(60), 3)]))
    with limited_to(1 << 27), pytest.raises(MeshError, match=r"long or overlap, wanted evenly shaped ones \(remesh it"):
        mesh.to_grid()


def test_slivers_are_no_nearer_than_they_are():
    """Single precision turns the normals of triangles without area anywhere; a few in a million then pass a point."""
    draw = np.random.default_rng(0)
    ends = np.round(draw.normal(size=(2, 200_000, 3)), 1)
    corners = np.stack([ends[0], ends[1], 2 * ends[1] - ends[0]]) - draw.uniform(-3, 3, (200_000, 3))
    found = np.sqrt(jax.jit(_squared_distance)(*jnp.asarray(corners.swapaxes(1, 2), jnp.float32)))
    along = corners[2] - corners[0]
    share = np.clip(-(corners[0] * along).sum(-1) / np.maximum((along**2).sum(-1), 1e-30), 0, 1)
    distance = np.linalg.norm(corners[0] + share[:, None] * along, axis=-1)
    np.testing.assert_allclose(found, distance, atol=ROUNDING * 3)
