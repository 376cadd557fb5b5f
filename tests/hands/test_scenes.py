"""Built-in scenes: that they are what they say and that the fingers reach the objects; pictures of them."""

import sys

import matplotlib.image
import mujoco
import numpy as np
import pytest
import trimesh

from jaxgrasp.hands.scenes import OBJECTS, four_fingers, shadow_hand
from jaxgrasp.viewer.offscreen import offscreen
from jaxgrasp.viewer.scene import draw_scenes

# A tip counts as touching within a hundredth of a millimetre: MuJoCo's distances are to 1 um, descent stops before.
TOUCHING = 1e-5
SHADOW_FINGERS = ("FF", "MF", "RF", "LF")
# A hand about to close around the object, by the ends of the joints' names.
BENT = {"flex1": -0.3, "flex2": 1.0, "THJ5": 0.5, "THJ4": 1.1, "THJ2": 0.3, "THJ1": 0.3} | {
    f"{finger}{joint}": angle for finger in SHADOW_FINGERS for joint, angle in (("J3", 0.5), ("J2", 0.8), ("J1", 0.5))
}
# These joints move a finger sideways; fingers side by side reach an object without.
SIDEWAYS = ("base", "FFJ4", "MFJ4", "RFJ4", "LFJ4", "LFJ5")


def tips(model: mujoco.MjModel) -> list[int]:
    """The geoms at the ends of the fingers."""
    if mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_GEOM, "f1_tip") >= 0:
        return [model.geom(f"f{i}_tip").id for i in range(1, 5)]
    bodies = [model.body(f"rh_{finger}distal").id for finger in ("ff", "mf", "rf", "lf", "th")]
    return [int(np.flatnonzero(model.geom_bodyid == body)[-1]) for body in bodies]


def reach(model: mujoco.MjModel) -> tuple[mujoco.MjData, np.ndarray, np.ndarray]:
    """Moves each tip to the object within the joints' limits: configuration, distances left (m), nearest points."""
    data = mujoco.MjData(model)
    hinges = np.flatnonzero(model.jnt_type == mujoco.mjtJoint.mjJNT_HINGE)
    places, dofs, (low, high) = model.jnt_qposadr[hinges], model.jnt_dofadr[hinges], model.jnt_range[hinges].T
    names = [model.joint(joint).name.rpartition("_")[2] for joint in hinges]
    data.qpos[places] = np.clip([BENT.get(name, 0.0) for name in names], low, high)
    # The wrist stays.
    weights = np.array([0.0 if "WR" in name else 0.01 if name in SIDEWAYS else 1.0 for name in names])
    distances, nearest = [], []
    for tip in tips(model):
        for _ in range(200):
            distance, here, there = to_object(model, data, tip)
            if abs(distance) < TOUCHING:
                break
            jacobian = np.zeros((3, model.nv))
            mujoco.mj_comPos(model, data)
            mujoco.mj_jac(model, data, jacobian, None, here, model.geom_bodyid[tip])
            jacobian = jacobian[:, dofs]
            weighted = weights[:, None] * jacobian.T
            step = weighted @ np.linalg.solve(jacobian @ weighted + 1e-5 * np.eye(3), there - here)
            data.qpos[places] = np.clip(data.qpos[places] + np.clip(step, -0.1, 0.1), low, high)
        distances.append(abs(distance))
        nearest.append(there)
    mujoco.mj_forward(model, data)
    return data, np.array(distances), np.array(nearest)


def to_object(model: mujoco.MjModel, data: mujoco.MjData, tip: int) -> tuple[float, np.ndarray, np.ndarray]:
    mujoco.mj_kinematics(model, data)
    segment = np.zeros(6)
    distance = mujoco.mj_geomDistance(model, data, tip, model.geom("object").id, 1.0, segment)
    return distance, segment[:3], segment[3:]


