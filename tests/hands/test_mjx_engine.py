"""Engine `mjx` against C MuJoCo: contacts of pairs that touch, and what it cannot answer."""

from __future__ import annotations

import jax
import mujoco
import numpy as np
import pytest

from jaxgrasp.hands import HandObject

# Pads of three kinds on slides, a stop that is reached, and a wall that nothing of the hand can touch.
SCENE = """
<mujoco><worldbody><geom name="wall" type="box" size="1 1 .01" pos="0 0 -1"/>
<body name="a" pos="0.045 0 0"><joint name="a" type="slide" axis="-1 0 0" range="0 .02"/>
  <geom name="ball" size="0.015" {mask}/></body>
<body name="b" pos="-0.045 0 0"><joint name="b" type="slide" axis="1 0 0"/>
  <geom name="bar" type="{bar}" size="0.015 0.01" friction=".4" priority="1"/></body>
<body name="c" pos="0 0 0.1"><joint name="c" axis="0 1 0"/><geom name="{free}" type="{free}" size=".01 .01 .01"/></body>
<body name="object"><freejoint/><geom name="thing" type="{kind}" size="0.03 0.03 0.03" mass="0.1" {extra}/></body>
</worldbody><actuator><motor joint="a"/><motor joint="b"/></actuator>{rest}</mujoco>"""


def hand_of(kind="box", free="sphere", bar="capsule", mask="", extra="", rest="", distance=0.0) -> HandObject:
    model = mujoco.MjModel.from_xml_string(
        SCENE.format(kind=kind, free=free, bar=bar, mask=mask, extra=extra, rest=rest)
    )
    return HandObject.from_mjcf(model, "object", contact_distance=distance)


def test_contacts_and_mechanics_are_those_of_engine_mujoco():
    # One kind of pair, since MJX takes long to compile.
    hand = hand_of(bar="sphere", rest='<contact><exclude body1="c" body2="object"/></contact>')
    qpos = np.tile(hand.model.qpos0, (4, 1))
    # Both pads press; one of them; the object is turned about x, which leaves the sides where they are; none does.
    qpos[:, :2] = [[1e-4, 3e-4], [-1e-3, 2e-4], [5e-4, 5e-4], [-1e-3, -1e-3]]
    qpos[2, 6:] = [np.cos(0.2), np.sin(0.2), 0, 0]
    found, wanted = jax.jit(lambda q: hand.grasps(q, "mjx"))(qpos), hand.grasps(qpos, "mujoco")
    assert np.array_equal(found.touching, [2, 1, 2, 0]) and np.array_equal(found.touching, wanted.touching)
    np.testing.assert_allclose(found.penetration, wanted.penetration, atol=1e-9)
    there = np.asarray(wanted.contacts.active)
    for name in ("positions", "frames", "friction"):
        ours, theirs = (np.asarray(getattr(x.contacts, name))[there] for x in (found, wanted))
        np.testing.assert_allclose(ours, theirs, atol=1e-7)
    assert np.array_equal(found.links[there], wanted.links[there])
    np.testing.assert_allclose(found.actuation.jacobian[there], wanted.actuation.jacobian[there], atol=1e-7)
    for name in ("transmission", "lower", "upper"):
        np.testing.assert_allclose(getattr(found.actuation, name), getattr(wanted.actuation, name), atol=1e-9)
    np.testing.assert_allclose(found.required_wrench, wanted.required_wrench, atol=1e-9)


def test_only_hand_and_object_collide_as_the_masks_say():
    engine = hand_of(mask='contype="2" conaffinity="4"', extra='contype="1" conaffinity="3"').engine("mjx")
    names = {tuple(engine._model.geom(g).name for g in pair) for pair in engine.slots.pairs}
    assert names == {("ball", "thing"), ("bar", "thing"), ("sphere", "thing")}
    without = hand_of(mask='contype="2" conaffinity="4"').engine("mjx")
    assert {pair[0] for pair in without.slots.pairs} == {without._model.geom(n).id for n in ("bar", "sphere")}


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"distance": 1e-3}, r"'ball' \(sphere\) and 'thing' \(box\) only where they penetrate, .* 0.001 m apart"),
        ({"extra": 'margin="0.002"'}, r"only where they penetrate, .* 0.002 m apart"),
        ({"kind": "cylinder", "free": "box"}, r"no collision of geoms 'box' \(box\) and 'thing' \(cylinder\)"),
    ],
)
def test_what_mjx_cannot_answer_is_named(options, message):
    hand = hand_of(**options)
    with pytest.raises(ValueError, match=rf"^engine: MJX .*{message}.*'mujoco' or 'distance'$"):
        hand.grasps(hand.model.qpos0, "mjx")


def test_spheres_have_distances():
    """Only kinds that MJX tells no distance of are refused."""
    hand_of("sphere", distance=1e-3).engine("mjx")
