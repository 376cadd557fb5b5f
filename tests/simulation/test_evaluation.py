"""Trials by named protocols: what becomes of grasps that must hold and of those that cannot, and what is told."""

from __future__ import annotations

import json
from pathlib import Path

import mujoco
import numpy as np
import pyarrow.parquet as parquet
import pytest
from ball_grasps import ball_grasps

from jaxgrasp.cli import main
from jaxgrasp.evaluation import diversity, evaluate, evaluation_table, film, summaries, wilson, write_evaluation
from jaxgrasp.files import GraspSet, HandPoses, read_grasps, write_grasps
from jaxgrasp.files.objects import grouped, name_of_object
from jaxgrasp.hands.hand_files import hand_spec
from jaxgrasp.hands.servos import ARMATURE, DAMPING, FRICTION, with_servos
from jaxgrasp.simulation import PROTOCOLS, trial_scene

DATA = Path(__file__).resolve().parents[3] / "shared" / "data"


@pytest.fixture(scope="module")
def grasps() -> GraspSet:
    return ball_grasps(quality=np.array([3.0, 1.0, 2.0, 0.0, 3.0]))


@pytest.fixture(scope="module")
def found(grasps):
    return evaluate(grasps, hand="four_fingers", object="sphere", workers=2)


def test_what_must_hold_holds_and_what_must_not_does_not(found):
    assert found.outcome.tolist() == ["held", "lost", "penetration", "not usable", "held"]
    assert found.held.tolist() == [True, False, False, False, True]
    assert found.loads[0].tolist() == [1] * 6
    assert found.loads[1].tolist() == [0] + [-1] * 5
    assert found.delta_pos[0] < 0.01 < 0.05 < found.delta_pos[1]
    assert np.isnan(found.delta_pos[2:4]).all()
    assert found.penetration[2] > 0.01
    assert found.contact_number[0] == 4


def test_the_same_grasp_ends_alike_whatever_thread_tries_it(found):
    table = evaluation_table(found)
    for name, column in table.items():
        if name != "source":
            np.testing.assert_array_equal(column[0], column[4], err_msg=name)


@pytest.mark.parametrize("protocol", ["jaxgrasp-hold", "six-gravities", "six-pulls"])
def test_other_protocols(grasps, protocol):
    found = evaluate(grasps.take(np.array([0, 1, 3])), hand="four_fingers", object="sphere", protocol=protocol)
    assert found.outcome[0] == "held"
    assert found.outcome[1] in ("lost", "held") and (protocol == "six-gravities" or not found.held[1])
    assert found.outcome[2] == "not usable"


def test_what_a_protocol_sets_is_in_the_scene():
    hand = hand_spec("four_fingers")
    hand.option.iterations, hand.option.timestep = 7, 0.01
    model = trial_scene(PROTOCOLS["dexgraspbench-fc"].course, hand, "box", 0.05).model
    assert model.opt.timestep == 0.004 and model.opt.iterations == 100 and model.opt.noslip_iterations == 2
    assert model.opt.disableflags & int(mujoco.mjtDisableBit.mjDSBL_MULTICCD)
    assert np.all(model.geom_condim == 4) and np.all(model.geom_friction[:, :2] == (0.6, 0.02))
    box = model.geom_bodyid == model.body("object").id
    np.testing.assert_allclose(model.geom_solref[~box], np.tile((0.005, 1.0), ((~box).sum(), 1)))
    np.testing.assert_allclose(model.body_mass[model.body("object").id], 0.1)
    # The weld that holds the base acts at the base's own frame.
    weld = np.flatnonzero(model.eq_type == int(mujoco.mjtEq.mjEQ_WELD))
    np.testing.assert_array_equal(model.eq_data[weld[0], :11], [0, 0, 0, 0, 0, 0, 1, 0, 0, 0, 1])


