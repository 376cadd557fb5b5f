"""What joints bear by themselves, contact parameters and bodies that are no hand, each against C MuJoCo's statics."""

from __future__ import annotations

import re
from dataclasses import replace

import jax
import mujoco
import numpy as np
import pytest
from oracles import actuated_rows, largest_actuated

import jaxgrasp as jg
from jaxgrasp.hands import HandObject

PUSHES = jg.DisturbanceSet.forces(1.0)
OPTION = '<option cone="elliptic" impratio="100" timestep="0.001" gravity="0 0 {gravity}"/>'

STIFF = 'solref="0.002 1" solimp="0.99 0.99 0.001"'


def four_pads(joint="", tendon="", rest="", pad="", cube="", gravity=-9.81, actuators=4, slide=True, more="") -> str:
    """Four pads on slides, 2 cm in, that touch the sides of a cube of 6 cm and 0.1 kg; `pad` may be one for each."""
    every = [pad] * 4 if isinstance(pad, str) else pad
    pads = motors = tendons = ""
    for k, (x, y) in enumerate([(1, 0), (-1, 0), (0, 1), (0, -1)]):
        joints = f'<joint name="j{k}" type="slide" axis="{-x} {-y} 0" damping="5" {joint}/>' if slide else ""
        at = 0.065 if slide else 0.045
        pads += (
            f'<body name="f{k}" pos="{at * x} {at * y} 0" gravcomp="1">{joints}'
            f'<geom name="g{k}" type="sphere" size="0.015" mass="0.05" {STIFF} {every[k]}/></body>'
        )
        motors += f'<motor name="m{k}" joint="j{k}" ctrlrange="-5 5"/>' if k < actuators and slide else ""
        tendons += f'<fixed name="t{k}" {tendon}><joint joint="j{k}" coef="1"/></fixed>' if tendon else ""
    return (
        f'<mujoco>{OPTION.format(gravity=gravity)}<worldbody>{more}{pads}<body name="object"><freejoint/>'
        f'<geom name="cube" type="box" size="0.03 0.03 0.03" mass="0.1" {STIFF} {cube}/></body></worldbody>'
        f"<tendon>{tendons}</tendon><actuator>{motors}</actuator>{rest}</mujoco>"
    )


def closed(model: mujoco.MjModel) -> np.ndarray:
    qpos = model.qpos0.copy()
    qpos[model.jnt_qposadr[model.jnt_type == mujoco.mjtJoint.mjJNT_SLIDE]] = 0.02
    return qpos


def grasped(xml: str, **options):
    model = mujoco.MjModel.from_xml_string(xml)
    hand = HandObject.from_mjcf(model, "object", **options)
    return hand, hand.grasps(closed(model))


def ranked(xml: str, *, weight: bool = True, pushes=PUSHES, **options):
    hand, grasps = grasped(xml, **options)
    load = grasps.required_wrench if weight else None
    found = jg.largest_disturbance(grasps.contacts, pushes, required_wrench=load, actuation=grasps.actuation)
    return hand, grasps, found


def pressed(xml: str, command: float) -> np.ndarray:
    """C's normal forces after two seconds under a command, without gravity."""
    model = mujoco.MjModel.from_xml_string(xml)
    model.opt.gravity[:] = 0
    data, force, found = mujoco.MjData(model), np.zeros(6), np.zeros(4)
    data.qpos, data.ctrl[:] = closed(model), command
    mujoco.mj_step(model, data, 2000)
    for k in range(data.ncon):
        mujoco.mj_contactForce(model, data, k, force)
        found[min(model.geom_bodyid[data.contact.geom[k]].tolist()) - 1] += force[0]
    return found


SPRINGS = {
    "none": ("", ""),
    "opening": ('stiffness="100" springref="0"', ""),
    "too strong": ('stiffness="400" springref="0"', ""),
    "closing": ('stiffness="100" springref="0.04"', ""),
    "tendon": ("", 'stiffness="100" springlength="0 0.001"'),
    "hardening": ('stiffness="0 5000"', ""),
}


