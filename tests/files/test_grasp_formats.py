"""Every format of grasps becomes the same grasps: frames, units, joints by name, what travels along."""

from __future__ import annotations

import json
import sys
from pathlib import Path

import numpy as np
import pytest

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))

from benchmarks.assaults.grasp_samples import (  # noqa: E402
    COUNT,
    HAND,
    JOINTS,
    OF_LINK,
    SAMPLES,
    SCALE,
    matrices,
    of_palm,
    save,
    scene,
    truth,
)
from jaxgrasp.files import FORMATS, GraspSet, HandPoses, read_grasps  # noqa: E402
from jaxgrasp.files import frames as f  # noqa: E402
from jaxgrasp.storage import FileError  # noqa: E402

# The rotations of float32 files have rounding of 1e-7; poses are compared as matrices.
CLOSE = 3e-7
SHARED = Path(__file__).resolve().parents[3] / "shared" / "data"


def need(name: str) -> None:
    for package in {"acronym": ["h5py"], "isaac_grasp": ["yaml"]}.get(name, []):
        pytest.importorskip(package)


@pytest.fixture
def hand(tmp_path):
    (tmp_path / "hand.xml").write_text(HAND)
    return tmp_path / "hand.xml"


@pytest.mark.parametrize(("name", "given"), [(n, g) for n in SAMPLES for g in (False, True) if n != "bodex" or g])
def test_every_format_becomes_the_same_grasps(name, given, tmp_path, hand):
    need(name)
    t = truth()
    path = SAMPLES[name](tmp_path, t, of_palm if given and name in OF_LINK else lambda base: base)
    # The format's own name finds the same as the content.
    grasps = [read_grasps(path, format, hand=hand if given else None) for format in (None, name.split()[0])]
    assert repr(grasps[0]) == repr(grasps[1])
    grasps = grasps[0]
    count = 1 if name == "graspit" else COUNT
    assert len(grasps) == count
    found = matrices(f.compose(f.invert(f.unit(grasps.object_pose)), f.unit(grasps.stages["grasp"].base)))
    np.testing.assert_allclose(found, matrices(t.base)[:count], atol=CLOSE)
    np.testing.assert_allclose(grasps.object_scale, np.nan if name in ("graspqp", "graspit") else
                               1.0 if name in ("dexgraspnet2", "multigrippergrasp") else SCALE)  # fmt: skip
    assert set(grasps.object_name) == {"mug"} or name == "dexonomy"
    for stage in grasps.stages:
        joints, wanted = grasps.stages[stage].joints, getattr(t, stage)[:count]
        if name in ("graspgen", "acronym"):
            assert joints.shape == (COUNT, 0) and grasps.joint_names == ()
        elif name == "get_a_grip":
            np.testing.assert_allclose(joints[:, :3], wanted, atol=CLOSE)
            assert grasps.joint_names[:2] == ("joint_0.0", "joint_1.0")
        elif name in ("graspit", "multigrippergrasp") and not given:
            assert grasps.joint_names[0] == "dof_0" and not np.isnan(joints).any()
        else:
            order = [(grasps.joint_names or JOINTS).index(joint) for joint in JOINTS]
            np.testing.assert_allclose(joints[:, order], wanted, atol=CLOSE)


TOGETHER = ("dexgraspbench", "dexgraspnet", "graspqp", "dexonomy")
WHAT_TRAVELS = {
    "dexgraspbench": {"succ_flag", "ho_pene"},
    "bodex": {"grasp_error"},
    "dexonomy": {"hand_name", "tmpl_name", "obj_cpn_w", "pregrasp_path", "scene_path"},
    "dexgraspnet": {"E_fc"},
    "dexgraspnet2": {"point"},
    "get_a_grip": {"loss", "y_PGS", "grasp_orientations"},
    "graspqp": {"values", "grasp_velocities"},
    "isaac_grasp": {"confidence"},
    "multigrippergrasp": {"result", "result_time"},
    "graspgen": {"object_in_gripper"},
    "acronym": {"object_in_gripper"},
    "graspit": {"robot"},
}
STAGES = {"dexgraspbench": 3, "bodex": 3, "dexonomy": 3, "isaac_grasp": 2}


@pytest.mark.parametrize("name", WHAT_TRAVELS)
def test_what_else_files_say_travels_along(name, tmp_path, hand):
    need(name)
    grasps = read_grasps(SAMPLES[name](tmp_path, truth(), of_palm), hand=hand)
    assert set(grasps.columns) == WHAT_TRAVELS[name] and len(grasps.stages) == STAGES.get(name, 1)
    assert all(len(column) == len(grasps) for column in grasps.columns.values())


