"""Objects of several parts, options, batches of any shape, and what is wrong with inputs."""

from __future__ import annotations

from dataclasses import fields
from functools import cache

import hand_configurations as configurations
import hand_models
import jax
import mujoco
import numpy as np
import pytest
from hand_models import FINGER, finger, random_configurations

import jaxgrasp as jg
from jaxgrasp.hands import HandObject

EXACT = 1e-9
COUNT = 200
ENGINES = ("mujoco", "distance")
# Two geoms, a centre of mass off the origin, a part that is fixed to it and turned.
PARTS = """
<body name="object" pos="0.0 0 0">
  <freejoint/>
  <geom type="sphere" size="0.012" contype="2" conaffinity="1" mass="0.1" pos="0.004 0 0"/>
  <geom type="box" size="0.01 0.006 0.008" contype="2" conaffinity="1" mass="0.03" pos="-0.01 0.008 0" euler="0.3 0 1"/>
  <body name="part" pos="0 -0.012 0.003" euler="0 0.4 0.2">
    <geom type="sphere" size="0.007" contype="2" conaffinity="1" mass="0.05" friction="1.4"/>
  </body>
</body>"""


@cache
def composite() -> tuple[HandObject, np.ndarray]:
    model = finger(objects=PARTS)
    options = {"contact_distance": 0.0, "points_per_link": None, "max_contacts": 12}
    return HandObject.from_mjcf(model, "object", **options), random_configurations(model, COUNT)


@cache
def grasps_of_parts(engine: str = "distance"):
    hand, qpos = composite()
    return jax.tree.map(np.asarray, hand.grasps(qpos, engine))


@pytest.mark.parametrize("engine", ENGINES)
def test_contacts_of_an_object_of_several_parts(engine):
    hand, qpos = composite()
    theirs, found = configurations.by_mujoco(hand.model, qpos), configurations.ours(grasps_of_parts(engine))
    for of, among, counted in ((theirs, found, slice(None)), (found, theirs, found.distance < 0)):
        position, normal, distance, at = configurations.differences(of, among)
        assert len(position[counted]) > COUNT // 2
        assert max(position[counted].max(), normal[counted].max(), distance[counted].max()) < EXACT
        assert np.array_equal(of.friction[counted], among.friction[at][counted])
    assert {1.0, 1.4} == set(theirs.friction)


@pytest.mark.parametrize("engine", ENGINES)
def test_required_wrench_is_what_holds_the_object(engine):
    hand, qpos = composite()
    grasps = grasps_of_parts(engine)
    model, data = hand.model, mujoco.MjData(hand.model)
    body = model.body("object").id
    free = model.jnt_dofadr[model.body("object").jntadr[0]] + np.arange(6)
    for lane in range(20):
        data.qpos = qpos[lane]
        mujoco.mj_forward(model, data)
        rotation = data.xmat[body].reshape(3, 3)
        centre = rotation.T @ (data.subtree_com[body] - data.xpos[body])
        # What gravity does to the free joint at rest: about the body's origin, in the body's frame.
        force, moment = rotation.T @ data.qfrc_bias[free[:3]], data.qfrc_bias[free[3:]]
        wanted = np.r_[force, moment - np.cross(centre, force)]
        np.testing.assert_allclose(grasps.required_wrench[lane], wanted, atol=EXACT)
        np.testing.assert_allclose(grasps.object_position[lane], data.subtree_com[body], atol=EXACT)
        np.testing.assert_allclose(grasps.object_rotation[lane], rotation, atol=EXACT)
    assert np.abs(grasps.required_wrench[:, :3]).max() > 1


