"""Hands whose joints follow each other by equality constraints."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest
from test_passive import PUSHES, closed, four_pads, independent_margin, ranked

import jaxgrasp as jg
from jaxgrasp.hands import HandObject, Scene

COUPLED = {
    "linear": '<equality><joint joint1="j1" joint2="j0" polycoef="0 1 0 0 0"/></equality>',
    "pinned": '<equality><joint joint1="j1" polycoef="0.02 0 0 0 0"/></equality>',
    "chain": '<equality><joint joint1="j3" polycoef="0.02 0 0 0 0"/>'
    '<joint joint1="j2" joint2="j1" polycoef="0 1 0 0 0"/>'
    '<joint joint1="j1" joint2="j0" polycoef="0.01 0.5 0 0 0"/></equality>',
}


@pytest.mark.parametrize(("kind", "engine"), [*((kind, "mujoco") for kind in COUPLED), ("chain", "distance")])
def test_linear_couplings(kind, engine):
    """The same as with a vanishing quadratic term, which takes the way of couplings that vary."""
    found = []
    for xml in (four_pads(rest=COUPLED[kind]), four_pads(rest=COUPLED[kind].replace(" 0 0 0", " 1e-12 0 0"))):
        model = mujoco.MjModel.from_xml_string(xml)
        found.append(HandObject.from_mjcf(model, "object").grasps(closed(model), engine))
    for name in ("jacobian", "transmission", "inverse", "lower", "upper"):
        one, other = (np.asarray(getattr(grasps.actuation, name)) for grasps in found)
        np.testing.assert_allclose(one, other, atol=1e-9)


@pytest.mark.parametrize("kind", ["linear", "pinned"])
def test_margins_of_coupled_hands(kind):
    """An actuator whose joint is pinned acts on nothing."""
    _, grasps, found = ranked(four_pads(rest=COUPLED[kind]))
    assert found.status == jg.Status.SOLVED
    np.testing.assert_allclose(found.margin, independent_margin(grasps), rtol=1e-6)


def test_a_gripper_whose_slides_are_coupled():
    """One actuator on the mean of two slides; the two pads of each jaw share what it exerts."""
    jaws = ""
    for name, y, pads in (("left", 1, ("0 0 .015", "0 0 -.015")), ("right", -1, (".015 0 0", "-.015 0 0"))):
        spheres = "".join(f'<geom size="0.01" pos="{at}" mass="0.05" friction="0.8"/>' for at in pads)
        jaws += (
            f'<body pos="0 {0.05 * y} 0"><joint name="{name}" type="slide" axis="0 {-y} 0" range="0 0.025"/>{spheres}'
        )
        jaws += "</body>"
    model = mujoco.MjModel.from_xml_string(
        f'<mujoco><worldbody><body name="palm">{jaws}</body><body name="object"><freejoint/><geom type="box" '
        'size="0.025 0.025 0.025" mass="0.2" friction="0.8"/></body></worldbody><tendon><fixed name="mean"><joint '
        'joint="left" coef="0.5"/><joint joint="right" coef="0.5"/></fixed></tendon><equality><joint joint1="right" '
        'joint2="left"/></equality><actuator><general tendon="mean" gainprm="0.392156863" biastype="affine" '
        'biasprm="0 -4000 -40" ctrlrange="0 255" forcerange="-60 60"/></actuator></mujoco>'
    )
    hand = HandObject.from_mjcf(model, "object", points_per_link=None)
    grasps = hand.grasps(np.r_[0.015, 0.015, model.qpos0[2:]])
    given = {"required_wrench": grasps.required_wrench, "actuation": grasps.actuation}
    found = jg.largest_disturbance(grasps.contacts, PUSHES, **given)
    # Of the same gripper with a coupling that is almost linear, by hand and by C MuJoCo.
    assert float(found.margin) == pytest.approx(16.6878, abs=1e-3)
    least = jg.least_effort(grasps.contacts, PUSHES, 0.75 * found.margin, **given)
    assert float(least.effort) == pytest.approx(41.42, abs=0.01)
    # The actuator gives what all four pads press with.
    assert float(least.actuator_efforts[0]) == pytest.approx(18.097, abs=1e-2)
    np.testing.assert_allclose(-least.forces[:, 2].sum(), least.actuator_efforts[0], rtol=1e-6)


MIMIC = """<robot name="gripper"><link name="palm"/>{links}
<joint name="left" type="prismatic"><parent link="palm"/><child link="l"/><origin xyz="0 .04 0"/><axis xyz="0 -1 0"/>
<limit lower="0" upper=".04" effort="20" velocity="1"/></joint>
<joint name="right" type="prismatic"><parent link="palm"/><child link="r"/><origin xyz="0 -.04 0"/><axis xyz="0 1 0"/>
<limit lower="0" upper=".04" effort="20" velocity="1"/><mimic joint="left" multiplier="{multiplier}"/>
</joint></robot>"""
JAW = """<link name="{}"><collision><geometry><box size=".02 .02 .04"/></geometry></collision><inertial>
<mass value=".1"/><inertia ixx="1e-4" iyy="1e-4" izz="1e-4" ixy="0" ixz="0" iyz="0"/></inertial></link>"""


@pytest.mark.parametrize("multiplier", [1.0, 0.5])
def test_joints_of_urdf_mimic_others(multiplier, tmp_path):
    file = tmp_path / "gripper.urdf"
    file.write_text(MIMIC.format(links=JAW.format("l") + JAW.format("r"), multiplier=multiplier))
    scene = Scene.build(hand=file, object="sphere", scale=0.06, mass=0.1, base="fixed", gravity=(0, 0, -9.81))
    hand = scene.hand_object()
    assert scene.joint_names == ("left", "right") and hand.joint_names == ("left",)
    grasps = hand.grasps(scene.qpos(joints={"left": 0.0, "right": 0.0}, object=[0, 0, 0, 1, 0, 0, 0]))
    assert grasps.touching == 2 and grasps.joint_stiffness.shape[-2:] == (1, 1)
    np.testing.assert_allclose(hand.couplings.constant, [[1.0], [multiplier]])
    found = jg.largest_disturbance(grasps.contacts, PUSHES, required_wrench=grasps.required_wrench)
    assert grasps.actuation is None and found.status == jg.Status.SOLVED and found.margin > 1


WELDED = (
    "<worldbody>{mocap}{palm}"
    '<body name="object" pos="0 0 -.03"><freejoint/><geom type="box" size=".02 .02 .02" mass=".1"/></body></worldbody>'
    '<actuator><position joint="left" kp="100" forcerange="-5 5"/><position joint="right" kp="100" '
    'forcerange="-5 5"/></actuator><equality><weld body1="{holder}" body2="palm"/></equality>'
)
MOCAP = '<body name="mocap" mocap="true"/>'
FINGERS = "".join(
    f'<body pos="0 {y} -.03"><joint name="{name}" type="slide" axis="0 {-np.sign(y)} 0"/><geom size=".01"/></body>'
    for name, y in (("left", 0.03), ("right", -0.03))
)
ARM = (
    '<body name="arm" pos="0 0 .2"><joint name="arm" axis="0 1 0"/><geom size=".01" mass="1"/>'
    f'<body name="palm" pos="0 0 -.2"><joint name="wrist" axis="1 0 0"/><geom size=".005" mass="1"/>{FINGERS}</body>'
    "</body>"
)


@pytest.mark.parametrize(("mocap", "holder"), [(MOCAP, "mocap"), ("", "world")])
def test_a_weld_holds_the_joints_of_an_arm(mocap, holder):
    """As of the same fingers on a palm without an arm."""
    model = mujoco.MjModel.from_xml_string(f"<mujoco>{WELDED.format(mocap=mocap, palm=ARM, holder=holder)}</mujoco>")
    hand = HandObject.from_mjcf(model, "object")
    assert hand.joint_names == ("left", "right")
    alone = f'<body name="palm"><geom size=".005" mass="1"/>{FINGERS}</body>'
    bare = f"<mujoco>{WELDED.format(mocap='', palm=alone, holder='world').partition('<equality>')[0]}</mujoco>"
    margins = []
    for one in (model, mujoco.MjModel.from_xml_string(bare)):
        grasps = HandObject.from_mjcf(one, "object").grasps(one.qpos0)
        given = {"required_wrench": grasps.required_wrench, "actuation": grasps.actuation}
        margins.append(float(jg.largest_disturbance(grasps.contacts, PUSHES, **given).margin))
    assert margins[0] == pytest.approx(margins[1], rel=1e-9) and margins[0] > 1


def test_a_weld_of_two_bodies_that_move_is_refused():
    model = mujoco.MjModel.from_xml_string(f"<mujoco>{WELDED.format(mocap='', palm=ARM, holder='arm')}</mujoco>")
    with pytest.raises(ValueError, match="equality constraint 0 is of kind weld"):
        HandObject.from_mjcf(model, "object")
