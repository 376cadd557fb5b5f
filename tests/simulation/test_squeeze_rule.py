"""Squeezes from the model alone: what the rule asks of contacts, gaps and servos, and what C MuJoCo makes of it."""

from __future__ import annotations

from pathlib import Path

import mujoco
import numpy as np
import pytest

import jaxgrasp as jg
from jaxgrasp.cli import main
from jaxgrasp.evaluation import evaluate
from jaxgrasp.files import GraspSet, HandPoses, read_grasps, write_grasps
from jaxgrasp.hands import HandObject, Scene
from jaxgrasp.hands.contact_parameters import hand_object_pairs
from jaxgrasp.hands.hand_files import hand_spec
from jaxgrasp.hands.scenes import four_fingers
from jaxgrasp.hands.servos import servo_commands
from jaxgrasp.hands.softness import depths
from jaxgrasp.hands.squeeze_rule import first_to_touch

DATA = Path(__file__).resolve().parents[3] / "shared" / "data"
BENT = (0.0, -0.165, 1.124)
# N, what servos that move and contacts that give way may make of a force.
NEAR = 0.15


def ball_grasps(gap: float = 0.0) -> GraspSet:
    """Fingers around a ball of 5 cm, and off it; and a hand that is far away from it."""
    model = four_fingers("sphere").compile()
    ball = model.qpos0[model.jnt_qposadr[model.body("object").jntadr[0]] :][:3]
    joints = np.tile(np.tile(BENT, 4), (3, 1))
    joints[1] -= np.tile((0.0, gap / 0.07, 0.0), 4)
    base = np.tile([0.0, 0, 0, 1, 0, 0, 0], (3, 1))
    base[2, 0] = 1.0
    return GraspSet(
        stages={
            "pregrasp": HandPoses(base, joints - np.tile((0.0, 0.1, 0.0), 4)),
            "grasp": HandPoses(base, joints),
        },
        joint_names=None,
        object_pose=np.tile([*ball, 1.0, 0, 0, 0], (3, 1)),
        object_scale=np.full(3, 0.05),
        object_name=np.full(3, "ball"),
        source=np.array([f"ball.npz:{k}" for k in range(3)]),
        columns={},
    )


@pytest.fixture(scope="module")
def grasps() -> GraspSet:
    return ball_grasps(gap=0.002)


@pytest.fixture(scope="module")
def found(grasps) -> GraspSet:
    return jg.squeeze_grasps(grasps, hand="four_fingers", object="sphere", max_force=4.0)


def test_the_forces_are_internal_and_as_strong_as_asked(found):
    forces, points = found.columns["forces"][:2], np.nan_to_num(found.columns["contact_points"][:2])
    np.testing.assert_allclose(forces.sum(1), 0, atol=1e-6)
    centre = points.sum(1, keepdims=True) / 4
    np.testing.assert_allclose(np.cross(points - centre, forces).sum(1), 0, atol=1e-6)
    toward = np.where(np.abs(forces) > 0, forces, 0)
    assert np.all(np.linalg.norm(toward, axis=-1).max(-1) >= 4.0 - 1e-6)
    assert found.columns["status"][:2].tolist() == ["SOLVED"] * 2 and (found.columns["margin"][:2] > 1).all()


def test_the_forces_arrive_through_gaps(found):
    """Servos that are sent there press about as hard as was planned, off the surface or on it."""
    scene = Scene.build(
        hand="four_fingers", object="sphere", scale=0.05, mass=0.1, friction=0.6, base="fixed", gravity=(0, 0, 0)
    )
    hand, model = scene.hand_object(), scene.model
    for row in range(2):
        data = mujoco.MjData(model)
        data.qpos[:] = scene.qpos(joints=found.stages["grasp"].joints[row], object=found.object_pose[row])[0]
        data.ctrl[hand.actuators] = found.columns["squeeze_controls"][row]
        mujoco.mj_step(model, data, nstep=round(0.25 / model.opt.timestep))
        pressed = np.zeros(model.nbody)
        for number, contact in enumerate(data.contact):
            wrench = np.zeros(6)
            mujoco.mj_contactForce(model, data, number, wrench)
            pressed[model.geom_bodyid[contact.geom]] += wrench[0]
        planned = np.linalg.norm(found.columns["forces"][row], axis=-1)
        planned = np.sort(planned[planned > 0.5])
        arrived = np.sort(pressed[hand.bodies][pressed[hand.bodies] > 0.1])[-len(planned) :]
        np.testing.assert_allclose(arrived / planned, 1, atol=NEAR)