@pytest.mark.parametrize("engine", ENGINES)
def test_bad_configurations_are_alone(engine):
    hand, qpos = composite()
    whole = grasps_of_parts(engine)
    bad = qpos.copy()
    start = hand.model.jnt_qposadr[hand.model.body("object").jntadr[0]] + 3
    bad[3, 0], bad[5, start + 1], bad[8] = np.nan, np.inf, np.nan
    bad[11, start : start + 4] *= 1.1
    bad[12, start : start + 4] = 0
    # Rounding is no mistake.
    bad[13, start : start + 4] *= 1 + 1e-6
    wrong = np.isin(np.arange(COUNT), [3, 5, 8, 11, 12])
    found = jax.tree.map(np.asarray, hand.grasps(bad, engine))
    same = jax.tree.map(lambda a, b: np.array_equal(a[~wrong][14:], b[~wrong][14:]), found, whole)
    assert all(jax.tree.leaves(same))
    np.testing.assert_allclose(found.contacts.positions[13], whole.contacts.positions[13], atol=1e-7)
    solution = jg.largest_disturbance(
        found.contacts, jg.DisturbanceSet.forces(1.0), required_wrench=found.required_wrench
    )
    assert np.array_equal(np.asarray(solution.status) == jg.Status.INVALID_INPUT, wrong)


def test_batches_of_any_shape():
    hand, qpos = composite()
    whole = grasps_of_parts()

    def same(found, indices, shape):
        for field in fields(found):
            got, wanted = getattr(found, field.name), getattr(whole, field.name)
            for a, b in zip(jax.tree.leaves(got), jax.tree.leaves(wanted), strict=True):
                np.testing.assert_allclose(a, b[indices].reshape((*shape, *b.shape[1:])), rtol=1e-12, atol=1e-12)

    same(hand.grasps(qpos[0], "distance"), slice(1), ())
    same(hand.grasps(qpos[:1], "distance"), slice(1), (1,))
    same(hand.grasps(qpos[:6].reshape(3, 1, 2, -1), "distance"), slice(6), (3, 1, 2))
    same(jax.jit(jax.vmap(hand.grasps))(qpos[:6]), slice(6), (6,))


def nearest_in_turn(distances: np.ndarray, links: np.ndarray, count: int) -> np.ndarray:
    """The least distance of every link that touches, then the next one of each, then what is apart; in order."""
    turn = [np.inf if distance > 0 else np.sum(links[:k] == links[k]) for k, distance in enumerate(distances)]
    return np.sort(distances[np.lexsort([distances, turn])[:count]])


def test_the_nearest_contacts_are_kept_of_all_links_in_turn():
    hand, qpos = composite()
    whole = grasps_of_parts()
    few = jax.tree.map(
        np.asarray,
        HandObject.from_mjcf(
            hand.model,
            "object",
            contact_distance=0.0,
            points_per_link=None,
            max_contacts=2,
            friction=0.3,
            max_force=7.0,
        ).grasps(qpos, "distance"),
    )
    assert few.distances.shape == (COUNT, 2)
    wanted = [nearest_in_turn(*row, 2) for row in zip(whole.distances, whole.links, strict=True)]
    assert np.array_equal(few.distances, wanted) and np.any(few.distances != whole.distances[:, :2])
    assert np.array_equal(few.touching, whole.touching) and few.touching.max() > 2
    assert np.array_equal(few.left_out, np.maximum(whole.touching - 2, 0))
    assert np.array_equal(few.penetration, np.maximum(0, -whole.distances[:, 0]))
    assert np.all(few.contacts.friction == 0.3) and np.all(few.contacts.max_force == 7.0)


