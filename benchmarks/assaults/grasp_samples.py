"""Writes the same four grasps in the layout of every format, and says what a reader must make of them."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from benchmarks.assaults.torch_sample import torch_file

COUNT = 4
JOINTS = ("a", "b", "c")
SCALE = 0.08
# A hand whose first link stands elsewhere in its file's world, with two fingers.
HAND = """<mujoco><compiler angle="radian"/><worldbody>
<body name="palm" pos="0.01 0.02 0.034" quat="0.5 0.5 -0.5 0.5"><geom size=".02"/><site name="s"/>
<body name="mount" pos="0 0 0.1"><geom size=".01"/>
<body pos=".05 0 0"><joint name="a"/><geom size=".01"/><body pos="0 0 .05"><joint name="b"/><geom size=".01"/></body>
</body></body><body pos="-.05 0 0"><joint name="c"/><geom size=".01"/></body></body></worldbody></mujoco>"""
PALM = np.array([0.01, 0.02, 0.034, 0.5, 0.5, -0.5, 0.5])


@dataclass(frozen=True)
class Truth:
    """Four grasps; poses are of the hand file's world in the object's frame."""

    base: np.ndarray
    pregrasp: np.ndarray
    grasp: np.ndarray
    squeeze: np.ndarray


def truth(seed: int = 0) -> Truth:
    rng = np.random.default_rng(seed)
    turn = Rotation.random(COUNT, random_state=seed).as_quat()[:, [3, 0, 1, 2]]
    base = np.concatenate([rng.uniform(-0.2, 0.2, (COUNT, 3)), turn], -1).astype(np.float32).astype(float)
    joints = rng.uniform(-1, 1, (3, COUNT, len(JOINTS))).astype(np.float32).astype(float)
    return Truth(base, *joints)


def matrices(poses: np.ndarray) -> np.ndarray:
    out = np.tile(np.eye(4), (len(poses), 1, 1))
    out[:, :3, :3] = Rotation.from_quat(poses[:, [4, 5, 6, 3]]).as_matrix()
    out[:, :3, 3] = poses[:, :3]
    return out


def poses_of(transforms: np.ndarray) -> np.ndarray:
    turn = Rotation.from_matrix(transforms[:, :3, :3]).as_quat()[:, [3, 0, 1, 2]]
    return np.concatenate([transforms[:, :3, 3], turn], -1)


def of_palm(base: np.ndarray) -> np.ndarray:
    """Poses of the palm of `HAND` where its file's world stands so."""
    return poses_of(matrices(base) @ matrices(PALM[None]))


def save(path: Path, value: object) -> Path:
    boxed = np.empty((), object)
    boxed[()] = value
    np.save(path, value if isinstance(value, list) else boxed, allow_pickle=True)
    return path


def stages(t: Truth, row: int | slice = slice(None)) -> dict[str, np.ndarray]:
    found = {"pregrasp_qpos": t.pregrasp, "grasp_qpos": t.grasp, "squeeze_qpos": t.squeeze}
    return {name: np.concatenate([t.base, x], -1)[row].astype(np.float32) for name, x in found.items()}


STANDING = np.array([0.0, 0, 0, 1, 0, 0, 0])


def dexgraspbench(folder: Path, t: Truth, link: Callable) -> Path:
    (folder / "dexgraspbench").mkdir()
    for row in range(COUNT):
        one = {"obj_pose": STANDING, "obj_scale": np.float64(SCALE), "obj_path": "mug"} | stages(t, row)
        save(folder / "dexgraspbench" / f"{row}.npy", one | {"succ_flag": np.bool_(row % 2), "ho_pene": 0.001 * row})
    return folder / "dexgraspbench"


def dexgraspbench_collected(folder: Path, t: Truth, link: Callable) -> Path:
    many = {"obj_pose": np.tile(STANDING, (COUNT, 1)), "obj_scale": np.full(COUNT, SCALE), "obj_path": "mug"}
    return save(folder / "collected.npy", many | stages(t) | {"succ_flag": np.arange(COUNT) % 2 == 1})


def scene(name: str) -> dict:
    thing = {"type": "rigid_object", "file_path": "mug.obj", "scale": np.full(3, SCALE), "pose": STANDING}
    return {"scene": {"mug": thing, "table": {"type": "plane"}}, "task": {"type": "force_closure", "obj_name": name}}


