"""Scenes from a hand, an object and a world: poses, masses and files, against C MuJoCo's own models of the parts."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest
import trimesh

from jaxgrasp.hands import Scene

HAND = """<mujoco model="m"><compiler angle="radian"/><option gravity="0 0 -5" cone="elliptic" impratio="10"/>
<worldbody><body name="palm" pos="0 0 0.034"><geom name="p" type="box" size=".02 .03 .01" friction="0.4"/>
  <body name="f1" pos="0 .02 .01"><joint name="a" axis="1 0 0" range="-1 2"/>
    <geom type="capsule" size=".005 .02"/>
    <body name="f2" pos="0 0 .04"><joint name="b" axis="1 0 0"/><geom name="tip" size=".006"/></body></body></body>
</worldbody><actuator><position name="b" joint="b" kp="1"/></actuator>
<equality><joint joint1="b" joint2="a" polycoef="0 0.5 0 0 0"/></equality>
<contact><exclude body1="palm" body2="f2"/></contact><keyframe><key qpos="0.1 0.2"/></keyframe></mujoco>"""
URDF = """<robot name="r"><link name="p"><collision><geometry><box size=".1 .1 .02"/></geometry></collision>
<inertial><mass value="1"/><inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/></inertial></link>
<link name="q"><collision><geometry><sphere radius=".01"/></geometry></collision>
<inertial><mass value="1"/><inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/></inertial></link>
<joint name="j" type="revolute"><parent link="p"/><child link="q"/><origin xyz="0 0 .05"/><axis xyz="0 1 0"/>
<limit lower="0" upper="1" effort="3" velocity="1"/></joint></robot>"""


@pytest.fixture(scope="module")
def files(tmp_path_factory):
    folder = tmp_path_factory.mktemp("files")
    (folder / "hand.xml").write_text(HAND)
    (folder / "hand.urdf").write_text(URDF)
    (folder / "cup.xml").write_text(
        '<mujoco><worldbody><body name="b" pos="0 0 .5"><freejoint/><geom type="box" size=".1 .2 .3" mass="2"/>'
        '<body name="c" pos="1 0 0"><geom name="g" size=".3" mass="3"/></body></body></worldbody></mujoco>'
    )
    (folder / "pieces").mkdir()
    for number in range(2):
        box = trimesh.creation.box((1, 2, 1), trimesh.transformations.translation_matrix((2.0 * number, 0, 0.5)))
        box.export(folder / "pieces" / f"piece_{number}.obj")
    (folder / "none").mkdir()
    return folder


def random_poses(count: int, seed: int) -> np.ndarray:
    rng = np.random.default_rng(seed)
    turn = rng.normal(size=(count, 4))
    return np.c_[rng.normal(size=(count, 3)), turn / np.linalg.norm(turn, axis=-1, keepdims=True)]


def matrix(pose: np.ndarray) -> np.ndarray:
    out = np.eye(4)
    turn = np.zeros(9)
    mujoco.mju_quat2Mat(turn, pose[3:])
    out[:3, :3], out[:3, 3] = turn.reshape(3, 3), pose[:3]
    return out


def placed(data: mujoco.MjData, body: str) -> np.ndarray:
    out = np.eye(4)
    out[:3, :3], out[:3, 3] = data.body(body).xmat.reshape(3, 3), data.body(body).xpos
    return out


@pytest.mark.parametrize("base", ["free", "mocap"])
def test_the_base_is_the_frame_of_the_files_world(files, base):
    scene = Scene.build(hand=files / "hand.xml", object=files / "pieces", scale=0.05, mass=0.1, base=base)
    assert scene.joint_names == ("a", "b")
    alone = mujoco.MjModel.from_xml_path(str(files / "hand.xml"))
    own, data = mujoco.MjData(alone), mujoco.MjData(scene.model)
    bases, things = random_poses(5, 0), random_poses(5, 1)
    joints = {"b": np.linspace(0, 1, 5), "a": np.linspace(1, 0, 5)}
    qpos = scene.qpos(base=bases.astype(np.float32), joints=joints, object=things)
    for row in range(5):
        own.qpos[:] = joints["a"][row], joints["b"][row]
        mujoco.mj_kinematics(alone, own)
        data.qpos = qpos[row]
        mujoco.mj_kinematics(scene.model, data)
        for body in ("palm", "f1", "f2"):
            np.testing.assert_allclose(placed(data, body), matrix(bases[row]) @ placed(own, body), atol=1e-6)
        np.testing.assert_allclose(placed(data, "object"), matrix(things[row]), atol=1e-12)
    np.testing.assert_array_equal(scene.model.opt.gravity, (0, 0, -5))
    assert scene.model.opt.impratio == 10 and scene.model.neq == (2 if base == "mocap" else 1)


def test_pieces_have_the_mass_the_centre_and_the_inertia_of_a_solid(files):
    scene = Scene.build(hand=files / "hand.xml", object=files / "pieces", scale=0.05, mass=0.1, base="fixed")
    body = scene.model.body("object")
    assert body.mass[0] == pytest.approx(0.1, rel=1e-6)
    np.testing.assert_allclose(body.ipos, (0.05, 0, 0.025), atol=1e-9)
    a, b = 0.05, 0.1
    each = 0.05 / 12 * np.array([b**2 + a**2, 2 * a**2, a**2 + b**2])
    wanted = 2 * each + 0.1 * 0.05**2 * np.array([0, 1, 1])
    np.testing.assert_allclose(np.sort(body.inertia), np.sort(wanted), rtol=1e-5)
    dense = Scene.build(hand=files / "hand.xml", object=files / "pieces", scale=0.05, density=200, base="fixed")
    assert dense.model.body("object").mass[0] == pytest.approx(200 * 2 * 2 * 0.05**3)


def test_bodies_of_a_file_are_scaled(files):
    scene = Scene.build(hand=files / "hand.urdf", object=files / "cup.xml", scale=0.1)
    number = scene.model.body("object").id
    assert scene.model.body_subtreemass[number] == pytest.approx(5)
    assert scene.joint_names == ("j",) and scene.model.geom("object-g").size[0] == pytest.approx(0.03)
    data = mujoco.MjData(scene.model)
    mujoco.mj_forward(scene.model, data)
    np.testing.assert_allclose(data.geom("object-g").xpos, (0.1, 0, 0.05))
    heavy = Scene.build(hand=files / "hand.urdf", object=files / "cup.xml", scale=0.1, mass=0.7)
    assert heavy.model.body_subtreemass[number] == pytest.approx(0.7)


def test_contact_options_reach_every_geom_and_the_table_is_no_body(files):
    options = {"friction": 0.7, "torsional_friction": 0.02, "condim": 4, "gravity": (0, 0, -9.81), "table": -0.1}
    scene = Scene.build(hand=files / "hand.xml", object="box", scale=0.05, **options)
    model, table = scene.model, scene.model.geom("table")
    others = np.arange(model.ngeom) != table.id
    np.testing.assert_array_equal(model.geom_friction[others, :2], np.tile((0.7, 0.02), (others.sum(), 1)))
    assert (model.geom_condim[others] == 4).all() and model.opt.gravity[2] == -9.81
    assert table.bodyid[0] == 0 and table.pos[2] == -0.1
    kept = Scene.build(hand=files / "hand.xml", object="box", scale=0.05).model
    assert kept.geom("p").friction[0] == 0.4 and kept.geom("p").condim[0] == 3


def test_a_saved_scene_is_the_same(files, tmp_path):
    scene = Scene.build(hand="four_fingers", object=files / "pieces", scale=0.03, mass=0.2, base="mocap", table=0.0)
    scene.save(tmp_path / "saved.xml")
    again = mujoco.MjModel.from_xml_path(str(tmp_path / "saved.xml"))
    for name in ("qpos0", "geom_pos", "geom_size", "body_mass", "jnt_range", "actuator_forcerange", "geom_friction"):
        np.testing.assert_allclose(getattr(again, name), getattr(scene.model, name), rtol=1e-5, atol=1e-6)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"hand": "nix.xml"}, r"^hand: got .*nix.xml', and there is no such file"),
        ({"hand": "nix"}, r"^hand: got 'nix', wanted an MJCF or URDF file, shadow_hand, four_fingers, FOLDER/FILE"),
        ({"hand": "none.xml"}, r"^hand: .*none.xml cannot be read: .*Schema violation"),
        ({"hand": "floor.xml"}, r"^hand: .*floor.xml cannot be used: it has a plane or a height field"),
        ({"hand": "own.xml"}, r"^hand: .*own.xml cannot be used: it has a free joint of its own"),
        ({"object": "nix.obj"}, r"^object: got .*nix.obj', and there is no such file"),
        ({"object": "cone"}, r"^object: got 'cone', wanted a folder of convex pieces, a mesh .obj"),
        ({"object": "none"}, r"^object: .*none has no meshes; wanted a folder with convex pieces"),
        ({"object": "flat.obj", "mass": 0.1}, r"^object: .*flat.obj cannot be used: .*"),
        ({"object": "hand.xml"}, r"^object: it has a joint 'a' inside; wanted a rigid object"),
        ({"scale": 0.0}, r"^scale: got 0.0, wanted a finite number above 0"),
        ({"mass": -1.0}, r"^mass: got -1.0, wanted a finite number above 0"),
        ({"mass": 1.0, "density": 1.0}, r"^mass: got 1.0 and density 1.0, wanted one of them"),
        ({"friction": np.nan}, r"^friction: got nan, wanted a finite number at least 0"),
        ({"condim": 2}, r"^condim: got 2, wanted 1, 3, 4 or 6"),
        ({"base": "loose"}, r"^base: got 'loose', wanted one of free, fixed, mocap"),
        ({"gravity": (0, 1)}, r"^gravity: got \(0, 1\), wanted three finite numbers"),
        ({"table": np.inf}, r"^table: got inf"),
    ],
)
def test_what_cannot_be_used_is_named_in_one_line(files, options, message):
    (files / "none.xml").write_text("<mujoco><nothing/></mujoco>")
    (files / "floor.xml").write_text(HAND.replace("<worldbody>", '<worldbody><geom type="plane" size="1 1 1"/>'))
    (files / "own.xml").write_text(HAND.replace('<geom name="p"', '<freejoint/><geom name="p"'))
    (files / "flat.obj").write_text("v 0 0 0\nv 1 0 0\nv 0 1 0\nv 1 1 0\nf 1 2 3\nf 2 4 3\n")
    given = {"hand": "hand.xml", "object": "box", "scale": 0.05} | options
    for name in ("hand", "object"):
        if "." in given[name] or given[name] == "none":
            given[name] = files / given[name]
    with pytest.raises(ValueError, match=message) as caught:
        Scene.build(**given)
    assert "\n" not in str(caught.value)


def test_configurations_by_wrong_names_and_shapes(files):
    scene = Scene.build(hand=files / "hand.xml", object="sphere", scale=0.05, base="fixed")
    with pytest.raises(ValueError, match=r"^base: got poses, but the scene's base is fixed"):
        scene.qpos(base=np.zeros(7))
    with pytest.raises(ValueError, match=r"^joints: got 'c', wanted some of a, b"):
        scene.qpos(joints={"c": 0.0})
    with pytest.raises(ValueError, match=r"^joints: got shape \(1, 3\), wanted \(N, 2\): a, b"):
        scene.qpos(joints=np.zeros(3))
    with pytest.raises(ValueError, match=r"^object: got shape \(1, 6\), wanted \(N, 7\)"):
        scene.qpos(object=np.zeros(6))
    with pytest.raises(ValueError, match=r"^qpos: got 2 and 3 configurations"):
        scene.qpos(joints={"a": np.zeros(2), "b": np.zeros(3)})


def test_an_object_meets_every_mask_of_the_hand(files, tmp_path):
    """The tips of some hands collide with nothing that has MuJoCo's own masks."""
    path = tmp_path / "masked.xml"
    path.write_text(HAND.replace('name="tip"', 'name="tip" contype="0" conaffinity="4"'))
    for object in ("sphere", files / "pieces"):
        hand = Scene.build(hand=path, object=object, scale=0.05).hand_object()
        assert {hand.model.body(b).name for b in hand.touching_links} == {"palm", "f1", "f2"}


