"""Squeeze, gravity and six pushes in C MuJoCo: what must hold holds, and what must not does not."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest

from jaxgrasp.hands import HandObject, close_fingers
from jaxgrasp.hands.scenes import four_fingers
from jaxgrasp.simulation import DIRECTIONS, Trials, hold_trials

# rad: base, flex1 and flex2 of fingers whose tips touch the ball from the side.
BENT = (0.0, -0.165, 1.124)
# N: four fingers that press so hard hold 6.4 N by friction (0.8), the weight of 1 N included.
PRESS, PUSH, FAR_BEYOND = 2.0, 1.0, 30.0
# m: what a base of ten tons lets happen.
ANCHORED = 1e-4


@pytest.fixture(scope="module")
def hand() -> HandObject:
    return HandObject.from_mjcf(four_fingers("sphere"), "object", contact_distance=1e-3)


@pytest.fixture(scope="module")
def grasp(hand) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Fingers around the ball: configuration, commands that squeeze and commands that do not."""
    qpos = hand.model.qpos0.copy()
    qpos[:12] = np.tile(BENT, 4)
    qpos = np.asarray(close_fingers(hand, qpos))
    grasps = hand.grasps(qpos)
    forces = np.zeros((*grasps.distances.shape, 3))
    forces[np.asarray(grasps.contacts.active), 2] = -PRESS
    # Each joint has one actuator, in the same order.
    efforts = np.asarray(grasps.actuation.joint_torques(forces))
    squeeze, idle = (np.asarray(hand.controls(grasps, share * efforts)) for share in (1.0, 0.0))
    return qpos, squeeze, idle


@pytest.fixture(scope="module")
def trials(hand, grasp) -> Trials:
    """Squeezed; not squeezed; no configuration; no commands; pushed too hard; squeezed once more."""
    qpos, squeeze, idle = grasp
    configurations = np.tile(qpos, (6, 1))
    configurations[2, 0] = np.nan
    commands = np.array([squeeze, idle, squeeze, np.full_like(idle, np.nan), squeeze, squeeze])
    return hold_trials(hand, configurations, commands, push=np.where(np.arange(6) == 4, FAR_BEYOND, PUSH))


def test_a_robust_grasp_holds_and_others_do_not(trials):
    np.testing.assert_array_equal(trials.held, [True, False, False, False, False, True])
    np.testing.assert_array_equal(trials.held_gravity, [True, False, False, False, True, True])
    assert trials.held_pushes[0].all()
    assert not trials.held_pushes[[1, 2, 3]].any()
    np.testing.assert_array_equal(trials.push[[0, 4]], [PUSH, FAR_BEYOND])


def test_the_object_moves_where_it_is_pushed(hand, trials):
    ball = hand.model.jnt_qposadr[hand.model.body("object").jntadr[0]]
    ends = trials.qpos[0, :, ball : ball + 3]
    along = ((ends[1:] - ends[0]) * DIRECTIONS).sum(-1)
    assert (along > 1e-4).all()
    assert (along < 0.02).all()
    np.testing.assert_array_equal(trials.touching[0], 4)
    # Without a squeeze the ball falls on the palm.
    assert trials.displacement[1, 0] > 0.05
    assert np.isnan(trials.displacement[1, 1:]).all()
    assert np.isnan(trials.qpos[[2, 3]]).all()


def test_rows_do_not_know_of_each_other(hand, grasp, trials):
    qpos, squeeze, _ = grasp
    done = []
    alone = hold_trials(hand, qpos[None], squeeze[None], push=PUSH, progress=done.append)
    assert done == [1]
    for row in (0, 5):
        np.testing.assert_array_equal(trials.qpos[row], alone.qpos[0])


