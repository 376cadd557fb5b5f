"""Grasps written in the formats of others, and read again; `jaxgrasp convert`."""

from __future__ import annotations

import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from test_files import same, table
from test_grasp_formats import need

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))

from benchmarks.assaults.grasp_samples import HAND, SAMPLES, matrices, of_palm, truth  # noqa: E402
from jaxgrasp.cli import main  # noqa: E402
from jaxgrasp.files import GraspSet, read_grasps, write_grasps  # noqa: E402
from jaxgrasp.files import frames as f  # noqa: E402

SHARED = Path(__file__).resolve().parents[3] / "shared" / "data"


@pytest.fixture
def folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "hand.xml").write_text(HAND)
    columns = table(12)
    columns["squeeze_qpos"] = 2 * columns["grasp_qpos"]
    for name in ("grasp_qpos", "pregrasp_qpos", "squeeze_qpos"):
        columns[name][:, 3:7] /= np.linalg.norm(columns[name][:, 3:7], axis=-1, keepdims=True)
    columns["obj_pose"][:, 3:] /= np.linalg.norm(columns["obj_pose"][:, 3:], axis=-1, keepdims=True)
    columns["obj_scale"] = np.repeat([0.05, 0.08], 6)
    columns["pregrasp_qpos"][:, :7] = columns["grasp_qpos"][:, :7]
    np.savez(tmp_path / "in.npz", **{name: x for name, x in columns.items() if name != "other"})
    return tmp_path


def exactly(one: GraspSet, other: GraspSet, stages: tuple[str, ...]) -> None:
    for name in stages:
        np.testing.assert_array_equal(one.stages[name].qpos.astype(np.float32), other.stages[name].qpos.astype("f4"))


def test_dexgraspbench_round_trips_exactly_and_numpy_reads_it(folder):
    grasps = read_grasps("in.npz")
    assert write_grasps(grasps, "out", "dexgraspbench") == [
        "that joints are in another order than in the hand's file (--hand turns them)"
    ]
    same(read_grasps("out"), grasps)
    assert write_grasps(grasps, "by hand", "dexgraspbench", hand="hand.xml") == []
    back = read_grasps("by hand")
    assert back.joint_names is None
    exactly(back, grasps, ("pregrasp", "grasp", "squeeze"))
    one = np.load("by hand/11.npy", allow_pickle=True).item()
    assert one["obj_path"] == "mug" and type(one["obj_scale"]) is np.float64 and one["obj_pose"].shape == (7,)
    assert {one[f"{stage}_qpos"].dtype for stage in ("pregrasp", "grasp", "squeeze")} == {np.dtype("f4")}
    assert one["grasp_qpos"].shape == (10,) and "joint_names" not in one
    content = Path("by hand/11.npy").read_bytes()
    assert b"jaxgrasp" not in content


def test_joints_are_turned_into_the_order_of_the_hand(folder):
    grasps = read_grasps("in.npz")
    turned = replace(grasps, joint_names=("c", "a", "b"))
    write_grasps(turned, "out", "dexgraspbench", hand="hand.xml")
    found = read_grasps("out").stages["grasp"].joints
    np.testing.assert_array_equal(found, grasps.stages["grasp"].joints[:, [1, 2, 0]].astype(np.float32))
    with pytest.raises(ValueError, match="in.npz: joints: got 'x'; wanted some of the hand's: a, b, c"):
        write_grasps(replace(grasps, joint_names=("a", "b", "x")), "no", "dexgraspbench", hand="hand.xml")