@pytest.mark.parametrize("kind", SPRINGS)
def test_springs_decide_how_hard_motors_press(kind):
    joint, tendon = SPRINGS[kind]
    xml = four_pads(joint, tendon)
    hand, grasps, found = ranked(xml, weight=False)
    data = mujoco.MjData(hand.model)
    data.qpos = closed(hand.model)
    mujoco.mj_forward(hand.model, data)
    own = data.qfrc_spring[hand.dofs]
    np.testing.assert_allclose(grasps.spring_torques, own, atol=1e-12)
    # Pads push along their slides: of f_max = 10 N the motors' 5 N and the springs leave this.
    most = np.asarray(grasps.actuation.upper)
    np.testing.assert_allclose(most, 5 + own)
    reached = pressed(xml, 5.0)
    if kind == "too strong":
        assert reached.max() == 0 and not found.margin > 0
        return
    # Contacts give by a fraction of a millimetre, in which a spring of 100 N/m changes by some hundredths of a newton.
    np.testing.assert_allclose(reached, most, atol=0.2)
    free = ranked(four_pads(), weight=False)[-1].margin
    np.testing.assert_allclose(found.margin, free * most[0] / 5, rtol=1e-6)
    effort = jg.least_effort(grasps.contacts, PUSHES, 0.5 * found.margin, actuation=grasps.actuation)
    command = np.asarray(hand.controls(grasps, effort.actuator_efforts))
    forces = -np.asarray(effort.forces)[np.argsort(np.asarray(grasps.links)), 2]
    np.testing.assert_allclose(pressed(xml, command[0]), forces, atol=0.2)


def test_engines_agree_on_springs():
    hand, grasps = grasped(four_pads('stiffness="100 5000" springref="0.04"', SPRINGS["tendon"][1]))
    other = hand.grasps(closed(hand.model), "distance")
    np.testing.assert_allclose(other.spring_torques, grasps.spring_torques, atol=1e-12)
    np.testing.assert_allclose(other.actuation.upper, grasps.actuation.upper, atol=1e-9)


def held(xml: str) -> bool:
    """Whether C keeps the cube within 5 mm for a second under its weight, without any command."""
    model = mujoco.MjModel.from_xml_string(xml)
    data = mujoco.MjData(model)
    data.qpos = closed(model)
    mujoco.mj_step(model, data, 1000)
    return bool(np.linalg.norm(data.body("object").xpos) < 0.005)


@pytest.mark.parametrize(
    ("joint", "holds"),
    [
        ("", False),
        ('stiffness="200" springref="0.03"', True),
        ('stiffness="10" springref="0.03"', False),
    ],
)
def test_only_springs_decide(joint, holds):
    """Without actuators pads hold the cube, by friction 1, where 4 x 2 N of their springs are above its 0.98 N."""
    # The cube is a little wider than it was, so that soft contacts press with what the springs give.
    xml = four_pads(joint, actuators=0)
    _, grasps, found = ranked(xml, unreached="free" if joint else "held")
    if not joint:
        # Nothing acts: whether joints that nothing drives bear anything is then what `unreached` says.
        assert grasps.actuation is None and found.status == jg.Status.SOLVED
    else:
        assert (found.status == jg.Status.SOLVED) == holds
    assert held(xml) == holds


@pytest.mark.parametrize(("friction", "holds"), [("1", True), ("0.1", False)])
def test_only_dry_friction_decides(friction, holds):
    """One motor presses a cube against a pad that nothing but dry friction keeps from giving way."""
    # Softer, MuJoCo's friction creeps.
    xml = wedge(f'frictionloss="{friction}" solimpfriction="0.9999 0.9999 0.001"')
    found = ranked(xml, weight=False, pushes=SIDEWAYS, unreached="free")[-1]
    assert (found.status == jg.Status.SOLVED and found.margin > 0.1) == holds
    assert stays(xml, 0.8) == holds


@pytest.mark.parametrize(("limit", "holds"), [('range="-0.02 0.02" limited="true"', True), ("", False)])
def test_only_a_stop_decides(limit, holds):
    """The pad leans back on the end of its range, or gives way."""
    xml = wedge(limit)
    _, _, found = ranked(xml, weight=False, pushes=SIDEWAYS, unreached="free")
    assert (found.status == jg.Status.SOLVED and found.margin > 0.1) == holds
    assert stays(xml, 0.8) == holds


SIDEWAYS = jg.DisturbanceSet.vertices(np.eye(6)[[2]])