def bodex(folder: Path, t: Truth, link: Callable) -> Path:
    base = link(t.base)
    order = [2, 0, 1]
    steps = np.stack([np.concatenate([base, x[:, order]], -1) for x in (t.pregrasp, t.grasp, t.squeeze)], 1)
    (folder / "scenes").mkdir()
    save(folder / "scenes" / "mug.npy", scene("mug"))
    table = {"robot_pose": steps[None], "joint_names": [JOINTS[k] for k in order], "scene_path": ["scenes/mug.npy"]}
    table |= {"manip_name": "claw", "grasp_error": np.zeros((1, COUNT, 2)), "world_cfg": [{}]}
    return save(folder / "mug_grasp.npy", table)


def dexonomy(folder: Path, t: Truth, link: Callable) -> Path:
    (folder / "dexonomy").mkdir()
    for row in range(COUNT):
        one = {name: x[None] for name, x in stages(t, row).items()}
        one["pregrasp_qpos"] = np.concatenate([one["pregrasp_qpos"], one["grasp_qpos"]])
        one |= {"hand_name": "claw", "tmpl_name": "1_pinch", "obj_cpn_w": np.zeros((3, 6)), "obj_pose": STANDING}
        one |= {"obj_scale": SCALE, "scene_path": "assets/mug/scale008_pose000.npy", "ho_c": {"pos": np.zeros((1, 3))}}
        save(folder / "dexonomy" / f"{row}.npy", one)
    return folder / "dexonomy"


def dexonomy_legacy(folder: Path, t: Truth, link: Callable) -> Path:
    (folder / "legacy").mkdir()
    for row in range(COUNT):
        one = {name: x[None] for name, x in stages(t, row).items()}
        one |= {"hand_type": "claw", "evolution_num": 3, "hand_template_name": "1_pinch", "scene_cfg": scene("mug")}
        save(folder / "legacy" / f"{row}.npy", one)
    return folder / "legacy"


def dexgraspnet(folder: Path, t: Truth, link: Callable) -> Path:
    base = link(t.base)
    angles = Rotation.from_quat(base[:, [4, 5, 6, 3]]).as_euler("xyz")
    rows = []
    for row in range(COUNT):
        qpos = {"c": t.grasp[row, 2]} | dict(zip(("WRJRx", "WRJRy", "WRJRz"), angles[row], strict=True))
        qpos |= dict(zip(("WRJTx", "WRJTy", "WRJTz"), base[row], strict=False)) | {"a": t.grasp[row, 0]}
        rows.append({"qpos": qpos | {"b": t.grasp[row, 1]}, "scale": np.float64(SCALE), "E_fc": 0.5})
    return save(folder / "mug.npy", rows)


def dexgraspnet2(folder: Path, t: Truth, link: Callable) -> Path:
    place = matrices(link(t.base))
    joints = dict(zip(JOINTS, t.grasp.T, strict=True))
    np.savez(folder / "mug.npz", point=np.zeros((COUNT, 3)), translation=place[:, :3, 3], rotation=place[:, :3, :3],
             **joints)  # fmt: skip
    return folder / "mug.npz"


def graspqp(folder: Path, t: Truth, link: Callable) -> Path:
    joints = dict(zip(JOINTS, t.grasp.T, strict=True))
    table = {"values": np.arange(float(COUNT)), "parameters": {"root_pose": link(t.base)} | joints}
    table |= {"grasp_velocities": {name: np.ones(COUNT) for name in JOINTS}, "contact_links": ["x"], "grasp_type": None}
    torch_file(folder / "mug.dexgrasp.pt", table)
    return folder / "mug.dexgrasp.pt"