def test_targets_and_commands_agree(found):
    # Each joint has a servo of its own whose command is an angle.
    np.testing.assert_allclose(found.stages["squeeze"].joints[:2], found.columns["squeeze_controls"][:2], atol=1e-9)


def test_where_nothing_is_near_fingers_go_on_closing(grasps, found):
    went = grasps.stages["grasp"].joints[2] - grasps.stages["pregrasp"].joints[2]
    np.testing.assert_allclose(found.stages["squeeze"].joints[2] - found.stages["grasp"].joints[2], went)
    assert found.columns["margin"][2] == 0 and not found.columns["forces"][2].any()


def test_squeezed_grasps_hold(found):
    tried = evaluate(found.take(np.array([0, 1])), hand="four_fingers", object="sphere")
    assert tried.held.all()


def test_rows_without_a_configuration_harm_no_neighbour(grasps, found):
    poses = grasps.stages["grasp"]
    base = poses.base.copy()
    base[2] = np.nan
    broken = GraspSet(**{**vars(grasps), "stages": {**grasps.stages, "grasp": HandPoses(base, poses.joints)}})
    other = jg.squeeze_grasps(broken, hand="four_fingers", object="sphere", max_force=4.0)
    assert np.isnan(other.stages["squeeze"].joints[2]).all() and np.isnan(other.columns["margin"][2])
    assert other.columns["status"].tolist() == ["SOLVED", "SOLVED", "INVALID_INPUT"]
    np.testing.assert_allclose(
        other.stages["squeeze"].joints[:2], found.stages["squeeze"].joints[:2], rtol=0, atol=1e-12
    )


def test_motors_stay_and_get_efforts(grasps, found):
    hand = hand_spec("four_fingers")
    for actuator in hand.actuators:
        actuator.gainprm[:3], actuator.biasprm[:3] = (1, 0, 0), (0, 0, 0)
        actuator.biastype = mujoco.mjtBias.mjBIAS_NONE
        actuator.ctrllimited = mujoco.mjtLimited.mjLIMITED_FALSE
    other = jg.squeeze_grasps(grasps, hand=hand, object="sphere", max_force=4.0)
    np.testing.assert_array_equal(other.stages["squeeze"].joints[:2], other.stages["grasp"].joints[:2])
    np.testing.assert_allclose(other.columns["squeeze_controls"][:2], other.columns["torques"][:2], atol=0.02)
    with pytest.raises(ValueError, match="no position servos"):
        servo_commands(Scene.build(hand=hand, object="sphere", scale=0.05).hand_object())


def test_weak_motors_press_as_hard_as_they_can(grasps):
    hand = hand_spec("four_fingers")
    for actuator in hand.actuators:
        actuator.forcelimited, actuator.forcerange = mujoco.mjtLimited.mjLIMITED_TRUE, (-0.05, 0.05)
    weak = jg.squeeze_grasps(grasps, hand=hand, object="sphere", max_force=4.0)
    assert np.abs(weak.columns["torques"][:2]).max() <= 0.05 + 1e-6
    strongest = np.linalg.norm(weak.columns["forces"][:2], axis=-1).max()
    assert 0.1 < strongest < 4.0


def test_of_links_on_one_tendon_the_first_to_touch_counts():
    # Contacts 0 and 1 share servo 0; 2 is on servo 1; 3 is moved by none, 4 neither, and is off the surface.
    motion = np.array([[[0.02, 0], [0.04, 0], [0, 0.03], [0, 0], [0, 0]]])
    gap = np.array([[0.001, 0.0015, 0.004, 0.0, 0.002]])
    active = np.ones((1, 5), bool)
    assert first_to_touch(motion, gap, active).tolist() == [[False, True, True, True, False]]
    gap[0, :2] = 0
    # Both touch: the outermost one, with the longer lever.
    assert first_to_touch(motion, gap, active)[0, :2].tolist() == [False, True]
    assert first_to_touch(motion, gap, active & (np.arange(5) != 1))[0, :2].tolist() == [True, False]