def wedge(joint: str) -> str:
    """A motor's pad presses a cube along x against a passive one, whose slide is at the upper end of its range."""
    return (
        f'<mujoco><option cone="elliptic" impratio="100" timestep="0.001" gravity="0 0 0"/><worldbody>'
        '<body name="a" pos="-0.065 0 0"><joint name="a" type="slide" axis="1 0 0" damping="5"/>'
        '<geom type="sphere" size="0.015" mass="0.05"/></body>'
        f'<body name="b" pos="0.025 0 0"><joint name="b" type="slide" axis="1 0 0" damping="5" {joint}/>'
        '<geom type="sphere" size="0.015" mass="0.05"/></body>'
        '<body name="object"><freejoint/><geom type="box" size="0.03 0.03 0.03" mass="0.1"/></body></worldbody>'
        '<actuator><motor name="a" joint="a" ctrlrange="0.8 5"/></actuator></mujoco>'
    )


def stays(xml: str, command: float) -> bool:
    model = mujoco.MjModel.from_xml_string(xml)
    data = mujoco.MjData(model)
    data.qpos, data.ctrl[:] = closed(model), command
    mujoco.mj_step(model, data, 1000)
    return bool(np.linalg.norm(data.body("object").xpos) < 0.005)


def test_gravity_compensation_of_the_object_and_gravity_that_is_off():
    weight = grasped(four_pads())[1].required_wrench
    np.testing.assert_allclose(weight, [0, 0, 0.981, 0, 0, 0], atol=1e-12)
    half = four_pads().replace('<body name="object">', '<body name="object" gravcomp="0.5">')
    np.testing.assert_allclose(grasped(half)[1].required_wrench, 0.5 * weight, atol=1e-12)
    off = four_pads().replace("<worldbody>", '<option><flag gravity="disable"/></option><worldbody>')
    assert not np.any(grasped(off)[1].required_wrench)


@pytest.mark.parametrize(
    ("pad", "cube", "rest", "friction"),
    [
        ('condim="1"', 'condim="1"', "", 0.0),
        ('condim="1" priority="1"', 'condim="3"', "", 0.0),
        ('condim="1"', 'condim="3"', "", 1.0),
        ('friction="0.3"', 'friction="0.7"', "", 0.7),
        ('friction="0.3" priority="2"', 'friction="0.7"', "", 0.3),
        ("", "", '<contact><pair geom1="g0" geom2="cube" condim="1"/></contact>', 0.0),
        ("", "", '<contact><pair geom1="g0" geom2="cube" friction="0.2 0.2 0 0 0"/></contact>', 0.2),
        ("", "", '<option o_friction="0.3 0.3 0 0 0"><flag override="enable"/></option>', 0.3),
        ('condim="1"', 'condim="1"', '<option o_friction="0.3 0.3 0 0 0"><flag override="enable"/></option>', 0.0),
    ],
)
def test_friction_and_dimension_are_combined_as_in_mujoco(pad, cube, rest, friction):
    model = mujoco.MjModel.from_xml_string(four_pads(pad=pad, cube=cube, rest=rest))
    hand, data = HandObject.from_mjcf(model, "object"), mujoco.MjData(model)
    qpos = closed(model)
    qpos[: len(hand.joints)] += 1e-4
    grasps = hand.grasps(qpos)
    data.qpos = qpos
    mujoco.mj_forward(model, data)
    theirs = {}
    for contact in data.contact:
        link = min(model.geom_bodyid[contact.geom].tolist())
        theirs[link] = contact.friction[0] if contact.dim > 1 else 0.0
    ours = dict(zip(np.asarray(grasps.links).tolist(), np.asarray(grasps.contacts.friction).tolist(), strict=True))
    assert ours == theirs and ours[1] == friction
    # Those of engine "distance" are known before it is compiled.
    assert dict(zip(hand.slot_links.tolist(), hand.slot_friction.tolist(), strict=True)) == ours