@pytest.mark.parametrize("engine", ENGINES)
def test_a_link_has_one_contact_at_the_mean_of_its_points(engine):
    hand, qpos = composite()
    whole = jax.tree.map(
        np.asarray,
        HandObject.from_mjcf(hand.model, "object", contact_distance=2e-3, points_per_link=None, max_contacts=16).grasps(
            qpos, engine
        ),
    )
    merged = jax.tree.map(
        np.asarray, HandObject.from_mjcf(hand.model, "object", contact_distance=2e-3).grasps(qpos, engine)
    )
    assert merged.distances.shape[1] == 4 and not merged.left_out.any()
    several = 0
    for lane, slot in zip(*np.nonzero(merged.contacts.active), strict=True):
        own = (whole.links[lane] == merged.links[lane, slot]) & whole.contacts.active[lane]
        assert merged.distances[lane, slot] == whole.distances[lane][own].min()
        assert merged.contacts.friction[lane, slot] == whole.contacts.friction[lane][own].min()
        several += own.sum() > 1
        normal = whole.contacts.frames[lane][own][:, :, 2].mean(0)
        for got, wanted in (
            (merged.contacts.positions[lane, slot], whole.contacts.positions[lane][own].mean(0)),
            (merged.contacts.frames[lane, slot, :, 2], normal / np.linalg.norm(normal)),
        ):
            np.testing.assert_allclose(got, wanted, atol=1e-12)
    assert several > 5
    links = [len(set(row[active])) for row, active in zip(whole.links, whole.contacts.active, strict=True)]
    np.testing.assert_array_equal(merged.touching, links)
    np.testing.assert_array_equal(merged.contacts.active.sum(-1), links)


def test_no_distance_is_known_of_a_plane_but_mujoco_knows_one():
    plane = OBJECT.replace('type="sphere" size="0.012"', PLANE).replace("<freejoint/>", "")
    model = finger(objects=plane)
    hand = HandObject.from_mjcf(model, "object")
    message = r"geoms number 0 \(sphere\) and 'floor' \(plane\) can touch, but no distance .*or engine 'mujoco'$"
    with pytest.raises(ValueError, match=message):
        hand.grasps(model.qpos0, "distance")
    assert hand.grasps(model.qpos0).touching == 4
    with pytest.raises(ValueError, match=r"^engine: got 'mujoco' inside jit"):
        jax.jit(lambda q: hand.grasps(q, "mujoco"))(model.qpos0)
    with pytest.raises(ValueError, match=r"^engine: got 'bullet', wanted one of mujoco, distance, mjx"):
        hand.grasps(model.qpos0, "bullet")


FIXED = (
    '<tendon><fixed name="t"><joint joint="a" coef="1"/></fixed>'
    '<fixed name="s"><joint joint="b" coef="1"/></fixed></tendon>'
)
TWO = '<motor joint="d"/><motor joint="d"/>'
LIMITED = FINGER.replace('name="d" type="slide"', 'name="d" type="slide" actuatorfrcrange="-1 2"')
OBJECT = hand_models.BALL
PLANE = 'name="floor" type="plane" size="1 1 1"'


