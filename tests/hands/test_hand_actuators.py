"""Transmission, limits, commands and stiffness of actuators, against C MuJoCo; margins of hands, against HiGHS."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import hand_models
import jax
import mujoco
import numpy as np
import pytest
from hand_configurations import case
from oracles import actuated_rows, largest_actuated

import jaxgrasp as jg
from jaxgrasp.hands import HandGrasps, HandObject

EXACT = 1e-9
# As in the tests of actuation alone: the gap to which margins are certified is 1e-8 of max(1, margin / scale).
MARGIN = 2e-8
COUNT = 20
WRENCHES = np.concatenate([np.eye(6)[:3], -np.eye(6)[:3]])

KINDS = """
<tendon>
  <fixed name="both"><joint joint="b" coef="1"/><joint joint="c" coef="-0.5"/></fixed>
</tendon>
<actuator>
  <motor name="motor" joint="a" gear="-2" ctrlrange="-1 0.5"/>
  <general name="affine" joint="a" gear="1.5" gainprm="2" biastype="affine" biasprm="0.3 -1.5 -0.2" ctrlrange="0 2"/>
  <position name="servo" joint="b" kp="3" kv="0.1" ctrlrange="-1 1" forcerange="-2 1.5"/>
  <position name="tendon" tendon="both" gear="0.7" kp="4" ctrlrange="-0.2 0.4"/>
  <general name="own" joint="c" gainprm="-1.2" ctrlrange="-1 2"/>
  <intvelocity name="integrated" joint="c" kp="2" actrange="-0.3 0.6"/>
  <position name="endless" jointinparent="b" kp="1"/>
  <motor name="limited" joint="d" gear="-3" ctrlrange="-5 5"/>
</actuator>"""
LIMITED = 'name="d" type="slide" actuatorfrcrange="-1 2"'
SPATIAL = """
<tendon>
  <spatial name="over"><site site="s0"/><geom geom="pulley"/><site site="s2"/></spatial>
  <spatial name="along"><site site="s1"/><site site="s2"/><site site="s3"/></spatial>
</tendon>
<actuator>
  <position name="over" tendon="over" kp="300" forcerange="-20 0"/>
  <motor name="along" tendon="along" gear="2" ctrlrange="-3 1"/>
  <position name="b" joint="b" kp="2" ctrlrange="-1 1"/>
</actuator>"""
COUPLED = """
<equality>
  <joint joint1="d" joint2="c" polycoef="0.001 0.01 0.02 0 0.003"/>
  <joint joint1="c" joint2="b" polycoef="0.1 0.5 0.3 -0.2 0"/>
  <joint joint1="a" polycoef="0.2 0 0 0 0"/>
</equality>
<actuator>
  <position name="b" joint="b" kp="2" ctrlrange="-1 1"/>
  <position name="c" joint="c" kp="3" ctrlrange="-1 1"/>