@pytest.mark.parametrize(
    ("pad", "cube", "rest", "gamma"),
    [
        ('condim="4" friction="0.5 0.02 0"', 'friction="0.7 0.01 0"', "", 0.02),
        ('condim="4" friction="0.5 0.02 0" priority="1"', 'friction="0.7 0.05 0"', "", 0.02),
        ('condim="6"', 'friction="0.7 0.03 0"', "", 0.03),
        ('condim="4"', 'friction="0.7 0.03 0" priority="1"', "", None),
        ("", "", '<contact><pair geom1="g0" geom2="cube" condim="4" friction="0.2 0.2 0.04 0 0"/></contact>', 0.04),
        (
            'condim="4"',
            "",
            '<option o_friction="0.3 0.3 0.015 0 0"><flag override="enable"/></option>',
            0.015,
        ),
    ],
)
@pytest.mark.filterwarnings("ignore:scene. contacts have condim 6")
def test_torsional_friction_is_combined_as_in_mujoco(pad, cube, rest, gamma):
    model = mujoco.MjModel.from_xml_string(four_pads(pad=pad, cube=cube, rest=rest))
    hand, data = HandObject.from_mjcf(model, "object"), mujoco.MjData(model)
    qpos = closed(model)
    qpos[: len(hand.joints)] += 1e-4
    data.qpos = qpos
    mujoco.mj_forward(model, data)
    theirs = {min(model.geom_bodyid[c.geom].tolist()): c.friction[2] if c.dim > 3 else 0.0 for c in data.contact}
    for engine in ("mujoco", "distance"):
        grasps = hand.grasps(qpos, engine)
        if gamma is None:
            assert grasps.contacts.torsional_friction is None and grasps.actuation.jacobian.shape[-2] == 3
            continue
        found = np.asarray(grasps.contacts.torsional_friction).tolist()
        ours = dict(zip(np.asarray(grasps.links).tolist(), found, strict=True))
        assert ours == pytest.approx(theirs, rel=1e-6) and ours[1] == pytest.approx(gamma, rel=1e-6)


@pytest.mark.parametrize("engine", ["mujoco", "distance"])
def test_joints_turn_soft_contacts_as_in_mujoco(engine):
    """Fingers that turn about the normals at their tips, against MuJoCo's Jacobians; torques are those of both."""
    hinge = r'\g<0><joint name="h\1" type="hinge" axis="1 2 3"/>'
    xml = re.sub(r'<body name="f(\d)" [^>]*>', hinge, four_pads(pad='condim="4"', cube='friction="0.7 0.03 0"'))
    model = mujoco.MjModel.from_xml_string(xml)
    hand, data = HandObject.from_mjcf(model, "object"), mujoco.MjData(model)
    qpos = model.qpos0.copy()
    for k in range(4):
        qpos[model.jnt_qposadr[model.joint(f"j{k}").id]] = 0.0201
    grasps = hand.grasps(qpos, engine)
    contacts = grasps.contacts
    data.qpos = qpos
    mujoco.mj_forward(model, data)
    assert contacts.active.sum() == 4
    whole = hand._mechanics.jacobians(
        hand.engine("mujoco").find(qpos[None]),
        np.asarray(grasps.object_position + contacts.positions @ grasps.object_rotation.T)[None],
        hand.moved_bodies[np.asarray(grasps.links)][None],
        np.asarray(contacts.frames)[None],
        np.asarray(grasps.object_rotation)[None],
        True,
        np,
    )[0]
    turn = np.zeros((3, model.nv))
    for row, link in enumerate(np.asarray(grasps.links).tolist()):
        mujoco.mj_jacBody(model, data, None, turn, link)
        normal = np.asarray(grasps.object_rotation @ contacts.frames[row, :, 2])
        np.testing.assert_allclose(whole[row, 3], (normal @ turn)[hand.dofs], atol=1e-6)
        assert np.abs(whole[row, 3]).max() > 0.1
    load = grasps.required_wrench
    moments = jg.DisturbanceSet.vertices(np.array([[0, 0, 0, 0.01, 0, 0], [0, 0, 0, -0.01, 0, 0]]))
    soft = jg.largest_disturbance(contacts, moments, required_wrench=load, actuation=grasps.actuation)
    assert soft.status == jg.Status.SOLVED and grasps.actuation.jacobian.shape[-2] == 4
    torques = grasps.actuation.joint_torques(soft.forces, soft.moments)
    np.testing.assert_allclose(torques, grasps.actuation.transmission @ soft.actuator_efforts, atol=1e-6)
    with pytest.raises(ValueError, match=r"actuation: got a jacobian of shape \(4, 4, .*wanted \(\*batch, 4, 3, n_v\)"):
        hard = replace(contacts, torsional_friction=None)
        jg.largest_disturbance(hard, moments, actuation=grasps.actuation)


@pytest.mark.parametrize(
    ("parts", "holds"),
    [
        ({}, True),
        ({"pad": 'condim="1"', "cube": 'condim="1"'}, False),
        ({"pad": 'condim="1" priority="1"'}, False),
        ({"pad": 'condim="1"'}, True),
        ({"rest": "pairs"}, False),
    ],
)
def test_without_friction_nothing_is_held(parts, holds):
    """Springs press all pads with 2 N; MuJoCo drops the cube where its contacts have condim 1."""
    pairs = "".join(f'<pair geom1="g{k}" geom2="cube" condim="1"/>' for k in range(4))
    parts = {name: f"<contact>{pairs}</contact>" if value == "pairs" else value for name, value in parts.items()}
    xml = four_pads('stiffness="200" springref="0.03"', **parts)
    found = ranked(xml)[-1]
    assert (found.status == jg.Status.SOLVED) == holds and held(xml) == holds


