"""Meshes as convex pieces, in Python and as a command."""

from __future__ import annotations

import sys

import numpy as np
import pytest
import trimesh

import jaxgrasp.geometry as g
from jaxgrasp.cli import main
from jaxgrasp.cli.hand_scene import HandScene
from jaxgrasp.cli.streams import tell_notices

BARS = [trimesh.creation.box(extents=(0.12, 0.03, 0.03)), trimesh.creation.box(extents=(0.03, 0.12, 0.03))]
CROSS = trimesh.util.concatenate(BARS)
BOX = trimesh.creation.box(extents=(0.1, 0.06, 0.08))
RING = trimesh.creation.annulus(0.02, 0.05, 0.03)
VOLUME = 0.03**2 * 0.21


def of(mesh: trimesh.Trimesh) -> g.Mesh:
    return g.Mesh.from_arrays(mesh.vertices, mesh.faces)


def test_convexity():
    assert g.convexity(of(BOX)) == pytest.approx(1.0)
    # The hull of a cross of bars is an octagon: a square without its corners.
    assert g.convexity(of(CROSS)) == pytest.approx(VOLUME / (0.03 * (0.12**2 - 2 * 0.045**2)), rel=0.01)


def test_pieces_of_a_cross(tmp_path, capfd):
    pytest.importorskip("coacd")
    pieces = g.convex_pieces(of(CROSS))
    assert len(pieces) > 1 and all(g.convexity(piece) > 0.999 for piece in pieces)
    assert sum(piece.volume for piece in pieces) == pytest.approx(VOLUME, rel=0.12)
    assert len(g.convex_pieces(of(CROSS), most=2)) == 2
    CROSS.export(tmp_path / "cross.stl")
    assert main(["pieces", str(tmp_path / "cross.stl"), "--output", str(tmp_path / "pieces")]) == 0
    assert f"{len(pieces)} convex pieces" in capfd.readouterr().out
    files = sorted((tmp_path / "pieces").iterdir())
    assert [path.name for path in files] == [f"piece_{k:03d}.obj" for k in range(len(pieces))]
    read = [g.Mesh.from_file(path) for path in files]
    np.testing.assert_allclose([m.volume for m in read], [m.volume for m in pieces], rtol=1e-6)


def test_without_coacd_one_line_says_how_to_get_it(monkeypatch, tmp_path, capfd):
    monkeypatch.setitem(sys.modules, "coacd", None)
    with pytest.raises(ImportError, match="jaxgrasp\\[pieces\\]"):
        g.convex_pieces(of(CROSS))
    CROSS.export(tmp_path / "cross.stl")
    assert main(["pieces", str(tmp_path / "cross.stl"), "--output", str(tmp_path / "pieces")]) == 2
    assert capfd.readouterr().err == "jaxgrasp: pieces: coacd is not installed; wanted pip install 'jaxgrasp[pieces]'\n"
    assert not (tmp_path / "pieces").exists()


@pytest.mark.parametrize(
    ("options", "told"),
    [
        (["--threshold", "2"], "--threshold: got 2.0; wanted 0.01 to 1"),
        (["--most", "0"], "--most: got 0; wanted at least 1"),
    ],
)
def test_options_that_cannot_be(options, told, tmp_path, capfd):
    BOX.export(tmp_path / "box.stl")
    assert main(["pieces", str(tmp_path / "box.stl"), "--output", str(tmp_path / "pieces"), *options]) == 2
    assert capfd.readouterr().err == f"jaxgrasp: {told}\n"


@pytest.mark.parametrize(("mesh", "told"), [(RING, 1), (BOX, 0)])
def test_the_command_line_says_where_a_mesh_is_hollow(mesh, told, tmp_path, capfd):
    mesh.export(tmp_path / "mesh.stl")
    HandScene(hand="four_fingers").built(str(tmp_path / "mesh.stl"), 1.0, None)
    tell_notices()
    assert capfd.readouterr().err.count("its convex hull is what touches") == told