def test_every_format_has_a_sample():
    assert {name.split()[0] for name in SAMPLES} | {"jaxgrasp"} == set(FORMATS)


def test_bodex_knows_its_own_hands_and_asks_for_others(tmp_path):
    t = truth()
    path = SAMPLES["bodex"](tmp_path, t, lambda base: base)
    with pytest.raises(FileError, match="mug_grasp.npy: robot_pose: got poses of the first link of claw; wanted the h"):
        read_grasps(path)
    table = np.load(path, allow_pickle=True).item()
    for hand, root in (
        ("sim_shadow/fc", [0, 0, 0.034, 1, 0, 0, 0]),
        ("sim_allegro/fc", [0, 0, 0, 0, 1, 0, 1]),
        ("sim_leap/fc", [0, 0, 0.1, 0, 1, 0, 0]),
    ):
        save(path, table | {"manip_name": hand})
        found = matrices(read_grasps(path).stages["squeeze"].base) @ matrices(np.array([root], float))
        np.testing.assert_allclose(found, matrices(t.base), atol=CLOSE)
    save(path, table | {"manip_name": "leap", "scene_path": ["elsewhere/mug/scale006_pose000.npy"]})
    grasps = read_grasps(path)
    assert grasps.object_scale.tolist() == [0.06] * COUNT
    assert "there is no elsewhere/mug/scale006_pose000.npy beside it" in grasps.notes[0]


def test_older_files_of_bodex_and_dexonomy(tmp_path, hand):
    t = truth()
    path = SAMPLES["bodex"](tmp_path, t, of_palm)
    table = np.load(path, allow_pickle=True).item()
    del table["scene_path"]
    save(path, table | {"obj_pose": np.array([[0.0, 0, 1, 1, 0, 0, 0]]), "obj_scale": np.array([0.07])})
    grasps = read_grasps(path, hand=hand)
    assert set(grasps.object_scale) == {0.07} and set(grasps.object_pose[:, 2]) == {1.0} and grasps.notes == ()
    one = np.load(SAMPLES["dexonomy legacy"](tmp_path, t, of_palm) / "0.npy", allow_pickle=True).item()
    flat = {name: x[0] if name.endswith("_qpos") else x for name, x in one.items()}
    assert repr(read_grasps(save(tmp_path / "0.npy", flat)).stages) == repr(
        read_grasps(tmp_path / "legacy/0.npy").stages
    )


def test_isaac_grasps_without_joints_or_with_those_before_it_alone(tmp_path):
    pytest.importorskip("yaml")
    t = truth()
    path = SAMPLES["isaac_grasp"](tmp_path, t, lambda base: base)
    text = path.read_text()
    path.write_text(text.replace("    cspace_position:", "    cspace:"))
    grasps = read_grasps(path)
    np.testing.assert_array_equal(grasps.stages["grasp"].joints, t.pregrasp[:, [1, 2, 0]])
    assert "fingers are taken to stand as in pregrasp_cspace_position" in grasps.notes[0]
    assert grasps.notes[1] == "palm is taken to stand in the world of the hand's file, which --hand would look up"
    path.write_text(text.replace("cspace_position:", "cspace:").replace("format_version: 1.0\n", ""))
    grasps = read_grasps(path)
    assert grasps.joint_names == () and grasps.stages["grasp"].joints.shape == (COUNT, 0)


def test_grasps_of_dexgraspbench_whose_object_stands_in_a_scene(tmp_path):
    one = np.load(SAMPLES["dexgraspbench"](tmp_path, truth(), of_palm) / "0.npy", allow_pickle=True).item()
    del one["obj_pose"], one["obj_scale"], one["obj_path"]
    with pytest.raises(FileError, match="bare.npy: obj_pose: got neither it nor a scene_path"):
        read_grasps(save(tmp_path / "bare.npy", one))
    grasps = read_grasps(save(tmp_path / "named.npy", one | {"scene_path": "mug/scale012_pose003.npy"}))
    assert grasps.object_scale.tolist() == [0.12] and "beside it" in grasps.notes[0]
    (tmp_path / "mug").mkdir()
    save(tmp_path / "mug" / "scale012_pose003.npy", scene("mug"))
    grasps = read_grasps(tmp_path / "named.npy")
    assert grasps.object_scale.tolist() == [SCALE] and grasps.object_name.tolist() == ["mug"] and grasps.notes == ()