@pytest.mark.parametrize(
    "model, options, message",
    [
        ({}, {"object_body": "ball"}, r"^object_body: got 'ball', wanted one of the scene's bodies: l1, .*object$"),
        ({}, {"hand_body": "palm"}, r"^hand_body: got 'palm', wanted one of the scene's bodies"),
        ({}, {"max_contacts": 0}, r"^max_contacts: got 0, wanted at least 1"),
        ({}, {"max_force": np.inf}, r"^max_force: got inf, wanted a finite positive number"),
        ({}, {"contact_distance": np.nan}, r"^contact_distance: got nan"),
        ({}, {"friction": -0.5}, r"^friction: got -0.5, wanted a finite number, at least 0"),
        ({}, {"points_per_link": 0}, r"^points_per_link: got 0, wanted at least 1"),
        ({}, {"unreached": "loose"}, r"^unreached: got 'loose', wanted one of held, free"),
        ({"links": FINGER.replace("stiffness", "damping")}, {"unreached": "free"},
         r"^unreached: got 'free' for a hand without actuators"),
        ({}, {"environment": ["table"]}, r"^environment: got 'table', wanted one of the scene's bodies"),
        ({"links": FINGER.replace('conaffinity="2"', 'conaffinity="0"').replace('contype="1"', 'contype="0"')}, {},
         r"no geom of the hand can touch .*wanted contype and conaffinity"),
        ({"links": FINGER.replace('name="a" axis="0 0 1"', 'name="a" type="ball"')}, {},
         r"joint 'a' is a ball; wanted hinges"),
        ({"objects": OBJECT.replace("</body>", '<body><joint/><geom size="0.01"/></body></body>')}, {},
         r"^object_body: got 'object', with joints inside"),
        ({"rest": FIXED + '<equality><tendon name="bound" tendon1="t" tendon2="s"/></equality>'}, {},
         r"equality constraint 'bound' is of kind tendon; wanted couplings of joints"),
        ({"rest": '<equality><connect body1="l4" body2="l1" anchor="0 0 0"/></equality>'}, {},
         r"equality constraint 0 is of kind connect"),
        ({"rest": '<actuator><general name="jet" site="s0"/></actuator>'}, {},
         r"actuator 'jet' acts by site; wanted joint or tendon"),
        ({"rest": '<actuator><general name="arm" joint="a" gaintype="affine" gainprm="1 2 0"/></actuator>'}, {},
         r"actuator 'arm' has gain affine and bias none; wanted a force that is affine in its command"),
        ({"rest": f"<actuator>{TWO}</actuator>", "links": LIMITED}, {},
         r"joint 'd' limits the sum of its actuators' forces; wanted limits of the actuators"),
        ({"rest": FIXED.replace('name="t"', 'name="t" actuatorfrcrange="-1 1"')
          + '<actuator><motor tendon="t"/><motor tendon="t"/></actuator>'}, {},
         r"tendon 't' limits the sum of its actuators' forces"),
    ],
)  # fmt: skip
def test_what_is_wrong_with_a_scene_is_named(model, options, message):
    built = finger(**model)
    with pytest.raises(ValueError, match=message) as caught:
        HandObject.from_mjcf(built, **({"object_body": "object"} | options))
    assert "\n" not in str(caught.value)


def test_scenes_that_cannot_be_read(tmp_path):
    with pytest.raises(ValueError, match=r"^scene: .*nowhere.xml cannot be read: "):
        HandObject.from_mjcf(tmp_path / "nowhere.xml", "object")
    spec = mujoco.MjSpec()
    spec.add_mesh(name="cup", file="cup.stl")
    with pytest.raises(ValueError, match=r"^scene: the specification cannot be read: .*cup.stl") as caught:
        HandObject.from_mjcf(spec, "object")
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("shape", [(3,), (2, 12), ()])
def test_configurations_of_another_length(shape):
    with pytest.raises(ValueError, match=r"^qpos: got shape .*, wanted \(\*batch, 11\)"):
        composite()[0].grasps(np.zeros(shape))


def test_hidden_moment_arms_and_limits_of_tendons_and_joints():
    straight = FINGER.replace('pos="0.01 0.012 0"', 'pos="0.01 0 0"').replace(
        'pos="0.015 0.01 0.008"', 'pos="0.015 0 0"'
    )
    # Straight through the axis of b, the tendon has no moment there.
    rest = (
        '<tendon><spatial name="t"><site site="s0"/><site site="s1"/></spatial></tendon>'
        '<actuator><motor name="t" tendon="t"/></actuator>'
    )
    model = finger(rest, links=straight.replace('ref="0.1" ', ""))
    assert HandObject.from_mjcf(model, "object").actuator_names == ("t",)
    # A limit of a joint that nothing drives binds nothing.
    HandObject.from_mjcf(finger('<actuator><motor name="a" joint="a"/></actuator>', links=LIMITED), "object")


def test_a_fixed_object_does_not_touch_a_fixed_palm():
    model = mujoco.MjModel.from_xml_string("""<mujoco><worldbody>
      <body name="palm"><geom type="box" size=".05 .05 .01"/>
        <body name="finger" pos="0 0 .04"><joint axis="0 1 0"/><geom type="sphere" size=".01"/></body></body>
      <body name="object" pos="0 0 .03"><geom type="sphere" size=".03"/></body>
    </worldbody></mujoco>""")
    hand, data = HandObject.from_mjcf(model, "object"), mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    assert hand.slot_links.tolist() == [model.body("finger").id]
    assert data.ncon == 1
