"""Small hands: one finger of four links whose tip is a sphere, in front of a ball."""

from __future__ import annotations

import mujoco
import numpy as np

TIP = 'type="sphere" size="0.01" contype="1" conaffinity="2"'
FINGER = f"""
<body name="l1" pos="-0.1 0 0">
  <joint name="a" axis="0 0 1"/>
  <geom {TIP} pos="-0.05 0 0"/>
  <site name="s0" pos="0.01 0.012 0"/>
  <body name="l2" pos="0.04 0 0">
    <joint name="b" axis="0 1 0" ref="0.1" stiffness="0.3"/>
    <geom {TIP} pos="0.045 -0.02 0"/>
    <geom name="pulley" type="cylinder" size="0.006 0.02" euler="1.5708 0 0" contype="0" conaffinity="0"/>
    <site name="s1" pos="0.015 0.01 0.008"/>
    <body name="l3" pos="0.03 0 0">
      <joint name="c" axis="1 2 0.5" pos="0.001 0 0.002"/>
      <geom {TIP} pos="0.02 0.02 0"/>
      <site name="s2" pos="0.012 0 0.009"/>
      <body name="l4" pos="0.01 0 0">
        <joint name="d" type="slide" axis="1 0 0.2" stiffness="2"/>
        <geom {TIP} pos="0.01 0 0"/>
        <site name="s3" pos="0.01 0 0"/>
      </body>
    </body>
  </body>
</body>"""
BALL = """
<body name="object" pos="0.0 0 0">
  <freejoint/>
  <geom type="sphere" size="0.012" contype="2" conaffinity="1" mass="0.1"/>
</body>"""


def finger(rest: str = "", objects: str = BALL, links: str = FINGER) -> mujoco.MjModel:
    """The finger and the object, and what else there is."""
    return mujoco.MjModel.from_xml_string(
        f'<mujoco><compiler angle="radian" autolimits="true"/><option gravity="1 2 -9"/>'
        f"<worldbody>{links}{objects}</worldbody>{rest}</mujoco>"
    )


def random_configurations(model: mujoco.MjModel, count: int, seed: int = 0) -> np.ndarray:
    """(count, nq): joints within half a radian, or a few millimetres, of zero; free bodies anywhere near."""
    rng = np.random.default_rng(seed)
    qpos = np.repeat(model.qpos0[None], count, 0)
    for joint in range(model.njnt):
        start, kind = model.jnt_qposadr[joint], model.jnt_type[joint]
        if kind == mujoco.mjtJoint.mjJNT_FREE:
            qpos[:, start : start + 3] += rng.uniform(-0.01, 0.01, (count, 3))
            turn = rng.normal(size=(count, 4))
            qpos[:, start + 3 : start + 7] = turn / np.linalg.norm(turn, axis=-1, keepdims=True)
        else:
            reach = 0.5 if kind == mujoco.mjtJoint.mjJNT_HINGE else 0.005
            qpos[:, start] += rng.uniform(-reach, reach, count)
    return qpos