@pytest.fixture(scope="module")
def held():
    """The ring hand with its tips on a cube and forces towards the cube's centre."""
    model = four_fingers("box").compile()
    data, _, points = reach(model)
    return model, data.qpos.copy(), points, 80.0 * (data.body("object").xpos - points)


@pytest.fixture(scope="module")
def graphics():
    try:
        with offscreen(mujoco.MjModel.from_xml_string("<mujoco/>"), 8, 8):
            pass
    except RuntimeError as error:
        pytest.skip(str(error))


@pytest.mark.parametrize("scene", [four_fingers, shadow_hand])
@pytest.mark.parametrize("name", OBJECTS)
def test_every_finger_reaches_every_object(scene, name):
    model = scene(name).compile()
    body = model.body("object")
    assert body.mass[0] == pytest.approx(0.1) and np.allclose(body.ipos, 0.0, atol=1e-12)
    assert model.joint("object").type[0] == mujoco.mjtJoint.mjJNT_FREE
    at_rest = mujoco.MjData(model)
    mujoco.mj_forward(model, at_rest)
    assert at_rest.ncon == 0
    data, distances, _ = reach(model)
    assert distances.max() < TOUCHING
    # The object touches nothing but tips; how the Shadow Hand's fingers meet each other is left to the grasp.
    touching = {geom for contact in data.contact for geom in contact.geom if model.geom("object").id in contact.geom}
    assert touching <= {model.geom("object").id, *tips(model)}


@pytest.mark.parametrize("scene", [four_fingers, shadow_hand])
def test_simulation_settings(scene):
    option = scene().compile().opt
    assert (option.timestep, option.impratio) == (1e-3, 100.0)
    assert option.cone == mujoco.mjtCone.mjCONE_ELLIPTIC
    assert option.integrator == mujoco.mjtIntegrator.mjINT_IMPLICITFAST


def test_the_ring_hand_has_an_actuator_for_every_joint():
    model = four_fingers().compile()
    names = [f"f{finger}_{joint}" for finger in range(1, 5) for joint in ("base", "flex1", "flex2")]
    assert [model.actuator(i).name for i in range(model.nu)] == names
    for name in names:
        assert model.actuator(name).trnid[0] == model.joint(name).id
        assert np.array_equal(model.actuator(name).ctrlrange, model.joint(name).range)
        assert model.joint(name).damping[0] == 0.01
    assert [model.geom(f"f{i}_tip").size[0] for i in range(1, 5)] == [0.008] * 4


@pytest.mark.parametrize("name", OBJECTS)
def test_the_ring_hand_holds_an_object_in_gravity(name):
    model = four_fingers(name).compile()
    data, _, _ = reach(model)
    start = data.body("object").xpos.copy()
    data.ctrl[:] = data.actuator_length
    for i in range(1, 5):
        data.ctrl[model.actuator(f"f{i}_flex1").id] += 0.15
        data.ctrl[model.actuator(f"f{i}_flex2").id] += 0.1
    for _ in range(1000):
        mujoco.mj_step(model, data)
    assert np.linalg.norm(data.body("object").xpos - start) < 5e-3
    assert np.abs(data.qvel).max() < 0.02