def test_fewer_fields_of_json(tmp_path, hand):
    t = truth()
    for name in ("multigrippergrasp", "graspgen"):
        path = SAMPLES[name](tmp_path, t, of_palm)
        wanted = read_grasps(path, hand=hand)
        table = json.loads(path.read_text())
        changed = {"final_dofs": table.pop("dofs"), "object_id": table.pop("object_ID")} if "dofs" in table else {}
        table.pop("object", None)
        path.write_text(json.dumps(table | changed))
        found = read_grasps(path, hand=hand)
        assert repr(found.stages) == repr(wanted.stages) and set(found.object_name) == {"mug"}


def test_files_with_and_without_names_go_together_by_the_hand(tmp_path, hand):
    t = truth()
    paths = [SAMPLES[name](tmp_path, t, of_palm if name in OF_LINK else lambda base: base) for name in TOGETHER]
    for order in (paths, paths[::-1]):
        grasps = read_grasps(order, hand=hand)
        assert len(grasps) == COUNT * len(TOGETHER) and set(grasps.joint_names) == set(JOINTS)
        columns = [grasps.joint_names.index(name) for name in JOINTS]
        np.testing.assert_allclose(
            grasps.stages["grasp"].joints[:, columns], np.tile(t.grasp, (len(TOGETHER), 1)), atol=CLOSE
        )
    with pytest.raises(FileError, match="joint_names: got (no )?names"):
        read_grasps(paths)


def test_scenes_are_looked_for_beside_the_grasps_alone(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "in").mkdir()
    path = SAMPLES["bodex"](tmp_path / "in", truth(), lambda base: base)
    secret = save(tmp_path / "secret.npy", scene("mug"))
    table = np.load(path, allow_pickle=True).item() | {"manip_name": "leap"}
    for outside in (str(secret), "../secret.npy", "x/../../secret.npy"):
        save(path, table | {"scene_path": [outside]})
        assert "beside it" in read_grasps(path).notes[0]


@pytest.mark.parametrize(
    ("name", "change", "message"),
    [
        ("dexgraspnet", lambda rows: rows[1]["qpos"].pop("a"), "qpos of grasp 1: got other joints than grasp 0 .a."),
        ("dexgraspnet", lambda rows: rows[0]["qpos"].update(d=1.0), "qpos of grasp 1: got other joints"),
        ("dexgraspnet", lambda rows: rows[2].pop("scale"), "grasp 2: scale: got nothing of this name"),
        ("dexgraspnet", lambda rows: rows[0]["qpos"].pop("WRJRx"), "grasp 0: qpos.WRJRx: got nothing of this name"),
        ("dexgraspnet", lambda rows: rows[0].update(scale="x"), "grasp 0: scale: got text; wanted a number"),
        ("dexgraspnet", lambda rows: rows.append(3), "grasp 4: qpos: got nothing of this name .there is no fields"),
        ("bodex", lambda t: t.pop("joint_names"), "joint_names: got nothing"),
        (
            "bodex",
            lambda t: t["joint_names"].append("d"),
            r"robot_pose: got shape \(1, 4, 3, 10\); wanted \(1, N, 3, 11",
        ),
        ("bodex", lambda t: t["joint_names"].__setitem__(0, "a"), "joint_names: got 'a' twice"),
        ("bodex", lambda t: t.update(scene_path=[]), "scene_path: got 0 of 1 scenes"),
        ("get_a_grip", lambda t: t.update(joint_angles=np.zeros((4, 15))), r"joint_angles: got shape \(4, 15\)"),
        ("get_a_grip", lambda t: t.update(rot=np.zeros((3, 3, 3))), r"rot: got shape \(3, 3, 3\); wanted \(4, 3, 3\)"),
    ],
)
def test_fields_that_cannot_be_used_are_named(name, change, message, tmp_path, hand):
    path = SAMPLES[name](tmp_path, truth(), of_palm)
    data = np.load(path, allow_pickle=True)
    data = data.item() if data.ndim == 0 else data.tolist()
    change(data)
    save(path, data)
    with pytest.raises(FileError, match=f"{path.name}: {message}") as caught:
        read_grasps(path, hand=hand)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("name", "old", "new", "message"),
    [
        ("isaac_grasp", "version: 1.0", "version: 2.0", "format_version: got 2.0; wanted 1.0"),
        ("isaac_grasp", "      b:", "      d:", "cspace_position of grasp 1: got other joints"),
        ("isaac_grasp", "w: ", "v: ", "orientation.w: got nothing of this name .there is v, xyz"),
        (
            "isaac_grasp",
            "grasps:",
            "grasps: !!python/object/apply:os.system [touch canary]\nx:",
            "got the tag tag:yaml",
        ),
        ("isaac_grasp", "grasps:", "x: &a [1]\ny: [*a, *a]\ngrasps:", "got an anchor or an alias"),
        ("isaac_grasp", "grasps:", "x: " + "[" * 50 + "\ngrasps:", "got lists more than 16 deep"),
        ("isaac_grasp", "grasps:", "x: {[1]: 2}\ngrasps:", "got a key that is no word"),
        ("isaac_grasp", "position: [", "position: [1, ", r"position: got shape \(4,\); wanted \(3\)"),
        ("isaac_grasp", "palm", "mount", "no link 'mount'|palm"),
        ("multigrippergrasp", '"dofs": [[', '"dofs": [[1, ', "dofs: got lists of different lengths"),
        ("multigrippergrasp", '"dofs": [[', '"dofs": [["x", ', "dofs: got"),
        ("multigrippergrasp", "}", "", "got damaged JSON"),
        ("multigrippergrasp", '"gripper": "claw"', '"gripper": ' + "[" * 100_000, "got lists that are too deep"),
        ("graspgen", '"scale": 0.08', '"scale": [1, 2, 1]', "object.scale: got other factors along other axes"),
        ("graspgen", '"transforms"', '"transform"', "got a file of no format that is known"),
        ("graspit", "<world>", "<!DOCTYPE x [<!ENTITY a 'b'>]><world>", "got a document type"),
        ("graspit", "(+1 +0", "(+1", "graspableBody/transform/fullTransform: got .*; wanted .w x y z"),
        ("graspit", "<dofValues>", "<dofValues>1 ", "robot/dofValues: got 7 values; wanted 3, or twice as many"),
        ("graspit", "</graspableBody>", "</graspableBody><robot><filename>x</filename></robot>", "filename: got 2 of"),
        ("graspit", "</world>", "", "XML that is not well-formed"),
    ],
)
def test_text_that_cannot_be_used_is_named(name, old, new, message, tmp_path, hand, monkeypatch):
    need(name)
    monkeypatch.chdir(tmp_path)
    path = SAMPLES[name](tmp_path, truth(), of_palm)
    text = path.read_text()
    assert old in text
    path.write_text(text.replace(old, new, 1))
    if message.endswith("|palm"):
        return
    with pytest.raises(FileError, match=f"{path.name}: .*{message}") as caught:
        read_grasps(path, hand=hand)
    assert "\n" not in str(caught.value) and not (tmp_path / "canary").exists()


