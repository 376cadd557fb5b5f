"""The frames that files of grasps tell poses of, drawn: world, object, hand file, and the first link of the hand."""

from pathlib import Path

import matplotlib.pyplot as plt
import mujoco
import numpy as np
from matplotlib.transforms import Bbox
from mpl_toolkits.mplot3d import proj3d

from jaxgrasp.files import GraspSet, HandPoses, read_grasps, write_grasps
from jaxgrasp.files import frames as f

FINGER = """<body name="{0}" pos="{1} 0 .09"><joint name="{0}1" axis="1 0 0"/><geom size=".01"/>
<body name="{0}m" pos="0 0 .045"><joint name="{0}2" axis="1 0 0"/><geom size=".01"/>
<body name="{0}t" pos="0 0 .035"><geom size=".01"/></body></body></body>"""
HAND = f"""<mujoco><worldbody><body name="palm" pos="0 0 .06"><geom size=".02"/>
{FINGER.format("f", 0.03)}{FINGER.format("m", 0.0)}{FINGER.format("r", -0.03)}</body></worldbody></mujoco>"""
OBJECT = np.array([0.30, 0.22, 0.12, np.cos(0.5), 0.0, 0.0, np.sin(0.5)])

# One grasp: the hand file's world in the object's frame, and from there in the world.
turn = f.multiply(np.array([np.cos(0.8), 0.0, np.sin(0.8), 0.0]), np.array([0.6, 0.0, 0.0, 0.8]))
base = f.compose(OBJECT, np.concatenate([[-0.2, 0.02, 0.02], turn]))[None]
names = tuple(f"{finger}{k}" for finger in "fmr" for k in (1, 2))
stages = {"pregrasp": HandPoses(base, np.full((1, 6), 0.1)), "grasp": HandPoses(base, np.full((1, 6), 0.5))}
grasps = GraspSet(stages, names, OBJECT[None], np.array([0.08]), np.array(["mug"]), np.array(["here:0"]), {})

# Written as others have it, and read again: the same to float32.
Path("hand.xml").write_text(HAND)
write_grasps(grasps, "bench", "dexgraspbench", hand="hand.xml")
back = read_grasps("bench")
print("the base is back within", f"{np.abs(back.stages['grasp'].base - base).max():.0e} m")

model = mujoco.MjModel.from_xml_string(HAND)
data = mujoco.MjData(model)
data.qpos[:] = grasps.stages["grasp"].joints[0]
mujoco.mj_kinematics(model, data)
places = base[0, :3] + f.rotate(base[0, 3:], data.xpos)

figure = plt.figure(figsize=(9, 6.4), layout="constrained")
axes = figure.add_subplot(projection="3d", computed_zorder=False)
for body in range(2, model.nbody):
    axes.plot(*places[[model.body_parentid[body], body]].T, color="0.65", lw=9, solid_capstyle="round", zorder=1)
u, v = np.mgrid[0 : 2 * np.pi : 30j, 0 : np.pi : 15j]
ball = 0.04 * np.stack([np.cos(u) * np.sin(v), np.sin(u) * np.sin(v), 1.2 * np.cos(v)]) + OBJECT[:3, None, None]
axes.plot_surface(*ball, color="tab:olive", alpha=0.3, zorder=0)

palm = f.compose(base[0], np.array([0.0, 0.0, 0.06, 1.0, 0.0, 0.0, 0.0]))
LABELS = {
    "world": (np.array(f.standing(1)[0]), (-8, -30)),
    "object's frame\n(object_pose)": (OBJECT, (45, -30)),
    "world of the hand's file\n(base)": (base[0], (-150, -20)),
    "first link of the hand\n(what BODex, DexGraspNet, GraspQP, ... tell)": (palm, (-250, 90)),
}
for pose, _ in LABELS.values():
    for axis, color in zip(np.eye(3), ("tab:red", "tab:green", "tab:blue"), strict=True):
        tip = pose[:3] + f.rotate(pose[3:], 0.05 * axis)
        axes.plot(*np.stack([pose[:3], tip]).T, color=color, lw=2.5, zorder=3)
axes.plot(*np.stack([np.zeros(3), OBJECT[:3]]).T, "k:", lw=1, zorder=2)
axes.plot(*np.stack([np.zeros(3), base[0, :3]]).T, "k:", lw=1, zorder=2)
axes.plot(*np.stack([OBJECT[:3], base[0, :3]]).T, "k--", lw=1, zorder=2)
axes.set_box_aspect(np.ptp(np.vstack([places, OBJECT[:3] + 0.05, np.zeros(3)]), axis=0), zoom=1.15)
axes.view_init(22, -62)
axes.set_axis_off()
figure.canvas.draw()
for label, (pose, shift) in LABELS.items():
    x, y, _ = proj3d.proj_transform(*pose[:3], axes.get_proj())
    arrow = {"arrowstyle": "-", "color": "0.4"}
    axes.annotate(label, (x, y), shift, textcoords="offset points", fontsize=10, arrowprops=arrow, zorder=5)
# Without the white above and below, which is part of the axes.
figure.savefig("grasp_frames.png", dpi=110, bbox_inches=Bbox([[1.3, 1.4], [8.6, 5.3]]))
print("written: grasp_frames.png")