def test_outer_joints_of_the_shadow_hand_are_coupled():
    free, coupled = shadow_hand().compile(), shadow_hand(coupled_tendons=True).compile()
    assert (free.nu, free.ntendon) == (24, 0)
    assert (coupled.nu, coupled.ntendon) == (20, 4)
    data = mujoco.MjData(coupled)
    for finger in SHADOW_FINGERS:
        data.joint(f"rh_{finger}J2").qpos, data.joint(f"rh_{finger}J1").qpos = 0.5, 0.25
    mujoco.mj_forward(coupled, data)
    for finger in SHADOW_FINGERS:
        tendon, actuator = coupled.tendon(f"rh_{finger}J0"), coupled.actuator(f"rh_A_{finger}J0")
        assert data.tendon(f"rh_{finger}J0").length[0] == pytest.approx(0.75)
        assert (actuator.trntype[0], actuator.trnid[0]) == (mujoco.mjtTrn.mjTRN_TENDON, tendon.id)
        assert actuator.gainprm[0] == 0.5 and actuator.biasprm[1] == -0.5
        assert np.array_equal(actuator.ctrlrange, [0.0, 3.1415]) and np.array_equal(actuator.forcerange, [-1.0, 1.0])
        # Alike torques at both joints: half a newton metre for each radian that is missing.
        data.ctrl[actuator.id] = 1.75
    mujoco.mj_forward(coupled, data)
    for finger in SHADOW_FINGERS:
        torques = [data.qfrc_actuator[coupled.joint(f"rh_{finger}{joint}").dofadr[0]] for joint in ("J2", "J1")]
        assert torques == pytest.approx([0.5, 0.5])


def test_a_missing_shadow_hand_is_named(monkeypatch):
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    with pytest.raises(FileNotFoundError, match="pip install mujoco-mjx"):
        shadow_hand()


@pytest.mark.parametrize(("size", "width"), [(None, 0.06), (0.02, 0.04)])
def test_a_mesh_file_is_centred_and_scaled(tmp_path, size, width):
    solid = trimesh.creation.box((0.06, 0.03, 0.09))
    solid.apply_translation((0.2, 0.1, 0.0))
    path = tmp_path / "solid.stl"
    solid.export(path)
    model = four_fingers(path, size).compile()
    assert np.allclose(model.body("object").ipos, 0.0, atol=1e-9)
    assert sorted(np.ptp(model.mesh_vert, axis=0)) == pytest.approx([0.5 * width, width, 1.5 * width], rel=1e-5)


def test_size_is_half_the_width():
    for name in OBJECTS[:-1]:
        assert four_fingers(name, 0.02).compile().geom("object").size[0] == 0.02
    assert np.ptp(four_fingers("mesh", 0.02).compile().mesh_vert[:, 0]) < 2.0 * 0.024


@pytest.mark.parametrize("scene", [four_fingers, shadow_hand])
def test_wrong_objects_are_refused(scene, tmp_path):
    with pytest.raises(ValueError, match="'teapot', wanted one of sphere, capsule, box, cylinder, ellipsoid, mesh"):
        scene("teapot")
    with pytest.raises(ValueError, match="absent.stl"):
        scene(tmp_path / "absent.stl")
    for size in (0.0, -0.01, np.nan, np.inf):
        with pytest.raises(ValueError, match="size: got"):
            scene("box", size)


@pytest.mark.parametrize(("count", "columns", "rows"), [(1, 1, 1), (3, 2, 2)])
def test_a_picture_is_written(held, graphics, tmp_path, count, columns, rows):
    model, configuration, points, forces = held
    before = model.geom_rgba.copy()
    path = tmp_path / "scenes.png"
    repeated = [np.repeat(array[None], count, axis=0) for array in (configuration, points, forces)]
    repeated[2][-1, 0] = np.nan
    repeated[1][-1, 1] = np.nan
    draw_scenes(path, model, *repeated, [f"grasp {i}" for i in range(count)])
    picture = matplotlib.image.imread(path)
    assert picture.shape[:2] == (round(765 * rows + 45), 720 * columns)
    assert picture[..., :3].std() > 0.05
    assert np.array_equal(model.geom_rgba, before)


def test_a_hand_is_whole_in_its_picture(graphics, tmp_path):
    """Nothing touches the left and right edges, and the hand, without its arm, fills half of the width."""
    model = shadow_hand("capsule").compile()
    points = np.zeros((1, 1, 3))
    for turn in (0.0, 1.0):
        configuration = model.qpos0[None].copy()
        joint = model.joint("rh_WRJ1")
        configuration[0, joint.qposadr[0]] = turn * joint.range[1]
        draw_scenes(tmp_path / "hand.png", model, configuration, points, np.zeros((1, 1, 3)), [""])
        seen = (matplotlib.image.imread(tmp_path / "hand.png")[..., :3] < 0.97).any((0, 2))
        assert not seen[:4].any() and not seen[-4:].any()
        assert seen.mean() > 0.5