def test_names_that_are_known_and_not_read_and_names_that_are_not_known(tmp_path):
    for name, what in (("dex-net", "Dex-Net"), ("springgrasp", "SpringGrasp"), ("FRoGGeR", "FRoGGeR")):
        with pytest.raises(ValueError, match=f"format: got {what}, which is not read yet"):
            read_grasps([tmp_path], name)
    with pytest.raises(ValueError, match="format: got 'x', wanted one of dexonomy, dexgraspbench"):
        read_grasps([tmp_path], "x")
    np.save(tmp_path / "wrist_mug.npy", np.zeros((2, 3)))
    with pytest.raises(FileError, match="wrist_mug.npy: got a file of SpringGrasp, which is not read yet"):
        read_grasps(tmp_path / "wrist_mug.npy")
    save(tmp_path / "other.npy", {"what": 1})
    with pytest.raises(FileError, match="other.npy: got a file of no format that is known .what.; wanted one of"):
        read_grasps(tmp_path / "other.npy")
    with pytest.raises(FileError, match=r"other.npy: .*wanted grasp_qpos|other.npy: got fields what"):
        read_grasps(tmp_path / "other.npy", "jaxgrasp")


def test_dexnet_is_recognised_and_links_of_hdf5_are_refused(tmp_path):
    h5py = pytest.importorskip("h5py")
    with h5py.File(tmp_path / "dexnet.hdf5", "w") as file:
        file["objects/mug/mesh/vertices"] = np.zeros((3, 3))
    with pytest.raises(FileError, match="got a file of Dex-Net, which is not read yet"):
        read_grasps(tmp_path / "dexnet.hdf5")
    with h5py.File(tmp_path / "link.h5", "w") as file:
        file["grasps/transforms"] = h5py.ExternalLink("dexnet.hdf5", "/objects")
    with pytest.raises(FileError, match="link.h5: got a link to elsewhere .grasps/transforms."):
        read_grasps(tmp_path / "link.h5")
    with h5py.File(tmp_path / "large.h5", "w") as file:
        file.create_dataset("grasps/transforms", (10**9, 4, 4), "f4", chunks=(1, 4, 4))
    with pytest.raises(FileError, match="large.h5: got data that are too large"):
        read_grasps(tmp_path / "large.h5")
    with h5py.File(tmp_path / "circle.h5", "w") as file:
        file["a/b"] = file.create_group("c")
        file["c/d"] = file["a"]
    with pytest.raises(FileError, match="circle.h5: got (groups that are part of themselves|a file of no format)"):
        read_grasps(tmp_path / "circle.h5")


