"""Model and mesh files that nobody vouches for are refused in one line, and Python outlives all of them."""

import os
from pathlib import Path

import mujoco
import numpy as np
import pytest

from jaxgrasp.geometry import Mesh, MeshError
from jaxgrasp.hands.bodies import read_model
from jaxgrasp.hands.files import check_files, compile_file
from jaxgrasp.hands.scenes import four_fingers
from jaxgrasp.storage import FileError, limited_to

ATTACHES = '<attach model="m" body="palm" prefix="x"/>'


def scene(head: str = "", bodies: str = "", tail: str = "", joint: str = "") -> str:
    return (
        f'<mujoco>{head}<worldbody><body name="object"><freejoint/><geom size="0.02"/></body><body name="palm">'
        f'<geom size="0.01"/><body><joint name="j" {joint}/><geom size="0.01"/></body></body>{bodies}</worldbody>{tail}'
        "</mujoco>"
    )


def test_a_model_from_a_child_process_is_the_model(tmp_path):
    spec = four_fingers()
    path = tmp_path / "hand.xml"
    spec.compile()
    path.write_text(spec.to_xml())
    ours, theirs = compile_file(path), mujoco.MjModel.from_xml_path(str(path))
    for name in ("body_mass", "geom_size", "actuator_gainprm", "qpos0", "geom_friction"):
        np.testing.assert_array_equal(getattr(ours, name), getattr(theirs, name))
    assert ours.names == theirs.names
    assert os.listdir(tmp_path) == ["hand.xml"]


def test_files_beside_and_below_are_found(tmp_path):
    (tmp_path / "parts" / "meshes").mkdir(parents=True)
    (tmp_path / "parts" / "more.xml").write_text('<mujoco><asset><mesh name="m" file="m.obj"/></asset></mujoco>')
    (tmp_path / "parts" / "meshes" / "m.obj").write_text(
        "v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\nf 1 3 2\nf 1 2 4\nf 1 4 3\nf 2 3 4\n"
    )
    head = '<compiler meshdir="parts/meshes"/><include file="parts/more.xml"/>'
    path = tmp_path / "scene.xml"
    path.write_text(scene(head, '<geom type="mesh" mesh="m"/>'))
    assert read_model(path).nmesh == 1
    (tmp_path / "parts" / "meshes" / "m.obj").unlink()
    os.mkfifo(tmp_path / "parts" / "meshes" / "m.obj")
    with pytest.raises(ValueError, match=r"m\.obj: got a pipe"):
        read_model(path)


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (scene('<asset><model name="m" file="scene.xml"/></asset>', ATTACHES), "part of itself"),
        (scene('<asset><model name="m" file="other.xml"/></asset>', ATTACHES), "part of itself"),
        (scene('<include file="scene.xml"/>'), "part of itself"),
        (scene('<include file="../scene.xml"/>'), "a file beside this one"),
        (scene('<include file="/etc/hostname"/>'), "a file beside this one"),
        (scene('<include file="pipe"/>'), "got a pipe"),
        (scene('<asset><mesh name="m" file="/dev/zero"/></asset>'), "got a device"),
        (scene('<asset><hfield name="h" nrow="100000" ncol="100000" size="1 1 1 1"/></asset>'), "cannot compile"),
        (scene('<asset><hfield name="h" nrow="12000" ncol="12000" size="1 1 1 1"/></asset>'), "cannot compile"),
        ('<!DOCTYPE a [<!ENTITY x "y">]>' + scene(), "a document type"),
        (scene()[:-5], "not well-formed"),
        (scene(tail='<actuator><motor joint="j" gear="nan"/></actuator>'), "actuator_gear"),
        (scene(joint='type="wheel"'), "cannot compile"),
        (scene(bodies='<replicate count="3000"><body><geom size=".01"/></body></replicate>'), "stack overflow"),
        ("", "not well-formed"),
    ],
)
def test_models_that_cannot_be_used(tmp_path, content, words):
    path = tmp_path / "scene.xml"
    path.write_text(content)
    (tmp_path / "other.xml").write_text(scene('<asset><model name="m" file="scene.xml"/></asset>', ATTACHES))
    os.mkfifo(tmp_path / "pipe")
    with pytest.raises(ValueError, match=words) as caught:
        read_model(path)
    assert "\n" not in str(caught.value)


def test_absurd_counts_run_into_the_limit(tmp_path):
    path = tmp_path / "scene.xml"
    path.write_text(
        scene(bodies='<replicate count="10000000" offset="1 0 0"><body><geom size=".01"/></body></replicate>')
    )
    with limited_to(1 << 28), pytest.raises(FileError, match="takes too much|cannot compile"):
        compile_file(path)


def test_a_chain_of_files_is_looked_at_once(tmp_path):
    for n in range(20):
        both = f'<asset><model name="a" file="{n + 1}.xml"/><model name="b" file="{n + 1}.xml"/></asset>'
        (tmp_path / f"{n}.xml").write_text(scene(both))
    (tmp_path / "20.xml").write_text(scene())
    check_files(tmp_path / "0.xml")


@pytest.mark.parametrize(
    ("name", "content", "words"),
    [
        ("a.ply", "ply\nformat ascii 1.0\nelement vertex 4000000000\nproperty float x\nend_header\n", "damaged"),
        ("a.obj", "v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 9\n", "got"),
        ("a.stl", "solid\n", "got"),
    ],
)
def test_meshes_that_cannot_be_used(tmp_path, name, content, words):
    path = tmp_path / name
    path.write_text(content)
    with pytest.raises(MeshError, match=words) as caught:
        Mesh.from_file(path)
    assert "\n" not in str(caught.value) and name in str(caught.value)


def test_a_mesh_does_not_make_us_read_its_neighbours(tmp_path):
    os.mkfifo(tmp_path / "pipe.mtl")
    points = "v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\n"
    path = Path(tmp_path, "a.obj")
    path.write_text(f"mtllib pipe.mtl\nusemtl a\n{points}f 1 3 2\nf 1 2 4\nf 1 4 3\nf 2 3 4\n")
    assert len(Mesh.from_file(path).faces) == 4
    os.mkfifo(tmp_path / "b.obj")
    with pytest.raises(MeshError, match="a pipe"):
        Mesh.from_file(tmp_path / "b.obj")