def test_divergence_is_a_loss_and_leaves_no_file(hand, grasp, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    qpos, squeeze, _ = grasp
    before = mujoco.get_mju_user_warning()
    found = hold_trials(hand, np.tile(qpos, (2, 1)), np.tile(squeeze, (2, 1)), push=[1e15, 1.0])
    np.testing.assert_array_equal(found.held_gravity, True)
    np.testing.assert_array_equal(found.held, [False, True])
    assert np.isnan(found.displacement[0, 1:]).all()
    assert list(tmp_path.iterdir()) == []
    assert mujoco.get_mju_user_warning() is before


def test_the_push_is_the_weight_unless_told(hand):
    none = hold_trials(hand, np.zeros((0, hand.nq)), np.zeros((0, len(hand.actuators))))
    assert none.held.shape == (0,)
    nan = hold_trials(hand, np.full((1, hand.nq), np.nan), np.zeros((1, len(hand.actuators))))
    np.testing.assert_allclose(nan.push, hand.object_mass * 9.81)


def test_a_free_base_stays_where_the_configuration_has_it(grasp):
    qpos, squeeze, _ = grasp
    spec = four_fingers("sphere")
    spec.body("palm").add_freejoint(name="base")
    spec.add_equality(type=mujoco.mjtEq.mjEQ_WELD, objtype=mujoco.mjtObj.mjOBJ_BODY, name1="palm", name2="world")
    hand = HandObject.from_mjcf(spec, "object")
    # The whole scene is lifted; the weld of the base would pull it back.
    lifted = np.concatenate([[0, 0, 0.1, 1, 0, 0, 0], qpos])
    lifted[-5] += 0.1
    found = hold_trials(hand, lifted[None], squeeze[None])
    assert found.held[0]
    np.testing.assert_allclose(found.qpos[0, :, :7], np.tile(lifted[:7], (7, 1)), atol=ANCHORED)


def changed(change) -> HandObject:
    spec = four_fingers("sphere")
    change(spec)
    return HandObject.from_mjcf(spec, "object")


def fix(spec: mujoco.MjSpec) -> None:
    spec.delete(spec.joint("object"))


def weld(spec: mujoco.MjSpec) -> None:
    spec.add_equality(type=mujoco.mjtEq.mjEQ_WELD, objtype=mujoco.mjtObj.mjOBJ_BODY, name1="object", name2="world")


def integrate(spec: mujoco.MjSpec) -> None:
    spec.actuator("f1_base").dyntype = mujoco.mjtDyn.mjDYN_INTEGRATOR


@pytest.mark.parametrize(
    ("change", "message"),
    [(fix, "no free joint"), (weld, "welded"), (integrate, "'f1_base' integrate")],
)
def test_scenes_without_a_free_object_are_refused(change, message):
    hand = changed(change)
    with pytest.raises(ValueError, match=message):
        hold_trials(hand, np.zeros((1, hand.nq)), np.zeros((1, len(hand.actuators))))


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"qpos": np.zeros((2, 18))}, r"qpos: got shape \(2, 18\)"),
        ({"qpos": np.zeros(19)}, "qpos: got shape"),
        ({"controls": np.zeros((1, 12))}, r"controls: got shape \(1, 12\), wanted \(2, 12\)"),
        ({"push": [1.0, 2.0, 3.0]}, r"push: got shape \(3,\)"),
        ({"push": -1.0}, "push: wanted finite positive"),
        ({"push": np.nan}, "push: wanted finite positive"),
    ],
)
def test_what_does_not_fit_is_refused(hand, given, message):
    with pytest.raises(ValueError, match=message):
        hold_trials(hand, **({"qpos": np.zeros((2, 19)), "controls": np.zeros((2, 12))} | given))


def test_pushes_must_be_given_where_nothing_has_weight():
    hand = changed(lambda spec: setattr(spec.option, "gravity", np.zeros(3)))
    with pytest.raises(ValueError, match="push: got None"):
        hold_trials(hand, np.zeros((1, hand.nq)), np.zeros((1, len(hand.actuators))))


def test_joints_with_dry_friction_hold_too(grasp):
    spec = four_fingers("sphere")
    for joint in spec.joints:
        if joint.type == mujoco.mjtJoint.mjJNT_HINGE:
            joint.frictionloss = 0.01
    rough = HandObject.from_mjcf(spec, "object", contact_distance=1e-3)
    qpos, squeeze, _ = grasp
    assert hold_trials(rough, qpos[None], squeeze[None], push=PUSH).held.all()
