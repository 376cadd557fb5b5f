"""What lies inside a solid is no surface: no contact there, and no volume of its own."""

from __future__ import annotations

import jax
import numpy as np
import pytest
import trimesh

import jaxgrasp.geometry as g

BALL = trimesh.creation.icosphere(subdivisions=3, radius=0.05)
SMALL = trimesh.creation.icosphere(subdivisions=3, radius=0.03)
BARS = np.array([[0.12, 0.03, 0.03], [0.03, 0.12, 0.03]])
CAVITY = SMALL.copy()
CAVITY.invert()
APART = np.array([0.0, 0.0, 0.2])


def in_ball(points: np.ndarray) -> np.ndarray:
    """How deep inside, m."""
    return 0.05 - np.linalg.norm(points, axis=-1)


def in_bars(points: np.ndarray) -> np.ndarray:
    return np.max([(0.5 * bar - np.abs(points)).min(-1) for bar in BARS], axis=0)


def moved(mesh: trimesh.Trimesh, by: np.ndarray) -> trimesh.Trimesh:
    return trimesh.Trimesh(mesh.vertices + by, mesh.faces, process=False)


def bars(rings: int) -> list[trimesh.Trimesh]:
    found = [trimesh.creation.box(extents=bar) for bar in BARS]
    for _ in range(rings):
        found = [bar.subdivide() for bar in found]
    return found


MESHES = {
    "nested": ([BALL, SMALL], in_ball, BALL.volume),
    "nested twice": ([BALL, SMALL, moved(trimesh.creation.box(extents=[0.01] * 3), 0.01)], in_ball, BALL.volume),
    "cavity": ([BALL, CAVITY], in_ball, BALL.volume - SMALL.volume),
    "crossing, two triangles a side": (bars(0), in_bars, 0.03**2 * 0.21),
    "crossing, many triangles": (bars(4), in_bars, 0.03**2 * 0.21),
    "a sheet inside": (
        [BALL, trimesh.Trimesh([[0, 0, 0], [0.02, 0, 0], [0, 0.02, 0]], [[0, 1, 2]])],
        in_ball,
        BALL.volume,
    ),
}


@pytest.mark.parametrize("name", MESHES)
def test_no_surface_inside(name):
    parts, depth, volume = MESHES[name]
    mesh = trimesh.util.concatenate(parts)
    found = g.Mesh.from_arrays(mesh.vertices, mesh.faces)
    grid = found.to_grid(60_000)
    points = np.asarray(g.sample_surface(grid, jax.random.key(0), 1000))
    assert depth(points).max() < 1e-3
    assert found.volume == pytest.approx(volume, rel=0.01)
    np.testing.assert_allclose(found.centroid, 0, atol=5e-4)
    # The place deepest inside is as deep as the solid is there.
    assert found.signed_distance(np.zeros((1, 3)))[0] == pytest.approx(-depth(np.zeros((1, 3)))[0], rel=0.02)


@pytest.mark.parametrize("gap", [0.0, 1e-3])
def test_parts_beside_each_other_stay(gap):
    box = trimesh.creation.box(extents=(0.04, 0.04, 0.04))
    both = trimesh.util.concatenate([box, moved(box, np.array([0.04 + gap, 0, 0]))])
    found = g.Mesh.from_arrays(both.vertices, both.faces)
    # Where they touch there is no surface.
    between = found.signed_distance(np.array([[0.02 + 0.5 * gap, 0.0, 0.0]]))[0]
    assert between == pytest.approx(0.5 * gap if gap else -0.02, abs=2e-4)


def test_a_copy_apart_hides_nothing():
    both = trimesh.util.concatenate([BALL, moved(BALL, APART)])
    found = g.Mesh.from_arrays(both.vertices, both.faces)
    np.testing.assert_allclose(found.signed_distance(np.array([[0, 0, 0], APART])), -0.05, rtol=0.02)


def test_progress_reaches_the_number_of_distances():
    seen = []
    g.Mesh.from_arrays(BALL.vertices, BALL.faces).to_grid(
        20_000, progress=lambda done, total: seen.append((done, total))
    )
    assert len(seen) >= 2 and seen[-1][0] == seen[-1][1]
    assert seen == sorted(seen)
