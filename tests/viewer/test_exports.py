"""Grasps for other programs, read by others than us: trimesh, MuJoCo, and USD's text by its grammar."""

import re

import mujoco
import numpy as np
import pytest
import trimesh

from jaxgrasp.cli import main
from jaxgrasp.hands import scenes


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    path = tmp_path_factory.mktemp("exports")
    normals = np.array([[[1.0, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0]]] * 2)
    np.savez(path / "grasps.npz", positions=0.03 * normals, outward_normals=normals, friction=0.6, max_force=5.0)
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(path)
        assert main(["view", "grasps.npz", "--export", "all.glb", "all.usda", "--top", "2"]) == 0
    return path


def test_gltf_is_read_by_another(folder):
    scene = trimesh.load(folder / "all.glb")
    names = set(scene.graph.nodes)
    assert {"grasp 1", "grasp 2"} <= names
    assert {"contacts/0", "cones/3", "forces/2", "worst/force"} <= {re.sub(r"_\d+$", "", name) for name in names}
    # Contacts are 30 mm from the centre, in the object's plane of x and y, which is glTF's of x and -z.
    low, high = scene.bounds
    assert low[0] < -0.03 and high[0] > 0.105 + 0.03 and low[2] < -0.03 and high[2] > 0.03
    assert -0.02 < low[1] < high[1] < 0.02
    for mesh in scene.geometry.values():
        assert np.isfinite(mesh.vertices).all() and len(mesh.faces)


def test_usd_has_the_same_meshes(folder):
    text = (folder / "all.usda").read_text()
    assert text.startswith("#usda 1.0\n") and text.count("{") == text.count("}")
    meshes = re.findall(r'def Mesh "(\w+)".*?points = \[(.*?)\]', text, re.DOTALL)
    assert len(meshes) == text.count("def Mesh") == len(trimesh.load(folder / "all.glb").geometry)
    assert re.search(r"metersPerUnit = 1\b", text) and 'upAxis = "Z"' in text
    name, points = meshes[0]
    assert name.startswith("contacts_0")
    corners = np.array(re.findall(r"\(([^()]*)\)", points))
    centre = np.mean([[float(x) for x in corner.split(",")] for corner in corners], axis=0)
    np.testing.assert_allclose(centre, [0.03, 0, 0], atol=1e-3)


def test_keyframes_are_mujocos(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    spec = scenes.four_fingers()
    (tmp_path / "scene.xml").write_text(spec.to_xml())
    hand = ["view", "--scene", "four_fingers", "--samples", "4", "--min-contacts", "0"]
    assert main([*hand, "--export", "keys.xml", "--top", "2"]) == 0
    together = '<mujoco><include file="scene.xml"/><include file="keys.xml"/></mujoco>'
    model = mujoco.MjModel.from_xml_string(
        together, {name: (tmp_path / name).read_bytes() for name in ("scene.xml", "keys.xml")}
    )
    own = spec.compile().nkey
    assert model.nkey == own + 2
    assert model.key(own).name.startswith("1: four_fingers:")
    assert np.isfinite(model.key_qpos).all() and np.linalg.norm(model.key_qpos[own, -4:]) == pytest.approx(1)


def test_keyframes_need_a_hand(folder, monkeypatch, capsys):
    monkeypatch.chdir(folder)
    assert main(["view", "grasps.npz", "--export", "keys.xml"]) == 2
    assert "wanted --scene or --hand" in capsys.readouterr().err