@pytest.mark.parametrize("engine", ["mujoco", "distance"])
def test_margin_and_gap_say_how_far_contacts_push(engine):
    pads = [f'margin="{margin}" gap="{gap}"' for margin, gap in ((0, 0), (0.012, 0), (0, 0.012), (0.008, 0))]
    model = mujoco.MjModel.from_xml_string(four_pads(pad=pads))
    grasps = HandObject.from_mjcf(model, "object").grasps(closed(model) - np.r_[np.full(4, 0.01), np.zeros(7)], engine)
    assert np.asarray(grasps.links)[np.asarray(grasps.contacts.active)].tolist() == [model.body("f1").id]


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"pad": 'condim="6"'}, "rolling friction is left out"),
        ({"rest": '<contact><pair geom1="g0" geom2="cube" friction="{}"/></contact>'}, "'g0' and 'cube'.* 0.2 and 0.4"),
        ({"rest": '<option o_friction="{}"><flag override="enable"/></option>'}, "0.2 and 0.4, of which the smaller"),
    ],
)
@pytest.mark.parametrize("friction", ["0.2 0.4 0 0 0", "0.4 0.2 0 0 0"])
def test_what_is_not_modelled_is_said_once(options, words, friction):
    """Every engine takes the smaller one of two tangential coefficients."""
    options = {name: value.format(friction) for name, value in options.items()}
    with pytest.warns(UserWarning, match=words) as told:
        hand, grasps = grasped(four_pads(**options))
    assert len(told) == 1
    if "rest" in options:
        for found in (grasps, hand.grasps(closed(hand.model), "distance")):
            assert found.contacts.friction[list(found.links).index(1)] == pytest.approx(0.2)


@pytest.mark.parametrize("engine", ["mujoco", "distance"])
def test_margins_of_the_options_say_how_far_contacts_push(engine):
    rest = '<option o_margin="{}"><flag override="enable"/></option>'
    for margin, contacts in ((0.0, 0), (0.012, 4)):
        model = mujoco.MjModel.from_xml_string(four_pads(pad='margin="0.02"', rest=rest.format(margin)))
        qpos = closed(model) - np.r_[np.full(4, 0.01), np.zeros(7)]
        assert HandObject.from_mjcf(model, "object").grasps(qpos, engine).contacts.active.sum() == contacts


def test_many_points_of_one_finger_keep_no_other_finger_out():
    """Two box pads a jaw: 16 points touch; a nanometre decides nothing."""
    jaws = ""
    for name, y in (("left", 1), ("right", -1)):
        boxes = "".join(
            f'<geom type="box" size="0.011 0.01 0.0093" pos="0 0 {z}" mass="0.02" friction="0.7"/>'
            for z in (0.01, -0.01)
        )
        jaws += f'<body name="{name}" pos="0 {0.04 * y} 0">'
        jaws += f'<joint name="{name}" type="slide" axis="0 {-y} 0"/>{boxes}</body>'
    servos = "".join(
        f'<position joint="{n}" kp="2000" ctrlrange="-0.02 0.02" forcerange="-20 20"/>' for n in ("left", "right")
    )
    model = mujoco.MjModel.from_xml_string(
        f'<mujoco><worldbody>{jaws}<body name="object"><freejoint/><geom type="box" size="0.03 0.03 0.03" mass="0.2" '
        f'friction="0.7"/></body></worldbody><actuator>{servos}</actuator></mujoco>'
    )
    offsets = np.array([0.0, 1e-9, 1e-6, 1e-5, 1e-4])
    qpos = np.tile(model.qpos0, (len(offsets), 1))
    qpos[:, 0], qpos[:, 1] = 1e-4 + offsets, 1e-4
    for points, contacts in ((1, 2), (8, 16), (None, 16)):
        hand = HandObject.from_mjcf(model, "object", points_per_link=points)
        grasps = hand.grasps(qpos, "mujoco")
        margins = [independent_margin(jax.tree.map(lambda x: x[k], grasps)) for k in range(len(offsets))]  # noqa: B023
        assert (np.asarray(grasps.contacts.active).sum(-1) == contacts).all() and not grasps.left_out.any()
        np.testing.assert_allclose(margins, margins[0], rtol=1e-3)
        if points != 1:
            # The margin with all 16 points, from an independent run of the same scene.
            np.testing.assert_allclose(margins, 15.3165, atol=2e-3)
    few = HandObject.from_mjcf(model, "object", max_contacts=1).grasps(qpos)
    assert (few.left_out == 1).all() and (few.touching == 2).all()
    some = HandObject.from_mjcf(model, "object", points_per_link=None, max_contacts=8)
    for engine in ("mujoco", "distance"):
        grasps = some.grasps(qpos, engine)
        kept = [[model.body(b).name for b in links] for links in np.asarray(grasps.links)]
        assert all(links.count("left") == links.count("right") == 4 for links in kept)
        assert (grasps.left_out == 8).all() and (np.diff(grasps.distances) >= 0).all()