def isaac_grasp(folder: Path, t: Truth, link: Callable) -> Path:
    base = link(t.base)
    lines = ["format: isaac_grasp", "format_version: 1.0", "object_frame: /World/mug", "gripper_frame_link: palm"]
    lines += ["object_file: mug", f"object_scale: {SCALE}", "grasps:"]
    for row in range(COUNT):
        x, y, z, w, *turn = map(float, base[row])
        lines += [f'  "grasp_{row}":', f"    confidence: {row / 4}", f"    position: [{x}, {y}, {z}]"]
        lines += [f"    orientation: {{w: {w}, xyz: {turn}}}"]
        for field, joints in (("cspace_position", t.grasp), ("pregrasp_cspace_position", t.pregrasp)):
            lines += [f"    {field}:", *(f"      {JOINTS[k]}: {float(joints[row, k])!r}" for k in (1, 2, 0))]
    (folder / "mug.yaml").write_text("\n".join(lines) + "\n")
    return folder / "mug.yaml"


def multigrippergrasp(folder: Path, t: Truth, link: Callable) -> Path:
    # PhysX counts a and c, which hang nearer to the palm, before b.
    table = {"gripper": "claw", "object_ID": "mug", "pose": link(t.base).tolist(), "physics_dt": 0.01}
    table |= {"dofs": t.grasp[:, [2, 0, 1]].tolist(), "result": [True] * COUNT, "result_time": [1.0, None, 2, 3]}
    (folder / "claw-mug.json").write_text(json.dumps(table))
    return folder / "claw-mug.json"


def graspgen(folder: Path, t: Truth, link: Callable) -> Path:
    grasps = {"transforms": matrices(link(t.base)).tolist(), "object_in_gripper": [True, False, True, True]}
    (folder / "mug.json").write_text(json.dumps({"object": {"file": "mug", "scale": SCALE}, "grasps": grasps}))
    return folder / "mug.json"


def acronym(folder: Path, t: Truth, link: Callable) -> Path:
    import h5py

    with h5py.File(folder / "mug.h5", "w") as file:
        file["object/file"], file["object/scale"] = "mug", SCALE
        file["grasps/transforms"] = matrices(link(t.base))
        file["grasps/qualities/flex/object_in_gripper"] = np.array([1, 0, 1, 1])
    return folder / "mug.h5"


def get_a_grip(folder: Path, t: Truth, link: Callable) -> Path:
    place = matrices(link(t.base))
    # Sixteen joints; the three of ours are the first.
    joints = np.concatenate([t.grasp, np.zeros((COUNT, 13))], -1)
    table = {"trans": place[:, :3, 3], "rot": place[:, :3, :3], "joint_angles": joints, "loss": np.ones(COUNT)}
    table |= {"y_PGS": np.linspace(0, 1, COUNT), "grasp_orientations": np.zeros((COUNT, 4, 3, 3))}
    return save(folder / "mug_0_0800.npy", table)


def graspit(folder: Path, t: Truth, link: Callable) -> Path:
    base = link(t.base)[0]
    x, y, z = (1000 * base[:3]).tolist()
    w, *turn = base[3:].tolist()
    values = " ".join(f"{value!r} 0" for value in t.grasp[0].tolist())
    text = f"""<?xml version="1.0" ?><world><graspableBody><filename>mug</filename><transform><fullTransform>
    (+1 +0 +0 +0)[+0 +0 +0]</fullTransform></transform></graspableBody><robot><filename>claw.xml</filename>
    <dofValues>{values}</dofValues><transform><fullTransform>({w!r} {turn[0]!r} {turn[1]!r} {turn[2]!r})
    [{x!r} {y!r} {z!r}]</fullTransform></transform></robot><camera><position>+0 0 0</position></camera></world>"""
    (folder / "mug.xml").write_text(text)
    return folder / "mug.xml"


SAMPLES = {
    "dexgraspbench": dexgraspbench,
    "dexgraspbench collected": dexgraspbench_collected,
    "bodex": bodex,
    "dexonomy": dexonomy,
    "dexonomy legacy": dexonomy_legacy,
    "dexgraspnet": dexgraspnet,
    "dexgraspnet2": dexgraspnet2,
    "get_a_grip": get_a_grip,
    "graspqp": graspqp,
    "isaac_grasp": isaac_grasp,
    "multigrippergrasp": multigrippergrasp,
    "graspgen": graspgen,
    "acronym": acronym,
    "graspit": graspit,
}
# Of formats whose pose is that of a link.
OF_LINK = set(SAMPLES) - {"dexgraspbench", "dexgraspbench collected", "dexonomy", "dexonomy legacy"}