def test_what_diverges_is_no_grasp_that_was_lost(grasps, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    hand = hand_spec("four_fingers")
    for actuator in hand.actuators:
        actuator.gainprm[0], actuator.biasprm[1] = 1e9, -1e9
        actuator.forcelimited = mujoco.mjtLimited.mjLIMITED_FALSE
    for joint in hand.joints:
        joint.damping[0], joint.armature = 0, 0
    found = evaluate(grasps.take(np.array([0, 1])), hand=hand, object="sphere")
    assert found.outcome.tolist() == ["diverged", "diverged"]
    assert not found.tried.any() and np.isnan(found.delta_pos).all()
    assert summaries(found)[0].diverged == 2 and summaries(found)[0].interval == (0.0, 1.0)
    assert not list(tmp_path.iterdir())


def test_ctrl_c_keeps_what_is_done(grasps):
    def stop(done: int) -> None:
        if done >= 2:
            raise KeyboardInterrupt

    found = evaluate(grasps, hand="four_fingers", object="sphere", workers=1, progress=stop)
    assert found.interrupted and 2 <= len(found) < 5
    assert found.grasps.source.tolist() == sorted(found.grasps.source.tolist())


def test_stages_that_are_missing_are_the_grasp(grasps):
    alone = GraspSet(
        **{**vars(grasps.take(np.array([0]))), "stages": {"grasp": grasps.take(np.array([0])).stages["grasp"]}}
    )
    found = evaluate(alone, hand="four_fingers", object="sphere")
    assert found.said == ("the grasps have no pregrasp and no squeeze: the grasp itself was taken for it",)
    assert not found.held[0]


@pytest.mark.parametrize("ending", [".parquet", ".csv", ".npz"])
def test_tables_have_rows_in_order_and_all_parameters(found, tmp_path, ending):
    path = tmp_path / f"trials{ending}"
    write_evaluation(found, path, {"margin": np.arange(5.0)})
    parameters = found.protocol.parameters()
    if ending == ".parquet":
        table = parquet.read_table(path)
        assert json.loads(table.schema.metadata[b"protocol_parameters"]) == json.loads(json.dumps(parameters))
        assert table.column("source").to_pylist() == found.grasps.source.tolist()
        assert table.column("held").to_pylist() == found.held.tolist()
        assert {"object_name", "object_scale", "delta_pos", "delta_angle", "penetration", "quality"} <= {
            *table.column_names
        }
    elif ending == ".npz":
        with np.load(path) as archive:
            assert json.loads(str(archive["protocol_parameters"]))["load"] == 1.0
            np.testing.assert_array_equal(archive["loads"], found.loads)
    else:
        lines = path.read_text().splitlines()
        assert len(lines) == 6 and "loads_5" in lines[0]


def test_a_film_shows_the_course(grasps, found):
    scene, frames = film(found, 1, hand="four_fingers", object="sphere")
    assert frames[0][0] == 0 and frames[-1][0] > 0.8
    assert frames[0][1].shape == (scene.model.nq,)
    assert not frames[20][2].any() and frames[-1][2].tolist() == [-1.0, 0.0, 0.0]


def test_wilson():
    # Newcombe 1998, table I: 81 of 263, 15 of 148, 0 of 20, 1 of 29.
    for successes, count, low, high in ((81, 263, 0.2553, 0.3662), (15, 148, 0.0624, 0.1605), (0, 20, 0.0, 0.1611)):
        np.testing.assert_allclose(wilson(successes, count), (low, high), atol=1e-4)
    assert wilson(20, 20)[1] == 1.0


def test_diversity_does_not_depend_on_where_the_object_is(grasps):
    rng = np.random.default_rng(0)
    turns = rng.normal(size=(8, 4))
    turns /= np.linalg.norm(turns, axis=-1, keepdims=True)
    base = np.concatenate([rng.normal(size=(8, 3)), turns], -1)
    joints = rng.normal(size=(8, 12))

    def put(turn: np.ndarray, shift: np.ndarray) -> GraspSet:
        moved, poses = base.copy(), np.zeros((8, 7))
        for row in range(8):
            mujoco.mju_rotVecQuat(moved[row, :3], base[row, :3], turn)
            mujoco.mju_mulQuat(moved[row, 3:], turn, base[row, 3:])
        moved[:, :3] += shift
        poses[:] = [*shift, *turn]
        columns = {"object_pose": poses, "object_scale": np.ones(8), "object_name": np.full(8, ""), "columns": {}}
        return GraspSet(
            stages={"grasp": HandPoses(moved, joints)}, joint_names=None, source=np.full(8, "a:0"), **columns
        )

    here, there = put(np.array([1.0, 0, 0, 0]), np.zeros(3)), put(turns[0], np.array([1.0, 2, 3]))
    np.testing.assert_allclose(diversity(here), diversity(there), atol=1e-12)
    assert (np.diff(diversity(here)) > 0).all() and diversity(here)[-1] < 1


def test_objects_are_told_apart_by_name(grasps, tmp_path):
    assert name_of_object("a/can/pieces") == "can" and name_of_object("a/can.obj") == "can"
    groups = list(grouped(grasps, ["x/ball/pieces", "x/box.obj"]))
    assert [group.name for group in groups] == ["ball"] and len(groups[0].rows) == 5
    with pytest.raises(ValueError, match=r"ball.npz: object_name: got 'ball'; wanted one of cup, box"):
        list(grouped(grasps, ["cup", "box"]))
    with pytest.raises(ValueError, match="called 'a'"):
        list(grouped(grasps, ["a.obj", "b/a/mesh.obj"]))


def test_servos_are_added_where_there_are_none():
    bare = mujoco.MjSpec.from_string("""<mujoco><worldbody><body><geom size=".01"/><joint name="a" damping=".3"/>
      <body pos="0 0 .1"><geom size=".01"/><joint name="b"/></body></body></worldbody></mujoco>""")
    spec, said = with_servos(bare, 5.0)
    model = spec.compile()
    assert said == (
        "added position servos of 5 N m/rad for 2 joints or motors, damping of 0.05 N m s/rad for 1 joints, armature "
        "of 0.0002 kg m^2 for 2 joints, dry friction of 0.01 N m for 2 joints"
    )
    assert model.nu == 2 and model.actuator_gainprm[:, 0].tolist() == [5, 5]
    assert model.actuator_biasprm[:, 1].tolist() == [-5, -5]
    np.testing.assert_allclose(model.dof_damping, [0.3, DAMPING])
    np.testing.assert_allclose(model.dof_armature, ARMATURE)
    np.testing.assert_allclose(model.dof_frictionloss, FRICTION)
    with pytest.raises(ValueError, match="servo gain: got one for a hand with position servos"):
        with_servos(spec, 5.0)


def test_a_motor_becomes_a_servo_of_the_same_strength():
    motor = mujoco.MjSpec.from_string("""<mujoco><worldbody><body><geom size=".01"/><joint name="a"/></body></worldbody>
      <actuator><motor joint="a" gear="4" ctrlrange="-.5 .5"/></actuator></mujoco>""")
    model = with_servos(motor, 8.0)[0].compile()
    data = mujoco.MjData(model)
    # The command is a length, four times the angle; the joint gets 8 N m/rad, and at most 2 N m.
    for angle, torque in ((0.1, 0.8), (1.0, 2.0)):
        data.ctrl[0] = 4 * angle
        mujoco.mj_forward(model, data)
        np.testing.assert_allclose(data.qfrc_actuator, [torque])


def test_a_hand_without_servos_is_refused_by_name(grasps):
    hand = hand_spec("four_fingers")
    for actuator in list(hand.actuators):
        hand.delete(actuator)
    with pytest.raises(ValueError, match=r"hand: it has no actuators.*--servo-gain"):
        evaluate(grasps, hand=hand, object="sphere")
    told = []
    found = evaluate(grasps, hand=hand, object="sphere", skipped=told.append)
    assert set(found.outcome) == {"not usable"} and len(told) == 1


def test_the_command(grasps, tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    write_grasps(grasps, "ball.npz")
    Path("broken.npz").write_bytes(b"no archive")
    hand = ["evaluate", "--hand", "four_fingers", "--object", "sphere", "--grasps", "ball.npz"]
    assert main([*hand, "--columns", "quality", "--metric", "min_weight"]) == 0
    out, err = capsys.readouterr()
    assert "2 of" not in err and "quality (file)" in out and "min_weight" in out
    assert parquet.read_table("trials.parquet").column("held").to_pylist() == [True, False, False, False, True]
    assert Path("trials.png").stat().st_size > 10_000
    assert main([*hand, "broken.npz", "--figure", "None"]) == 2
    assert len(capsys.readouterr().err.splitlines()) == 1
    assert main([*hand, "broken.npz", "--figure", "None", "--keep-going"]) == 2
    assert "broken.npz" in capsys.readouterr().err
    assert parquet.read_table("trials.parquet").num_rows == 5


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["--protocol", "x", "--show"], "--protocol: got 'x'; wanted one of dexgraspbench-fc"),
        ([], "--hand: got none"),
        (["--hand", "four_fingers"], "--object: got none"),
        (["--hand", "four_fingers", "--object", "sphere"], "--grasps: got none"),
        (["--hand", "no.xml", "--object", "sphere", "--grasps", "a.npz"], "a.npz: got no such file"),
        (["--hand", "h", "--object", "a/b", "c/b", "--grasps", "a.npz", "--servo-gain", "-1"], "--servo-gain: got -1"),
    ],
)
def test_what_cannot_be_is_one_line(arguments, said, capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert main(["evaluate", *arguments]) == 2
    err = capsys.readouterr().err
    assert len(err.splitlines()) == 1 and said in err


def test_show_prints_every_parameter(capsys):
    for name, protocol in PROTOCOLS.items():
        assert main(["evaluate", "--protocol", name, "--show"]) == 0
        lines = dict(line.split(": ", 1) for line in capsys.readouterr().out.splitlines())
        assert {key: json.loads(value) for key, value in lines.items()} == json.loads(protocol.as_json())


@pytest.mark.skipif(not DATA.is_dir(), reason="needs the published grasps")
def test_the_benchmarks_own_answers():
    grasps = read_grasps(DATA / "dexgraspbench/can/grasps.npz").take(np.array([0, 7, 12, 44]))
    found = evaluate(grasps, hand=DATA / "hands/shadow/right_hand.xml", object=DATA / "dexgraspbench/can/pieces")
    np.testing.assert_array_equal(found.held, grasps.columns["succ_flag"])
    np.testing.assert_allclose(found.penetration, grasps.columns["ho_pene"], atol=1e-5)
    np.testing.assert_array_equal(found.contact_number, grasps.columns["contact_num"])
    held = found.held
    np.testing.assert_allclose(found.delta_pos[held], grasps.columns["delta_pos"][held], atol=2e-4)