@pytest.mark.parametrize(
    ("solref", "solimp"), [((0.02, 1.0), (0.9, 0.95, 0.001, 0.5, 2)), ((-3000.0, -50.0), (0.5, 0.99, 1e-4, 0.3, 3))]
)
def test_depths_are_those_at_which_mujoco_comes_to_rest(solref, solimp):
    """A ball on a finger of a heavy hand under forces: inverse weights are then exact."""
    of = f'solref="{" ".join(map(str, solref))}" solimp="{" ".join(map(str, solimp))}"'
    spec = mujoco.MjSpec.from_string(f"""<mujoco>
      <option timestep="0.001" cone="elliptic" integrator="implicitfast" gravity="0 0 0"/>
      <worldbody><body name="hand"><joint name="j" type="slide" axis="0 0 1"/>
      <geom name="pad" type="box" size=".1 .1 .01" mass="5" {of}/></body>
      <body name="object" pos="0 0 .03"><freejoint/><geom type="sphere" size=".02" mass=".2" {of}/></body></worldbody>
      <actuator><position joint="j" kp="1e5" kv="3e3"/></actuator></mujoco>""")
    hand = HandObject.from_mjcf(spec, "object")
    model, forces = hand.model, np.array([0.0, 1.0, 4.0])
    expected = depths(hand, np.array([[model.body("hand").id]]), forces)[0, 0]
    for force, depth in zip(forces[1:], expected[1:], strict=True):
        data = mujoco.MjData(model)
        data.xfrc_applied[model.body("object").id, 2] = -force
        mujoco.mj_step(model, data, nstep=2000)
        np.testing.assert_allclose(-data.contact.dist.min(), depth, rtol=0.05)


def test_solver_parameters_are_mixed_as_mujoco_mixes_them():
    spec = mujoco.MjSpec.from_string("""<mujoco><worldbody>
      <body name="hand"><joint name="j"/><geom name="a" size=".02" solref=".01 1" solmix="3"/></body>
      <body name="object" pos="0 0 .035"><freejoint/><geom name="b" size=".02" solref=".03 2" solimp=".5 .6 .01 .4 3"/>
      </body></worldbody></mujoco>""")
    model, data = spec.compile(), None
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    found = hand_object_pairs(model, np.array([1]), np.array([2]))[0, 1]
    np.testing.assert_allclose(found.solref, data.contact.solref[0])
    np.testing.assert_allclose(found.solimp, data.contact.solimp[0])


def test_the_command(grasps, tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    write_grasps(grasps, "ball.npz")
    call = ["squeeze", "--hand", "four_fingers", "--object", "sphere", "--grasps", "ball.npz", "--max-force", "4"]
    assert main([*call, "--output", "out"]) == 0
    assert "out/sphere.npz" in capsys.readouterr().out
    back = read_grasps("out/sphere.npz")
    assert set(back.stages) == {"pregrasp", "grasp", "squeeze"} and {"margin", "effort", "status"} <= set(back.columns)
    np.testing.assert_array_equal(back.stages["grasp"].joints, grasps.stages["grasp"].joints)
    assert main([*call, "--output", "bench", "--format", "dexgraspbench"]) == 0
    bench = read_grasps("bench/sphere", hand="four_fingers")
    np.testing.assert_allclose(bench.stages["squeeze"].joints, back.stages["squeeze"].joints, atol=1e-6)
    capsys.readouterr()
    assert main([*call, "--output", "ball.npz"]) == 2
    assert main([*call, "--output", "out", "--format", "x"]) == 2
    assert main([*call, "--output", "out", "--friction", "-1"]) == 2
    lines = capsys.readouterr().err.splitlines()
    assert len(lines) == 3 and "read from" in lines[0] and "--format" in lines[1] and "--friction" in lines[2]