def test_isaac_grasp_round_trips_exactly(folder):
    pytest.importorskip("yaml")
    grasps = read_grasps("in.npz")
    there = replace(grasps, object_pose=np.tile(f.standing(1), (12, 1)))
    lost = ["the stage squeeze"]
    assert write_grasps(there, "out", "isaac_grasp") == lost
    assert sorted(path.name for path in Path("out").iterdir()) == ["mug_scale0.05.yaml", "mug_scale0.08.yaml"]
    back = read_grasps("out")
    exactly(back, there, ("pregrasp", "grasp"))
    assert set(back.object_name) == {"mug"} and np.array_equal(back.object_scale, there.object_scale)
    np.testing.assert_array_equal(back.columns["confidence"], there.columns["succ_flag"])
    assert write_grasps(there, "one.yaml", "isaac_grasp") == [
        *lost,
        "that files have one object and scale (each grasp has its own)",
    ]
    one = read_grasps("one.yaml")
    assert np.array_equal(one.object_scale, there.object_scale) and np.array_equal(one.object_name, there.object_name)
    exactly(one, there, ("pregrasp", "grasp"))
    # Elsewhere in the world the hand stands as it does to the object.
    assert write_grasps(grasps, "moved", "isaac_grasp") == [*lost, "where the object stands in the world"]
    moved = read_grasps("moved")
    wanted = np.linalg.inv(matrices(grasps.object_pose)) @ matrices(grasps.stages["grasp"].base)
    np.testing.assert_allclose(matrices(moved.stages["grasp"].base), wanted, atol=1e-7)


def test_what_isaac_grasp_cannot_hold_is_told_or_refused(folder):
    grasps = read_grasps("in.npz")
    lost = write_grasps(grasps.unnamed(), "out.yaml", "isaac_grasp")
    assert lost[0] == "which joints these are (--hand has their names)"
    assert read_grasps("out.yaml").joint_names == ("dof_0", "dof_1", "dof_2")
    with pytest.raises(ValueError, match="in.npz: object_scale: got no scale"):
        write_grasps(replace(grasps, object_scale=np.full(12, np.nan)), "out.yaml", "isaac_grasp")


@pytest.mark.parametrize(
    "odd", ["a: b # c", "'\"\\", "é☃", "- x", "../../etc/x", "null", "1e5", "", "two\nlines", "{x}"]
)
def test_names_that_yaml_has_other_uses_for(odd, folder):
    pytest.importorskip("yaml")
    grasps = read_grasps("in.npz").take(np.arange(2))
    grasps = replace(grasps, object_name=np.full(2, odd), joint_names=(odd or "x", "b", "c"))
    write_grasps(grasps, "out", "isaac_grasp")
    (path,) = Path("out").iterdir()
    back = read_grasps(path)
    assert back.joint_names == (odd.replace("\n", "\\n") or "x", "b", "c")
    assert set(back.object_name) == {odd.replace("\n", "\\n") or "object"}


@pytest.mark.parametrize("name", SAMPLES)
def test_every_format_is_converted_with_its_hand(name, folder, capsys):
    need(name)
    path = SAMPLES[name](folder, truth(), of_palm)
    command = ["convert", str(path), "--to", "jaxgrasp", "--output", "out.npz", "--hand", "hand.xml", "--scale", "0.1"]
    code = main([*command, "--object", "cup"])
    told = capsys.readouterr()
    if name == "get_a_grip":
        assert code == 2 and "mug_0_0800.npy: joints: got 'joint_0.0'; wanted some of the hand's: a, b, c" in told.err
        return
    assert code == 0 and "written: out.npz" in told.out
    grasps = read_grasps("out.npz")
    assert grasps.joint_names == (() if name in ("acronym", "graspgen") else ("a", "b", "c")) and set(
        grasps.object_name
    ) == {"cup"}
    assert (grasps.object_scale == 0.1).all()


