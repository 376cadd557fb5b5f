"""Which hands load and rank, and which are refused? `python -m benchmarks.hands_that_load [FILE ...]`.

Hands get a ball of 6 cm between their outermost links, joints half closed; a FILE that has a body named "object" is a
scene of its own, ranked as it stands. Writes hands_that_load.md beside this file.
"""

from __future__ import annotations

import argparse
import warnings
from pathlib import Path

import jax
import mujoco
import numpy as np

jax.config.update("jax_enable_x64", True)

import jaxgrasp as jg  # noqa: E402
from jaxgrasp.hands import HandObject, Scene  # noqa: E402

PUSHES = jg.DisturbanceSet.forces(1.0)
WIDTH, CONTACTS = 0.06, 4
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


def scene_of(hand: str) -> tuple[HandObject, np.ndarray]:
    """The hand with an object, and a configuration (nq,)."""
    if Path(hand).suffix == ".xml" and "object" in (body.name for body in mujoco.MjSpec.from_file(hand).bodies):
        found = HandObject.from_mjcf(hand, "object", max_contacts=CONTACTS)
        return found, found.model.qpos0
    given = mujoco.MjSpec.from_string(hand) if hand.startswith("<mujoco") else hand
    scene = Scene.build(hand=given, object="sphere", scale=WIDTH, mass=0.1, base="fixed", gravity=(0, 0, 0))
    found, model = scene.hand_object(max_contacts=CONTACTS), scene.model
    data, places = mujoco.MjData(model), model.jnt_qposadr[found.joints]
    limited = model.jnt_limited[found.joints].astype(bool)
    data.qpos[places] = np.where(limited, model.jnt_range[found.joints].mean(-1), model.qpos0[places])
    mujoco.mj_kinematics(model, data)
    outermost = [b for b in found.touching_links if not np.isin(b, model.body_parentid)]
    middle = data.xipos[outermost].mean(0)
    return found, scene.qpos(joints=data.qpos[places], object=np.r_[middle, 1, 0, 0, 0])[0]


def row(name: str, hand: str) -> str:
    """One row of the table."""
    with warnings.catch_warnings(record=True) as told:
        warnings.simplefilter("always")
        try:
            found, qpos = scene_of(hand)
            grasps = found.grasps(qpos[None], "mujoco")
            weight = grasps.required_wrench
            answer = jg.largest_disturbance(grasps.contacts, PUSHES, required_wrench=weight, actuation=grasps.actuation)
        except ValueError as error:
            return f"| {name} | refused | | | | {' '.join(str(error).split())} |"
    notes = " ".join(sorted({str(w.message) for w in told if w.category is UserWarning}))
    efforts = "none" if grasps.actuation is None else str(grasps.actuation.transmission.shape[-1])
    cells = [name, f"{len(found.joints)}, {len(found.actuators)}, {efforts}", str(int(grasps.touching[0]))]
    cells += [jg.Status(int(answer.status[0])).name, f"{float(answer.margin[0]):.3f}", notes]
    return "| " + " | ".join(cells) + " |"


def main() -> None:
    """Writes the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("files", nargs="*", help="more hands, or scenes with a body named object; MJCF or URDF")
    options = parser.parse_args()
    lines = [
        "# Hands that load",
        "",
        f"A ball of {100 * WIDTH:g} cm between half-closed links, without gravity; scenes of their own as they stand; "
        f"the {CONTACTS} nearest links. Statuses say that ranking works, not how good the hands are. Made by "
        "`python -m benchmarks.hands_that_load`.",
        "",
        "| hand | joints, actuators, efforts | links that touch | status | margin, N | said |",
        "|---|---|---|---|---|---|",
    ]
    hands = HANDS | {"/".join(Path(file).parts[-3:]): file for file in options.files}
    for name, hand in hands.items():
        lines.append(row(name, hand))
        print(lines[-1], flush=True)
        Path(__file__).with_suffix(".md").write_text("\n".join([*lines, ""]))


if __name__ == "__main__":
    main()
