"""`rank` and `compare` with a hand, an object and grasps of one's own."""

from __future__ import annotations

import csv
from dataclasses import fields

import numpy as np
import pytest
import trimesh

from jaxgrasp.cli import main
from jaxgrasp.files import read_grasps, write_grasps
from jaxgrasp.hands import Scene
from jaxgrasp.synthesis import HandSynthesis

HAND = """<mujoco><compiler angle="radian"/><option gravity="0 0 -9.81"/><worldbody><body name="palm">
<geom type="box" size=".05 .05 .005" pos="0 0 -.06" group="3"/>{}</body></worldbody><actuator>{}</actuator></mujoco>"""
PADS = "".join(
    f'<body name="f{k}" pos="{0.065 * x} {0.065 * y} 0"><joint name="j{k}" type="slide" axis="{-x} {-y} 0" '
    f'range="-.05 .05"/><geom size="0.015" mass="0.05" condim="4"/></body>'
    for k, (x, y) in enumerate([(1, 0), (-1, 0), (0, 1), (0, -1)])
)
MOTORS = "".join(f'<motor name="m{k}" joint="j{k}" ctrlrange="-5 5"/>' for k in range(4))


@pytest.fixture
def folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "hand.xml").write_text(HAND.format(PADS, MOTORS))
    (tmp_path / "pieces").mkdir()
    for number in range(2):
        half = trimesh.creation.box((1, 1, 0.5), trimesh.transformations.translation_matrix((0, 0, number / 2 - 0.25)))
        half.export(tmp_path / "pieces" / f"{number}.obj")
    # Cubes of 6 and 5 cm in turn; the pads of each second grasp of a size stay 3 cm off.
    scales = np.array([0.06, 0.05] * 4)
    off = np.repeat([0.0, 0.03] * 2, 2)
    # 0.1 mm deep: exactly on the surface C's collision of meshes may find nothing.
    joints = np.tile((0.0501 - scales / 2 - off)[:, None], (1, 4))
    base = np.tile([0.1, 0.2, 0.3, np.sqrt(0.5), 0, 0, np.sqrt(0.5)], (8, 1))
    np.savez(
        "grasps.npz",
        grasp_qpos=np.concatenate([base, joints], -1).astype(np.float32),
        obj_pose=base,
        obj_scale=scales,
        succ_flag=off == 0,
        other=np.zeros(3),
    )
    return tmp_path


COMMAND = ["--hand", "hand.xml", "--object", "pieces", "--mass", "0.1", "--friction", "0.6", "--no-actuators"]
COMMAND += ["--grasps", "grasps.npz"]


def test_one_scene_a_scale_in_the_order_of_the_file(folder, capsys):
    code = main(["rank", *COMMAND, "--top", "4", "--min-contacts", "0", "--figure", "None", "--picture", "None",
                 "--output", "table.npz"])  # fmt: skip
    told = capsys.readouterr()
    assert code == 0 and "one contact for each link within 5 mm" in told.err
    assert "is left out" not in told.err
    with np.load("table.npz") as file:
        table = dict(file)
    back = np.argsort(table["index"])
    np.testing.assert_array_equal(table["obj_scale"][back], [0.06, 0.05] * 4)
    np.testing.assert_array_equal(table["touching"][back], np.repeat([4, 0, 4, 0], 2))
    np.testing.assert_array_equal(table["left_out"], 0)
    margin = table["margin"][back]
    # 4 x 10 N at friction 0.6 in an octagon of edges, under 0.981 N: the same for both sizes.
    np.testing.assert_allclose(margin[[0, 4]], margin[[1, 5]], rtol=1e-3)
    assert margin[0] > 5 and set(table["index"][:4]) == {0, 1, 4, 5}


def test_compare_takes_the_same_and_leaves_nothing_out(folder, capsys):
    code = main(["compare", *COMMAND, "--metric", "margin", "--figure", "None"])
    assert code == 0
    with open("comparison.csv") as file:
        row = next(csv.DictReader(file))
    assert row["metric"] == "margin" and float(row["auc"]) == 1.0


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (["--hand", "nix.xml"], "--hand: got 'nix.xml', and there is no such file"),
        (["--object", "nix.obj"], "--object: got 'nix.obj', and there is no such file"),
        (["--mass", "-1"], "--mass: got -1.0, wanted a finite number above 0"),
        (["--scale", "0"], "--scale: got 0.0; wanted a number > 0"),
        (["--condim", "2"], "--condim: got 2, wanted 1, 3, 4 or 6"),
        (["--hand-body", "wrist"], "hand_body: got 'wrist', wanted one of the scene's bodies"),
        (["--environment", "shelf"], "environment: got 'shelf', wanted one of the scene's bodies"),
        (
            ["--grasps", "short.npz"],
            "short.npz: joints: got 2 joints without names; wanted 4, those of the hand: j0",
        ),
        (["--grasps", "named.npz"], "named.npz: joints: got 'x'; wanted some of the hand's: j0, j1, j2, j3"),
        (["--grasps", "none.npz"], "none.npz: got a file of no format that is known (qpos)"),
        (["--grasps", "nix.npz"], "nix.npz"),
        (["--grasps", "nix*.npz"], "nix*.npz: got a pattern that no file fits"),
        (["--grasp-format", "nix"], "--grasp-format: got 'nix', wanted one of"),
        (["--scene", "four_fingers"], "--hand: got --scene, too"),
        (["--engine", "mjx"], "only where they penetrate, and contacts up to 0.005 m apart are wanted"),
        (["--engine", "bullet"], "--engine: got bullet; wanted one of mujoco, distance"),
        (["--unreached", "loose"], "--unreached: got loose; wanted held or free"),
        (["--qpos", "q.npy"], "--qpos: got --hand, too; wanted --grasps"),
        (["--gravity", "9.81"], "--hand: got --gravity, too"),
    ],
)
def test_what_cannot_be_used_is_one_line(folder, capsys, change, message):
    np.savez("short.npz", grasp_qpos=np.zeros((2, 9)))
    np.savez("none.npz", qpos=np.zeros((2, 9)))
    np.savez("named.npz", grasp_qpos=np.zeros((2, 8)), joint_names=np.array(["x"]))
    assert main(["rank", *COMMAND, "--picture", "None", "--figure", "None", *change]) == 2
    error = capsys.readouterr().err
    assert error.count("\n") == 1 and error.startswith("jaxgrasp: ") and message in error