def independent_margin(grasps) -> float:
    """(21) by HiGHS, of one grasp whose efforts each have a joint of their own."""
    contacts, actuation = grasps.contacts, grasps.actuation
    there = np.flatnonzero(np.asarray(contacts.active))
    frames, arms = np.asarray(contacts.frames)[there], np.asarray(contacts.positions)[there]
    blocks = [np.vstack([R, np.cross(p, R.T).T]) for R, p in zip(frames, arms, strict=True)]
    parts = {name: np.asarray(getattr(actuation, name)) for name in ("jacobian", "transmission", "lower", "upper")}
    parts["jacobian"] = parts["jacobian"][there]
    mu, most = (np.asarray(x)[there] for x in (contacts.friction, contacts.max_force))
    wrenches = np.vstack([np.eye(6)[:3], -np.eye(6)[:3]])
    return largest_actuated(*actuated_rows(np.hstack(blocks), mu, most, parts, wrenches, grasps.required_wrench))


TABLE = '<body name="table" pos="0 0 -0.05"><geom type="box" size="0.3 0.3 0.02"/></body>'
PALM = (
    '<body name="palm" pos="0 0 0.3"><geom type="box" size="0.03 0.03 0.005" pos="0 0 0.1"/><body name="finger" '
    'pos="0 0 -0.255"><joint name="j" type="slide" axis="0 0 -1"/><geom type="sphere" size="0.015"/></body></body>'
)
CUBE = '<body name="object"><freejoint/><geom type="box" size="0.03 0.03 0.03" mass="0.1"/></body>'
FREE = '<body name="base"><freejoint/><geom size="0.01" pos="0 0 1"/><body name="wrist">{}</body></body>'
CLUTTER = '<body name="mug" pos="0 0 0.2"><freejoint/><geom size="0.02"/></body>'


@pytest.mark.parametrize(
    ("bodies", "hand"),
    [
        (TABLE + PALM, {"palm", "finger"}),
        (CLUTTER + TABLE + PALM, {"palm", "finger"}),
        (f'<body name="room">{TABLE}{PALM}</body>', {"room", "palm", "finger"}),
        (TABLE + FREE.format(PALM), {"base", "wrist", "palm", "finger"}),
        (
            TABLE + PALM.replace("palm", "a").replace("finger", "b").replace('"j"', '"k"') + PALM,
            {"a", "b", "palm", "finger"},
        ),
        (TABLE, {"table"}),
    ],
)
def test_environment_is_no_finger(bodies, hand):
    model = mujoco.MjModel.from_xml_string(f"<mujoco><worldbody>{bodies}{CUBE}</worldbody></mujoco>")
    found = HandObject.from_mjcf(model, "object")
    assert {model.body(b).name for b in found.bodies} == hand
    if "room" in hand:
        named = HandObject.from_mjcf(model, "object", hand_body="palm")
        assert {model.body(b).name for b in named.bodies} == {"palm", "finger"}
        less = HandObject.from_mjcf(model, "object", hand_body="room", environment=["table"])
        assert {model.body(b).name for b in less.bodies} == hand


@pytest.mark.parametrize("slide", [True, False])
def test_hands_without_actuators_have_no_torque_rows(slide):
    _, grasps, found = ranked(four_pads(actuators=0, slide=slide))
    assert grasps.actuation is None
    assert found.status == jg.Status.SOLVED and found.margin > 1
    assert grasped(four_pads(actuators=1))[1].actuation.transmission.shape[-1] == 1
