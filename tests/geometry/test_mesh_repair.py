"""Meshes as people have them: volumes and mass centres are those of the solids that they are meant to be."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh

import jaxgrasp.geometry as g

# Of the volume, and of the centre as a share of the extent.
CLOSE = 0.01
BALL = trimesh.creation.icosphere(subdivisions=3, radius=0.05)
BOX = trimesh.creation.box(extents=(0.1, 0.06, 0.08))
CAN = trimesh.creation.cylinder(radius=0.03, height=0.12, sections=48)
WHOLE = {"ball": BALL, "box": BOX.subdivide().subdivide(), "can": CAN.subdivide()}
PLACE = np.array([0.2, -0.1, 0.05])


def read(mesh: trimesh.Trimesh) -> g.Mesh:
    return g.Mesh.from_arrays(mesh.vertices + PLACE, mesh.faces)


def check(found: g.Mesh, volume: float, centre: np.ndarray) -> None:
    extent = np.ptp(found.triangles, axis=(0, 1)).max()
    assert found.volume == pytest.approx(volume, rel=CLOSE)
    np.testing.assert_allclose(found.centroid, PLACE + centre, atol=CLOSE * extent)


def flipped(faces: np.ndarray, share: float) -> np.ndarray:
    chosen = np.random.default_rng(0).random(len(faces)) < share
    return np.where(chosen[:, None], faces[:, ::-1], faces)


@pytest.mark.parametrize("name", WHOLE)
@pytest.mark.parametrize("share", [0.05, 0.2, 0.4, 0.5, 1.0])
def test_flipped_faces_are_turned(name, share):
    whole = WHOLE[name]
    found = g.Mesh.from_arrays(whole.vertices + PLACE, flipped(whole.faces, share))
    assert found.is_closed
    assert found.volume == pytest.approx(whole.volume, rel=1e-9)
    np.testing.assert_allclose(found.centroid, PLACE + whole.center_mass, atol=1e-12)


@pytest.mark.parametrize("name", WHOLE)
def test_holes_get_lids(name):
    whole = WHOLE[name]
    kept = np.random.default_rng(0).permutation(len(whole.faces))[: int(0.95 * len(whole.faces))]
    check(read(trimesh.Trimesh(whole.vertices, whole.faces[kept], process=False)), whole.volume, whole.center_mass)


@pytest.mark.parametrize("sign", [1, -1])
def test_a_cube_without_its_top_and_one_without_its_bottom(sign):
    cube = trimesh.creation.box(extents=(0.1, 0.1, 0.1))
    kept = cube.faces[sign * cube.face_normals[:, 2] < 0.5]
    found = read(trimesh.Trimesh(cube.vertices, kept, process=False))
    assert found.is_closed
    assert found.volume == pytest.approx(1e-3, rel=1e-9)
    np.testing.assert_allclose(found.centroid, PLACE, atol=1e-12)


def test_a_hole_as_large_as_what_is_there_gets_no_lid():
    cap = BALL.faces[BALL.triangles_center[:, 2] > 0.04]
    found = read(trimesh.Trimesh(BALL.vertices, cap, process=False))
    assert not found.is_closed and len(found.faces) == len(cap)


@pytest.mark.parametrize("name", WHOLE)
@pytest.mark.parametrize("way", [slice(None), slice(None, None, -1)])
def test_faces_that_are_there_twice(name, way):
    whole = WHOLE[name]
    faces = np.concatenate([whole.faces, whole.faces[:, way]])
    found = g.Mesh.from_arrays(whole.vertices + PLACE, faces)
    assert found.is_closed and len(found.faces) == len(whole.faces)
    assert found.volume == pytest.approx(whole.volume, rel=1e-9)


def test_corners_of_their_own_for_every_triangle():
    soup = BALL.triangles.reshape(-1, 3) + PLACE
    found = g.Mesh.from_arrays(soup, flipped(np.arange(len(soup)).reshape(-1, 3), 0.3))
    assert found.is_closed
    assert found.volume == pytest.approx(BALL.volume, rel=1e-9)


@pytest.mark.parametrize("inside_out", ["none", "body", "handle", "both"])
def test_parts_that_are_inside_out_and_overlap(inside_out):
    body = trimesh.creation.box(extents=(0.08, 0.06, 0.06))
    handle = trimesh.creation.box(extents=(0.03, 0.02, 0.04))
    handle.apply_translation([0.05, 0.0, 0.0])
    # The handle begins at 35 mm and the body ends at 40 mm.
    volumes = np.array([body.volume, handle.volume - 0.005 * 0.02 * 0.04])
    centre = volumes @ [0.0, 0.0525] / volumes.sum()
    if inside_out in ("body", "both"):
        body.invert()
    if inside_out in ("handle", "both"):
        handle.invert()
    found = read(trimesh.util.concatenate([body.subdivide(), handle.subdivide()]))
    check(found, volumes.sum(), np.array([centre, 0.0, 0.0]))


@pytest.mark.parametrize("clockwise", [False, True])
def test_a_cavity_stays_one(clockwise):
    inner = trimesh.creation.icosphere(subdivisions=2, radius=0.03)
    volume = BALL.volume - inner.volume
    inner.invert()
    both = trimesh.util.concatenate([BALL, inner])
    if clockwise:
        both.invert()
    check(read(both), volume, np.zeros(3))


def test_a_triangle_without_area_far_away_is_left_out():
    stray = np.array([[10.0, 0, 0], [10.0, 0, 0.01], [10.0, 0, 0.02]])
    vertices = np.concatenate([BALL.vertices, stray])
    faces = np.concatenate([BALL.faces, len(BALL.vertices) + np.arange(3)[None]])
    found = g.Mesh.from_arrays(vertices, faces)
    assert len(found.faces) == len(BALL.faces) and found.is_closed
    assert float(found.to_grid(nodes=10_000).spacing) < 0.01


@pytest.mark.parametrize("away", [0.3, 10.0])
def test_strays_are_left_out_with_a_word(away):
    stray = np.array(
        [[[away, 0, 0], [away, 0, 0.01], [away, 0.01, 0]], [[0, away, 0], [0, away, 0.02], [0.01, away, 0]]]
    )
    vertices = np.concatenate([BALL.vertices, stray.reshape(-1, 3)])
    faces = np.concatenate([BALL.faces, len(BALL.vertices) + np.arange(6).reshape(2, 3)])
    with pytest.warns(UserWarning, match="left out 2 stray triangles"):
        found = g.Mesh.from_arrays(vertices, faces)
    assert found.is_closed and len(found.faces) == len(BALL.faces)


def test_a_surface_with_one_side_is_refused():
    count = 24
    turn = np.linspace(0, 2 * np.pi, count, endpoint=False)
    rims = [
        np.stack(
            [
                (1 + s * np.cos(turn / 2)) * np.cos(turn),
                (1 + s * np.cos(turn / 2)) * np.sin(turn),
                s * np.sin(turn / 2),
            ],
            -1,
        )
        for s in (-0.3, 0.3)
    ]
    faces = []
    for k in range(count):
        after = (k + 1) % count
        low, high = (after, after + count) if after else (count, 0)
        faces += [[k, low, k + count], [low, high, k + count]]
    with pytest.raises(g.MeshError, match="one side alone"):
        g.Mesh.from_arrays(np.concatenate(rims), np.array(faces))


@pytest.mark.parametrize(("factor", "word"), [(1000.0, "0.001"), (1e-3, "1000")])
def test_units_that_cannot_be(tmp_path, factor, word):
    trimesh.Trimesh(factor * BALL.vertices, BALL.faces).export(tmp_path / "ball.stl")
    with pytest.warns(UserWarning, match=f"scale is likely {word}"):
        g.Mesh.from_file(tmp_path / "ball.stl")