def test_folders_of_other_formats_with_a_bad_file_among_them(folder, capsys):
    grasps = read_grasps("grasps.npz")
    write_grasps(grasps, "bench", "dexgraspbench", hand="hand.xml")
    (folder / "bench" / "8.npy").write_bytes((folder / "bench" / "7.npy").read_bytes()[:-40])
    command = ["rank", *COMMAND[:-1], "bench", "--min-contacts", "0", "--output", "table.npz"]
    command += ["--figure", "None", "--picture", "None"]
    assert main(command) == 2
    told = capsys.readouterr().err
    assert told.count("\n") == 1 and "bench/8.npy: pickle: got data that end early" in told
    assert main([*command, "--keep-going"]) == 2
    told = capsys.readouterr()
    assert "bench/8.npy: pickle: got" in told.err and "written: table.npz" in told.out
    with np.load("table.npz") as table:
        assert sorted(table["source"].tolist()) == [f"bench/{k}.npy" for k in range(8)]
        assert table["succ_flag"].sum() == 4 and set(table["obj_scale"].tolist()) == {0.05, 0.06}


def test_a_hand_wants_an_object_and_grasps(folder, capsys):
    assert main(["rank", "--hand", "hand.xml"]) == 2
    assert "--hand: got no --object or no --grasps; wanted both" in capsys.readouterr().err
    assert main(["rank", "--grasps", "grasps.npz"]) == 2
    assert "got no --hand" in capsys.readouterr().err


def test_synthesised_grasps_are_what_rank_reads(folder, monkeypatch, capsys):
    rng = np.random.default_rng(0)

    def found(hand, key, *, starts, **_) -> HandSynthesis:
        """In place of a search that takes minutes to compile: numbers of the right shapes."""
        contacts, efforts = len(hand.touching_links), len(hand.actuators)
        shapes = {"qpos": (hand.nq,), "pregrasp": (hand.nq,), "squeeze": (hand.nq,), "controls": (efforts,)}
        shapes |= {"contact_points": (contacts, 3), "forces": (contacts, 3), "landmarks": (contacts, 3)}
        columns = {
            f.name: rng.normal(size=(starts, *shapes.get(f.name, ())))
            for f in fields(HandSynthesis)
            if f.name not in ("record", "interrupted")
        }
        whole = {name: np.zeros(starts, int) for name in ("verdict", "first_verdict", "status", "touching")}
        return HandSynthesis(**{**columns, **whole}, record={}, interrupted=False)

    monkeypatch.setattr("jaxgrasp.synthesis.synthesize_hand_grasps", found)
    command = ["synthesize", *COMMAND[:8], "--scale", "0.06", "--starts", "5", "--figure", "None", "--picture", "None"]
    assert main([*command, "--output", "found.npz"]) == 0
    assert "hand.xml and pieces" in capsys.readouterr().out
    with np.load("found.npz") as table:
        columns = dict(table)
    assert columns["joint_names"].tolist() == ["j0", "j1", "j2", "j3"] and (columns["obj_scale"] == 0.06).all()
    built = Scene.build(hand="hand.xml", object="pieces", scale=0.06, condim=3)
    rng = np.random.default_rng(0)
    wanted = found(built.hand_object(), None, starts=5).qpos
    parts = built.parts(wanted)
    assert np.array_equal(columns["grasp_qpos"], np.c_[parts.base, parts.joints])
    assert np.array_equal(columns["obj_pose"], parts.object)
    unit = parts.base, parts.object
    for poses in unit:
        poses[:, 3:] /= np.linalg.norm(poses[:, 3:], axis=-1, keepdims=True)
    again = built.parts(built.qpos(base=unit[0], joints=parts.joints, object=unit[1]))
    for ours, theirs in zip(again, parts, strict=True):
        np.testing.assert_allclose(ours, theirs, atol=1e-12)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--hand", "hand.xml"], "--object: got 'superquadric', wanted a folder"),
        (["--hand", "hand.xml", "--object", "pieces", "--size", "0.1"], "--size or --span: got a hand, too"),
        (["--scene", "four_fingers", "--scale", "0.1"], "--scale: got --scene, too"),
        (["--hand", "no.xml", "--object", "pieces"], "--hand: got 'no.xml', and there is no such file"),
    ],
)
def test_hands_that_cannot_be_synthesised_with_are_one_line(folder, capsys, options, message):
    assert main(["synthesize", *options]) == 2
    error = capsys.readouterr().err
    assert message in error and error.count("\n") == 1