def test_a_bad_file_stops_the_command_or_is_passed_over(folder, capsys):
    for name in ("1.npz", "3.npz"):
        np.savez(name, **table(2))
    Path("2.npz").write_text("nonsense, 1")
    np.savez("4.npz", **table(2, names=("a", "b", "x")))
    command = ["convert", "1.npz", "2.npz", "3.npz", "4.npz", "--to", "jaxgrasp", "--output", "out.npz"]
    assert main(command) == 2
    told = capsys.readouterr()
    assert told.err.count("\n") == 1 and "2.npz: got " in told.err and not Path("out.npz").exists()
    assert main([*command, "--keep-going"]) == 2
    told = capsys.readouterr()
    assert [line.split(":")[1].strip() for line in told.err.splitlines()] == ["2.npz", "4.npz"]
    assert "written: out.npz (4 grasps)" in told.out and len(read_grasps("out.npz")) == 4


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--to", "x", "--output", "out"], "--to: got x; wanted one of jaxgrasp, dexgraspbench, isaac_grasp"),
        (["--to", "jaxgrasp", "--output", "out.csv"], "--output out.csv: got the ending '.csv'; wanted .npz"),
        (["--to", "jaxgrasp", "--output", "in.npz"], "--output in.npz: this file is read from; wanted another one"),
        (["--to", "jaxgrasp", "--output", "no/out.npz"], "--output no/out.npz: cannot be written (no such file"),
        (
            ["--to", "dexgraspbench", "--output", "."],
            "--output .: got a folder with files in it; wanted a new or empty",
        ),
        (["--to", "dexgraspbench", "--output", "in.npz"], "--output in.npz: cannot be written (file exists)"),
        (["--to", "jaxgrasp", "--output", "out.npz", "--format", "x"], "--format: got 'x', wanted one of dexonomy"),
        (
            ["--to", "jaxgrasp", "--output", "out.npz", "--format", "bodex"],
            "in.npz: robot_pose: got nothing",
        ),
        (["--to", "jaxgrasp", "--output", "out.npz", "--format", "dexnet"], "--format: got Dex-Net, which is not read"),
        (["--to", "jaxgrasp", "--output", "out.npz", "--hand", "x.xml"], "--hand: got 'x.xml', and there is no such"),
        (["--to", "jaxgrasp", "--output", "out.npz", "--scale", "-1"], "--scale: got -1.0; wanted a number > 0"),
    ],
)
def test_what_cannot_be_converted_is_one_line(folder, capsys, options, message):
    assert main(["convert", "in.npz", *options]) == 2
    error = capsys.readouterr().err
    assert error.count("\n") == 1 and error.startswith("jaxgrasp: ") and message in error


def test_what_is_lost_is_told_in_one_line(folder, capsys):
    assert main(["convert", "in.npz", "--to", "isaac-grasp", "--output", "out"]) == 0
    told = capsys.readouterr()
    wanted = "jaxgrasp: isaac-grasp cannot say: the stage squeeze; where the object stands in the world\n"
    assert told.err == wanted and "written: out (12 grasps)" in told.out


@pytest.mark.skipif(not SHARED.is_dir(), reason="files of others, which are not part of the project")
@pytest.mark.parametrize("object_name", ["bottle", "can", "figure"])
def test_published_grasps_round_trip_exactly(object_name, tmp_path):
    pytest.importorskip("yaml")
    hand = SHARED / "hands" / "shadow" / "right_hand.xml"
    grasps = read_grasps(SHARED / "dexgraspbench" / object_name / "grasps.npz")
    write_grasps(grasps, tmp_path / "bench", "dexgraspbench")
    bench = read_grasps(tmp_path / "bench")
    same(replace(bench, object_name=grasps.object_name), grasps)
    lost = write_grasps(grasps, tmp_path / "isaac.yaml", "isaac_grasp", hand=hand)
    isaac = read_grasps(tmp_path / "isaac.yaml", hand=hand)
    exactly(isaac, grasps, ("grasp",))
    np.testing.assert_array_equal(isaac.stages["pregrasp"].joints, grasps.stages["pregrasp"].joints)
    assert len(isaac.joint_names) == 22 and "where the base stands before the grasp" in lost


def test_ctrl_c_keeps_the_grasps_that_are_written(folder, capsys, monkeypatch):
    calls = []

    def checkpoint() -> None:
        calls.append(1)
        if len(calls) == 3:
            raise KeyboardInterrupt

    monkeypatch.setattr("jaxgrasp.cli.signals.checkpoint", checkpoint)
    assert main(["convert", "in.npz", "--to", "dexgraspbench", "--output", "out"]) == 130
    assert capsys.readouterr().err == "jaxgrasp: interrupted: wrote 3 of 12 grasps to out\n"
    assert sorted(path.name for path in Path("out").iterdir()) == ["00.npy", "01.npy", "02.npy"]
    assert len(read_grasps("out")) == 3