def test_a_left_hand_is_the_mirror_image_of_a_right_one(files, tmp_path):
    """What turns about x turns the other way behind a mirror along y."""
    path, mirror = tmp_path / "left.xml", np.array([1.0, -1.0, 1.0])
    path.write_text(HAND.replace('pos="0 .02 .01"', 'pos="0 -.02 .01"').replace('axis="1 0 0"', 'axis="-1 0 0"'))
    found = []
    for hand, side in ((files / "hand.xml", 1), (path, -1)):
        scene = Scene.build(hand=hand, object="sphere", scale=0.05, base="fixed")
        qpos = scene.qpos(joints=[0.2, 0.1], object=[0.005, 0.05 * side, 0.09, 1, 0, 0, 0])
        found.append(scene.hand_object(contact_distance=0.05).grasps(qpos))
    right, left = found
    np.testing.assert_allclose(left.distances, right.distances, atol=1e-9)
    np.testing.assert_allclose(np.asarray(left.contacts.positions) * mirror, right.contacts.positions, atol=1e-9)
    forces = np.random.default_rng(0).normal(size=(*right.distances.shape, 3))
    torques = []
    for grasps, turn in ((right, 1), (left, mirror)):
        pushed = np.einsum("ncji,ncj->nci", np.asarray(grasps.contacts.frames), forces * turn)
        torques.append(grasps.actuation.joint_torques(pushed))
    assert np.abs(torques[0]).max() > 1e-3
    np.testing.assert_allclose(*torques, atol=1e-9)
