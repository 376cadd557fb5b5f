"""Which hands load and rank, and which are refused? `python -m benchmarks.hands_that_load [FILE[:BODY] ...]`.

Hands get a ball of 6 cm; a FILE with a body named "object", or BODY, is a scene of its own with that as the object.
`jaxgrasp rank` ranks random configurations of each: joints anywhere in the middle of their ranges, the object between
the outermost links. Writes hands_that_load.md beside this file.
"""

from __future__ import annotations

import argparse
import subprocess
import sys
import tempfile
import warnings
from pathlib import Path

import mujoco
import numpy as np

import jaxgrasp as jg
from jaxgrasp.hands import HandObject, Scene
from jaxgrasp.hands.bodies import bodies_below

WIDTH, COUNT = 0.06, 24
# Shares of the ranges of joints, and how far the object is moved from the middle of the outermost links, m.
MIDDLE, SHIFT = (0.2, 0.8), 0.01
PADS = '<geom type="box" size=".01 .012 .02" pos="0 0 .02"/>'
# Two slides that one tendon drives and an equality couples, as in the Panda's hand.
PANDA_LIKE = f"""<mujoco><worldbody><body name="hand"><geom type="box" size=".03 .1 .03" pos="0 0 -.06"/>
<body name="left"><joint name="left" type="slide" axis="0 1 0" range="0 .04"/>
<body name="pad_l" pos="0 .01 0">{PADS}</body></body>
<body name="right"><joint name="right" type="slide" axis="0 -1 0" range="0 .04"/>
<body name="pad_r" pos="0 -.01 0">{PADS}</body></body></body></worldbody><tendon><fixed name="split">
<joint joint="left" coef=".5"/><joint joint="right" coef=".5"/></fixed></tendon>
<equality><joint joint1="left" joint2="right"/></equality><actuator>
<general tendon="split" forcerange="-100 100" ctrlrange="0 255" gainprm=".0157" biastype="affine" biasprm="0 -100 -10"/>
</actuator></mujoco>"""
FINGER = """<body name="driver_{s}" pos="0 {y} 0"><joint name="driver_{s}" axis="{a} 0 0" range="0 .8"/>
<geom type="capsule" size=".006" fromto="0 0 0 0 {o} .04"/><body name="follower_{s}" pos="0 {o} .04">
<joint name="follower_{s}" axis="{a} 0 0" range="-.8 .8"/><geom type="box" size=".011 .004 .02" pos="0 0 .02"/></body>
</body>{coupler}"""
COUPLER = """<body name="coupler_{s}" pos="0 {c} 0"><joint name="coupler_{s}" axis="{a} 0 0"/>
<geom type="capsule" size=".004" fromto="0 0 0 0 {o} .05" contype="0" conaffinity="0"/></body>"""


def robotiq_like(closed_linkage: bool) -> str:
    """Two fingers as in the 2F-85: drivers coupled by an equality; pads follow by a four-bar, or by an equality."""
    fingers, rest = "", '<joint joint1="driver_r" joint2="driver_l"/>'
    for s, y, a in (("l", 0.03, 1), ("r", -0.03, -1)):
        side = {"s": s, "y": y, "a": a, "o": 0.03 * np.sign(y), "c": 0.5 * y}
        coupler = COUPLER.format(**side) if closed_linkage else ""
        fingers += FINGER.format(**side, coupler=coupler)
        if closed_linkage:
            rest += f'<connect name="bar_{s}" body1="coupler_{s}" body2="follower_{s}" anchor="0 {side["o"]} .05"/>'
        else:
            rest += f'<joint joint1="follower_{s}" joint2="driver_{s}" polycoef="0 -1 0 0 0"/>'
    return (
        f'<mujoco><compiler angle="radian"/><worldbody><body name="base"><geom type="box" size=".02 .04 .01" '
        f'pos="0 0 -.02"/>{fingers}</body></worldbody><tendon><fixed name="split"><joint joint="driver_l" coef=".5"/>'
        f'<joint joint="driver_r" coef=".5"/></fixed></tendon><equality>{rest}</equality><actuator><general '
        'tendon="split" forcerange="-5 5" ctrlrange="0 255" gainprm=".3137" biastype="affine" biasprm="0 -100 -10"/>'
        "</actuator></mujoco>"
    )


HANDS = {
    "four_fingers (built in)": "four_fingers",
    "shadow_hand (mujoco-mjx)": "shadow_hand",
    "Panda-like, coupled slides": PANDA_LIKE,
    "2F-85-like, couplings": robotiq_like(False),
    "2F-85-like, four-bar (connect)": robotiq_like(True),
}


def scene_of(hand: str, folder: Path) -> tuple[str, str]:
    """The file of a scene with the hand, and the object's body in it."""
    path, _, body = hand.partition(":") if not hand.startswith("<mujoco") else (hand, "", "")
    if Path(path).is_file():
        # Files of other kinds are refused where they are ranked.
        try:
            names = [each.name for each in mujoco.MjSpec.from_file(path).bodies]
        except ValueError:
            return path, "object"
        if body or "object" in names:
            return path, body or "object"
    given = mujoco.MjSpec.from_string(hand) if hand.startswith("<mujoco") else path
    scene = Scene.build(hand=given, object="sphere", scale=WIDTH, mass=0.1, base="fixed", gravity=(0, 0, 0))
    scene.save(folder / "scene.xml")
    return str(folder / "scene.xml"), "object"