def test_a_picture_without_forces(graphics, tmp_path):
    model = shadow_hand("mesh").compile()
    nothing = np.full((1, 5, 3), np.nan)
    draw_scenes(tmp_path / "scene.png", model, model.qpos0[None], nothing, nothing, ["no forces"])
    assert matplotlib.image.imread(tmp_path / "scene.png")[..., :3].std() > 0.05


def test_an_object_without_a_free_joint_is_drawn_where_it_is_named(graphics, tmp_path):
    model = mujoco.MjModel.from_xml_string(
        '<mujoco><worldbody><body name="object"><geom size="0.03"/></body><body pos="0.05 0 0"><joint/>'
        '<geom size="0.02"/></body></worldbody></mujoco>'
    )
    points, forces = np.array([[[0.03, 0, 0]]]), np.array([[[-1.0, 0, 0]]])
    draw_scenes(tmp_path / "object.png", model, model.qpos0[None], points, forces, ["one"], object_body=1)
    assert (tmp_path / "object.png").stat().st_size > 10_000


def test_an_arrow_ends_where_the_contact_is(graphics, tmp_path):
    xml = """<mujoco><worldbody><body><freejoint/><geom size="0.003" rgba="1 0 0 1"/></body></worldbody></mujoco>"""
    model = mujoco.MjModel.from_xml_string(xml)
    path = tmp_path / "arrow.png"
    point, force = np.array([[[-0.003, 0.0, 0.0]]]), np.array([[[4.0, 0.0, 0.0]]])
    draw_scenes(path, model, model.qpos0[None], point, force, [""])
    picture = matplotlib.image.imread(path)
    red, _, blue = (picture[..., i] for i in range(3))
    object_pixels, arrow = np.argwhere(red - blue > 0.3), np.argwhere(blue - red > 0.2)
    distances = np.linalg.norm(arrow - object_pixels.mean(0), axis=-1)
    # 40 mm of arrow that end 3 mm from the centre of a ball that is 6 mm wide.
    millimetre = np.ptp(object_pixels, axis=0).max() / 6
    assert distances.min() < 4 * millimetre
    assert 41 * millimetre < distances.max() < 46 * millimetre


def test_wrong_shapes_are_refused(held, tmp_path):
    model, configuration, points, forces = held
    right = (configuration[None], points[None], forces[None], ["one"])
    for place, wrong, named in ((0, configuration[None, 1:], "configurations"), (2, forces[None, 1:], "forces")):
        with pytest.raises(ValueError, match=f"{named}: got"):
            draw_scenes(tmp_path / "x.png", model, *right[:place], wrong, *right[place + 1 :])
    with pytest.raises(ValueError, match="configurations: got"):
        draw_scenes(tmp_path / "x.png", model, *right[:3], ["one", "two"])
    fixed = mujoco.MjModel.from_xml_string("<mujoco/>")
    with pytest.raises(ValueError, match="free joint"):
        draw_scenes(tmp_path / "x.png", fixed, np.zeros((1, 0)), points[None], forces[None], ["one"])


@pytest.mark.skipif(sys.platform != "linux", reason="elsewhere there is always a display")
def test_without_graphics_the_remedy_is_named(monkeypatch):
    monkeypatch.setenv("MUJOCO_GL", "glfw")
    for name in ("DISPLAY", "WAYLAND_DISPLAY"):
        monkeypatch.delenv(name, raising=False)
    with pytest.raises(RuntimeError, match="MUJOCO_GL=egl"), offscreen(four_fingers().compile(), 8, 8):
        pass