</actuator>"""


@cache
def small(kind: str, engine: str = "distance") -> tuple[HandObject, np.ndarray, HandGrasps]:
    rest = {"kinds": KINDS, "spatial": SPATIAL, "coupled": COUPLED}[kind]
    links = hand_models.FINGER.replace('name="d" type="slide"', LIMITED)
    model = hand_models.finger(rest, links=links if kind == "kinds" else hand_models.FINGER)
    hand = HandObject.from_mjcf(model, "object", max_contacts=4, points_per_link=None, unreached="free")
    qpos = hand_models.random_configurations(model, COUNT)
    return hand, qpos, jax.tree.map(np.asarray, hand.grasps(qpos, engine))


def scene(kind: str) -> tuple[HandObject, np.ndarray, HandGrasps]:
    if kind != "shadow_hand":
        return small(*kind.split())
    this = case("shadow_hand", "sphere")
    return this.hand, this.qpos[:COUNT], jax.tree.map(lambda x: x[:COUNT], this.grasps)


def commanded(model: mujoco.MjModel, numbers: np.ndarray, qpos: np.ndarray, commands: np.ndarray) -> mujoco.MjData:
    """C at rest with commands, in the activations of actuators that have these."""
    data = mujoco.MjData(model)
    data.qpos = qpos
    data.ctrl[numbers] = commands
    for number in numbers:
        if model.actuator_actnum[number]:
            data.act[model.actuator_actadr[number]] = data.ctrl[number]
    mujoco.mj_forward(model, data)
    return data


def moments_of(data: mujoco.MjData) -> tuple[np.ndarray, ...]:
    return data.actuator_moment, data.moment_rownnz, data.moment_rowadr, data.moment_colind


MODELS = ["kinds mujoco", "spatial mujoco", "coupled mujoco"]
MODELS += [pytest.param(kind, marks=pytest.mark.thorough) for kind in ("kinds", "spatial", "shadow_hand")]


def limits_of(hand: HandObject, grasps: HandGrasps) -> tuple[np.ndarray, np.ndarray]:
    """Of the actuators alone, without springs."""
    ends = (grasps.actuation.lower, grasps.actuation.upper)
    return tuple(np.array(hand.actuator_efforts(grasps, end)) for end in ends)


def coupling(hand: HandObject, qpos: np.ndarray) -> np.ndarray:
    return np.asarray(hand.couplings.velocities(qpos[hand.model.jnt_qposadr[hand.joints]], np))


@pytest.mark.parametrize("kind", MODELS)
def test_efforts_and_commands_are_those_of_mujoco(kind):
    hand, qpos, grasps = scene(kind)
    model, numbers = hand.model, [hand.model.actuator(name).id for name in hand.actuator_names]
    assert sorted(numbers) == list(range(model.nu))
    rng = np.random.default_rng(4)
    lower, upper = limits_of(hand, grasps)
    assert np.all(lower < upper)
    own = rng.uniform(np.maximum(lower, -5), np.minimum(upper, 5))
    efforts = np.array(grasps.spring_efforts)
    efforts[:, : len(numbers)] += own
    commands = np.asarray(hand.controls(grasps, efforts))
    assert np.isfinite(commands).all()
    for lane in range(COUNT):
        B, T = grasps.actuation.transmission[lane], coupling(hand, qpos[lane])
        data = commanded(model, numbers, qpos[lane], commands[lane])
        moment = np.zeros((model.nu, model.nv))
        mujoco.mju_sparse2dense(moment, *moments_of(data))
        np.testing.assert_allclose(B[:, : len(numbers)], T.T @ moment[np.ix_(numbers, hand.dofs)].T, atol=EXACT)
        np.testing.assert_allclose(grasps.actuator_lengths[lane], data.actuator_length[numbers], atol=EXACT)
        np.testing.assert_allclose(data.actuator_force[numbers], own[lane], atol=EXACT)
        # What joints bear by themselves is among the efforts: the springs' torques.
        np.testing.assert_allclose(grasps.spring_torques[lane], T.T @ data.qfrc_spring[hand.dofs], atol=EXACT)
        every = np.where(np.arange(B.shape[1]) < len(numbers), efforts[lane], grasps.actuation.lower[lane])
        if not np.isfinite(every).all() or B.shape[1] == len(numbers):
            every = efforts[lane]
        reached = B @ np.linalg.pinv(B)
        wanted = T.T @ (data.qfrc_actuator + data.qfrc_spring)[hand.dofs]
        np.testing.assert_allclose(reached @ wanted, B @ every, atol=EXACT)


@pytest.mark.parametrize("kind", MODELS)
def test_limits_are_those_of_mujoco(kind):
    hand, qpos, grasps = scene(kind)
    model, numbers = hand.model, [hand.model.actuator(name).id for name in hand.actuator_names]
    lower, upper = limits_of(hand, grasps)
    middle = 0.5 * (np.maximum(lower, -5) + np.minimum(upper, 5))
    efforts = np.array(grasps.spring_efforts)
    efforts[:, : len(numbers)] += middle
    commands = np.asarray(hand.controls(grasps, efforts))
    checked = 0
    for lane in range(5):
        for column, number in enumerate(numbers):
            reached = []
            for command in (-1e7, 1e7):
                ctrl = commands[lane].copy()
                # Activations are limited where they are integrated alone.
                stateful = model.actuator_actnum[number] > 0
                ctrl[column] = np.clip(command, *model.actuator_actrange[number]) if stateful else command
                torque = commanded(model, numbers, qpos[lane], ctrl).qfrc_actuator[hand.dofs]
                reached.append(coupling(hand, qpos[lane]).T @ torque)
            ends = []
            for limit in (lower, upper):
                u = middle[lane].copy()
                u[column] = limit[lane, column]
                if np.isfinite(u).all():
                    ends.append(grasps.actuation.transmission[lane][:, : len(numbers)] @ u)
                else:
                    assert max(np.abs(r).max() for r in reached) > 1e6
            checked += len(ends)
            for end in ends:
                assert min(np.abs(end - r).max() for r in reached) < EXACT
    assert checked >= 1.5 * 5 * len(numbers)


def test_coupled_joints_move_as_in_mujoco():
    hand, qpos, grasps = small("coupled")
    model = hand.model
    assert hand.joint_names == ("b",)
    moved = np.asarray(hand.couplings.velocities(qpos[:, model.jnt_qposadr[hand.joints]]))
    data = mujoco.MjData(model)
    for lane in range(COUNT):
        # On the constraints, where C linearises them.
        data.qpos = qpos[lane]
        mujoco.mj_fwdPosition(model, data)
        rows = data.efc_J.reshape(-1, model.nv)[data.efc_type == int(mujoco.mjtConstraint.mjCNSTR_EQUALITY)]
        assert len(rows) == 3
        T = moved[lane]
        np.testing.assert_allclose(rows[:, hand.dofs] @ T, 0, atol=EXACT)
        np.testing.assert_allclose(T[1], 1)
        B = np.zeros((model.nu, model.nv))
        mujoco.mju_sparse2dense(B, *moments_of(data))
        np.testing.assert_allclose(grasps.actuation.transmission[lane], T.T @ B[:, hand.dofs].T, atol=EXACT)
        springs = np.diag(model.jnt_stiffness[hand.joints])
        gains = B.T[hand.dofs] @ np.diag([2.0, 3.0]) @ B[:, hand.dofs]
        np.testing.assert_allclose(grasps.joint_stiffness[lane], T.T @ (springs + gains) @ T, atol=EXACT)
        # The first joint follows nobody: it stands still.
        point = grasps.object_rotation[lane] @ grasps.contacts.positions[lane].T + grasps.object_position[lane][:, None]
        for slot in range(4):
            jacobian = np.zeros((3, model.nv))
            mujoco.mj_jac(model, data, jacobian, None, point[:, slot], grasps.links[lane, slot])
            frame = grasps.object_rotation[lane] @ grasps.contacts.frames[lane, slot]
            np.testing.assert_allclose(
                grasps.actuation.jacobian[lane, slot], frame.T @ jacobian[:, hand.dofs] @ T, atol=EXACT
            )


@pytest.mark.thorough
def test_compliance_is_that_of_servos_and_tips():
    hand, _, grasps = scene("shadow_hand")
    found = np.asarray(hand.compliance(grasps, 2000.0))
    assert found.shape == (COUNT, *[3 * grasps.distances.shape[-1]] * 2)
    for lane in range(COUNT):
        B = grasps.actuation.transmission[lane]
        gains = [hand.model.actuator(name).gainprm[0] for name in hand.actuator_names]
        stiffness = B @ np.diag(gains) @ B.T + np.diag(hand.model.jnt_stiffness[hand.joints])
        np.testing.assert_allclose(grasps.joint_stiffness[lane], stiffness, atol=EXACT)
        J = grasps.actuation.jacobian[lane].reshape(-1, len(hand.dofs))
        wanted = J @ np.linalg.pinv(stiffness, 1e-9) @ J.T + np.eye(len(J)) / 2000.0
        np.testing.assert_allclose(found[lane], wanted, atol=EXACT)
    one = hand.compliance(grasps, np.full(grasps.distances.shape, 2000.0))
    np.testing.assert_allclose(one, found, atol=1e-15)


def test_compliance_needs_stiffness():
    hand, _, grasps = small("kinds")
    with pytest.raises(ValueError, match=r"actuators 'motor'.*no stiffness.*wanted position servos"):
        hand.compliance(grasps, 1000.0)


PUSHES = jg.DisturbanceSet.forces(1.0)
SLOTS, LANES = 6, 30


def held(scene: str) -> tuple[jg.Contacts, jg.Actuation, jax.Array]:
    """Grasps with three contacts or more, of which few are cut off."""
    grasps = case(scene, "sphere").grasps
    links = [len(set(row[:n])) for row, n in zip(grasps.links.tolist(), grasps.touching, strict=True)]
    chosen = np.flatnonzero((np.array(links) >= 3) & (grasps.touching <= SLOTS))[:LANES]
    assert len(chosen) == LANES
    grasps = jax.tree.map(lambda x: x[chosen], grasps)
    contacts = jax.tree.map(lambda x: x[:, :SLOTS], grasps.contacts)
    return contacts, replace(grasps.actuation, jacobian=grasps.actuation.jacobian[:, :SLOTS]), grasps.required_wrench


margins = jax.jit(lambda c, a, w: jg.largest_disturbance(c, PUSHES, actuation=a, required_wrench=w))


@pytest.mark.thorough
def test_margins_of_coupled_fingers_against_highs():
    contacts, actuation, weight = held("shadow_hand")
    found = margins(contacts, actuation, weight)
    truth, reachable = np.zeros(LANES), np.zeros(LANES, bool)
    for lane in range(LANES):
        there = contacts.active[lane]
        own = jax.tree.map(lambda x: x[lane], actuation)  # noqa: B023
        hand = {name: getattr(own, name) for name in ("transmission", "lower", "upper")}
        hand["jacobian"] = own.jacobian[there]
        G = np.asarray(jg.grasp_map(contacts))[lane][:, np.repeat(there, 3)]
        left, values, _ = np.linalg.svd(own.transmission)
        torques = left[:, np.sum(values > 1e-9) :].T @ hand["jacobian"].reshape(-1, 24).T
        stacked = np.vstack([G / np.array([1, 1, 1, 0.03, 0.03, 0.03])[:, None], torques / 0.03])
        answer = np.linalg.pinv(stacked, 1e-9)[:, :3]
        reachable[lane] = np.abs(stacked @ answer - np.eye(len(stacked))[:, :3]).max() < 1e-9
        rows = actuated_rows(
            G, contacts.friction[lane][there], contacts.max_force[lane][there], hand, WRENCHES, weight[lane]
        )
        truth[lane] = largest_actuated(*rows)
    print(np.c_[reachable, truth, found.margin, found.status, contacts.active.sum(-1)])
    counted = reachable & np.isfinite(truth)
    assert counted.sum() >= 0.8 * LANES
    # Disturbances that nothing answers leave no margin.
    assert np.all(np.asarray(found.margin)[~reachable & np.isfinite(truth)] <= 0)
    wrong = np.abs(found.margin - truth) > MARGIN * np.maximum(10, np.abs(truth))
    assert not wrong[counted].any()
    torque = actuation.joint_torques(found.forces)
    efforts = np.einsum("nvu,nu->nv", actuation.transmission, found.actuator_efforts)
    np.testing.assert_allclose(torque[counted], efforts[counted], atol=1e-9)


@pytest.mark.thorough
def test_limits_without_end_and_halved():
    contacts, actuation, weight = held("four_fingers")
    none = np.zeros_like(weight)
    plain = jax.jit(lambda c, w: jg.largest_disturbance(c, PUSHES, required_wrench=w))(contacts, weight)
    endless = replace(
        actuation, lower=np.full_like(actuation.lower, -np.inf), upper=np.full_like(actuation.upper, np.inf)
    )
    free = margins(contacts, endless, weight)
    np.testing.assert_allclose(free.margin, plain.margin, rtol=1e-7, atol=1e-7)
    bound = margins(contacts, actuation, weight)
    tighter = np.asarray(bound.margin < free.margin - 1e-3)
    assert np.all(bound.margin <= free.margin + 1e-7) and tighter.sum() >= LANES // 3
    whole = margins(contacts, actuation, none)
    half = replace(actuation, lower=0.5 * actuation.lower, upper=0.5 * actuation.upper)
    halved = margins(replace(contacts, max_force=0.5 * contacts.max_force), half, none)
    np.testing.assert_allclose(halved.margin, 0.5 * whole.margin, rtol=1e-7, atol=1e-8)
    assert np.sum(whole.margin > 0.01) >= LANES // 2