@pytest.mark.skipif(not SHARED.is_dir(), reason="files of others, which are not part of the project")
def test_files_as_they_are_found():
    bench = read_grasps(SHARED / "formats" / "dexgraspbench")
    assert set(bench.stages) == {"pregrasp", "grasp", "squeeze"} and bench.object_scale.tolist() == [0.08, 0.08]
    raw = np.load(SHARED / "formats" / "dexgraspbench" / "bottle_scale008_0.npy", allow_pickle=True).item()
    np.testing.assert_array_equal(bench.stages["squeeze"].qpos[0], raw["squeeze_qpos"])
    net = read_grasps(
        SHARED / "formats" / "dexgraspnet" / "*.npy", hand=SHARED / "hands/dexgraspnet_shadow/right_hand.xml"
    )
    assert (
        len(net) == 205
        and len(net.joint_names) == 22
        and set(net.object_scale.round(6)) <= {0.06, 0.08, 0.1, 0.12, 0.15}
    )
    rows = np.load(SHARED / "formats" / "dexgraspnet" / "ddg-gd_banana_poisson_002.npy", allow_pickle=True)
    column = net.joint_names.index("robot0:THJ3")
    np.testing.assert_array_equal(net.stages["grasp"].joints[:, column], [r["qpos"]["robot0:THJ3"] for r in rows])


@pytest.mark.parametrize(
    ("names", "hand", "wanted"),
    [
        (("a", "b"), ("b", "c", "a"), ("b", "a")),
        (("FFJ4", "THJ1"), ("rh_FFJ4", "rh_WRJ1", "rh_THJ1"), ("rh_FFJ4", "rh_THJ1")),
        (("rh_FFJ4", "rh_THJ1"), ("FFJ4", "THJ1"), ("FFJ4", "THJ1")),
        # A left hand's grasps are no right hand's.
        (("lh_FFJ4", "lh_THJ1"), ("rh_FFJ4", "rh_THJ1"), "joints: got 'lh_FFJ4'"),
        (("joint_0.0", "joint_13.0"), ("thj1", "ffj0"), ("thj1", "ffj0")),
        (("thj1", "ffj0"), ("joint_0.0", "joint_13.0"), ("joint_0.0", "joint_13.0")),
        (("a", "x"), ("a", "b"), "joints: got 'x'; wanted some of the hand's: a, b"),
        # Named alike, turned otherwise: DexGraspNet's Shadow hand.
        (("robot0:FFJ3",), ("rh_FFJ4", "rh_FFJ3"), "joints: got 'robot0:FFJ3'"),
        (None, ("a", "b", "c"), "joints: got 2 joints without names; wanted 3, those of the hand: a, b, c"),
    ],
)
def test_joints_get_the_names_of_the_hand(names, hand, wanted):
    joints = np.arange(2.0)[None]
    poses = HandPoses(np.zeros((1, 7)), joints)
    one = np.ones(1)
    grasps = GraspSet({"grasp": poses}, names, np.zeros((1, 7)), one, np.array(["mug"]), np.array(["f.npy:0"]), {})
    if isinstance(wanted, str):
        with pytest.raises(FileError, match=f"^f.npy: {wanted}"):
            grasps.for_hand(hand)
        return
    found = grasps.for_hand(hand)
    assert found.joint_names == wanted
    # Each test that turns the order round names the first joint of the file last in the hand.
    turned = hand in {("b", "c", "a"), ("thj1", "ffj0"), ("joint_0.0", "joint_13.0")}
    assert found.stages["grasp"].joints[0].tolist() == ([1.0, 0.0] if turned else [0.0, 1.0])


def test_a_quaternion_of_no_length_or_a_huge_one_is_no_turn():
    for scale in (0.0, 1e300):
        pose = f.unit(np.array([1.0, 2.0, 3.0, 0.0, scale, 0.0, 0.0]))
        assert pose[:3].tolist() == [1.0, 2.0, 3.0] and np.isnan(pose[3:]).all()