def configurations(hand: HandObject) -> np.ndarray:
    """Random ones (COUNT, nq)."""
    random, model, data = np.random.default_rng(0), hand.model, mujoco.MjData(hand.model)
    places, limited = model.jnt_qposadr[hand.joints], model.jnt_limited[hand.joints].astype(bool)
    low, high = model.jnt_range[hand.joints].T
    outermost = np.array([b for b in hand.touching_links if not np.isin(b, model.body_parentid)])
    # Fingers are at the ends of the longest chains.
    length = hand.moved_bodies[outermost].sum(-1)
    outermost = outermost[length >= 0.7 * length.max()]
    found = np.tile(model.qpos0, (COUNT, 1))
    for qpos in found:
        share = random.uniform(*MIDDLE, len(places))
        qpos[places] = np.where(limited, low + share * (high - low), model.qpos0[places])
        data.qpos = qpos
        follow(model, data)
        mujoco.mj_kinematics(model, data)
        goal = data.xipos[outermost].mean(0) + random.uniform(-SHIFT, SHIFT, 3)
        move_object(hand, data, goal - data.xipos[hand.object_body])
        qpos[:] = data.qpos
    return found


def follow(model: mujoco.MjModel, data: mujoco.MjData) -> None:
    """Puts joints where their couplings to others want them."""
    for equality in np.flatnonzero(model.eq_active0 & (model.eq_type == int(mujoco.mjtEq.mjEQ_JOINT))):
        ends = model.eq_obj1id[equality], model.eq_obj2id[equality]
        follower, leader = (model.jnt_qposadr[joint] for joint in ends)
        moved = 0.0 if ends[1] < 0 else data.qpos[leader] - model.qpos0[leader]
        data.qpos[follower] = model.qpos0[follower] + np.polynomial.Polynomial(model.eq_data[equality, :5])(moved)


def move_object(hand: HandObject, data: mujoco.MjData, shift: np.ndarray) -> None:
    """Moves the object, by a free joint or by slides, as far as it has them."""
    model = hand.model
    joints = np.flatnonzero(np.isin(model.jnt_bodyid, bodies_below(model, hand.object_body)))
    for joint in joints:
        start = model.jnt_qposadr[joint]
        if model.jnt_type[joint] == mujoco.mjtJoint.mjJNT_FREE:
            data.qpos[start : start + 3] += shift
        elif model.jnt_type[joint] == mujoco.mjtJoint.mjJNT_SLIDE:
            data.qpos[start] += shift @ data.xaxis[joint]


def row(name: str, hand: str) -> str:
    """One row of the table."""
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(temporary)
        try:
            with warnings.catch_warnings():
                # The command line says the same.
                warnings.simplefilter("ignore", UserWarning)
                scene, body = scene_of(hand, folder)
                found = HandObject.from_mjcf(scene, body)
        except ValueError as error:
            path = hand.partition(":")[0]
            return f"| {name} | refused | | | | {' '.join(str(error).replace(path, Path(path).name).split())} |"
        np.savez(folder / "configurations.npz", qpos=configurations(found))
        options = ["--figure", "None", "--picture", "None", "--min-contacts", "0", "--max-penetration", "1"]
        files = ["--qpos", str(folder / "configurations.npz"), "--output", str(folder / "table.npz")]
        command = [sys.executable, "-m", "jaxgrasp.cli", "rank", "--scene", scene, "--object-body", body]
        ran = subprocess.run([*command, *files, *options], capture_output=True, text=True)
        said = [line.removeprefix("jaxgrasp: ") for line in ran.stderr.splitlines() if "scene:" in line]
        if ran.returncode:
            return f"| {name} | exit {ran.returncode} | | | | {ran.stderr.splitlines()[-1]} |"
        with np.load(folder / "table.npz") as table:
            columns = {column: table[column] for column in ("status", "margin", "touching")}
    grasps = found.grasps(found.model.qpos0[None], "mujoco")
    efforts = "none" if grasps.actuation is None else str(grasps.actuation.transmission.shape[-1])
    counts = {status.name: int((columns["status"] == status.name).sum()) for status in jg.Status}
    statuses = ", ".join(f"{count} {status}" for status, count in counts.items() if count)
    cells = [name, f"{len(found.joints)}, {len(found.actuators)}, {efforts}", f"{np.median(columns['touching']):g}"]
    cells += [statuses, f"{np.nanmax(columns['margin'], initial=-np.inf):.3f}", " ".join(said)]
    return "| " + " | ".join(cells) + " |"


def main() -> None:
    """Writes the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("files", nargs="*", help="more hands, or FILE:BODY, scenes with their object; MJCF or URDF")
    options = parser.parse_args()
    lines = [
        "# Hands that load and rank",
        "",
        f"{COUNT} random configurations of each, ranked by `jaxgrasp rank`: joints in the middle "
        f"{MIDDLE[1] - MIDDLE[0]:.0%} of their ranges, the object within {100 * SHIFT:g} cm of the middle of the "
        f"outermost links; a ball of {100 * WIDTH:g} cm without gravity, or a scene's own object with its weight. "
        "Statuses say that ranking works to the end, not how good the hands are: random grasps reach deep into the "
        "object, or bear no weight. Made by `python -m benchmarks.hands_that_load`.",
        "",
        "| hand | joints, actuators, efforts | links that touch, median | statuses | best margin, N | said |",
        "|---|---|---|---|---|---|",
    ]
    hands = HANDS | {"/".join(Path(file).parts[-3:]): file for file in options.files}
    for name, hand in hands.items():
        lines.append(row(name, hand))
        print(lines[-1], flush=True)
        Path(__file__).with_suffix(".md").write_text("\n".join([*lines, ""]))


if __name__ == "__main__":
    main()
