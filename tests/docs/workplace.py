"""The files that a reader of the documentation is taken to have: a hand, an object, grasps and candidates."""

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np
import pyarrow
import pyarrow.parquet
import trimesh
from documented import ROOT, blocks

import jaxgrasp.hands as hands
from jaxgrasp.candidates import sample_grasps
from jaxgrasp.files import read_grasps, write_grasps

GRASPS = 6


def write_grasps_of_a_can(folder: Path) -> None:
    """A can of convex pieces, and grasps of it in the layout of DexGraspBench."""
    write_hands(folder)
    (folder / "can" / "pieces").mkdir(parents=True)
    trimesh.creation.cylinder(radius=0.5, height=1.0, sections=24).export(folder / "can" / "pieces" / "0.obj")
    grasps_of_the_can(folder)


def write_hands(folder: Path) -> None:
    for name in ("right_hand.xml", "shadow.xml"):
        shutil.copy(Path(hands.__file__).parent / "four_fingers.xml", folder / name)


def write_candidates(folder: Path) -> None:
    """Hands, candidates in archives and tables, and a mesh."""
    write_hands(folder)
    trimesh.creation.icosphere(subdivisions=2, radius=0.03).export(folder / "object.stl")
    found = sample_grasps(64, seed=0)
    fields = {"positions": found.positions, "outward_normals": found.outward_normals, "mass": np.full(64, 0.2)}
    fields["success"] = np.arange(64) % 3 == 0
    (folder / "grasps").mkdir()
    (folder / "old").mkdir()
    for path in ("grasps.npz", "more.npz", "grasps/some.npz", "old/others.npz"):
        np.savez(folder / path, friction=0.6, max_force=5.0, **fields)
    # The file of the page that tells of such files.
    (folder / "errors.json").write_text(
        next(block.code for block in blocks(ROOT / "docs" / "uncertainty.md") if block.language == "json")
    )
    table = pyarrow.table({name: np.asarray(array).tolist() for name, array in fields.items()})
    table = table.append_column("friction", [np.full(64, 0.6)]).append_column("max_force", [np.full(64, 5.0)])
    for name in ("grasps.parquet", "more.parquet"):
        pyarrow.parquet.write_table(table, folder / name)


def grasps_of_the_can(folder: Path) -> None:
    """Fingers bent inwards until they touch a can of 5 cm, in the layout of DexGraspBench, one file a grasp."""
    scene = hands.Scene.build(hand=str(folder / "right_hand.xml"), object=str(folder / "can" / "pieces"), scale=0.05)
    # Tips of 8 mm at the end of fingers of 105 mm, whose roots are 60 mm from the axis; then up to 0.5 mm deep.
    bent = np.arcsin((0.06 - 0.033) / 0.105) + 0.001 * np.arange(GRASPS)
    joints = np.zeros((GRASPS, len(scene.joint_names)))
    joints[:, [name.endswith("flex1") for name in scene.joint_names]] = bent[:, None]
    base = np.tile([0.0, 0, 0, 1, 0, 0, 0], (GRASPS, 1))
    placed = np.tile([0.0, 0, 0.1, 1, 0, 0, 0], (GRASPS, 1))
    scene.save(folder / "my_scene.xml")
    np.savez(folder / "configurations.npz", qpos=scene.qpos(base=base, joints=joints, object=placed))
    np.savez(
        folder / "all.npz",
        grasp_qpos=np.concatenate([base, joints], -1),
        obj_pose=placed,
        obj_scale=np.full(GRASPS, 0.05),
        object_name=np.full(GRASPS, "can"),
        joint_names=np.array(scene.joint_names),
    )
    write_grasps(read_grasps(folder / "all.npz"), folder / "bench", "dexgraspbench", hand=folder / "right_hand.xml")
    files = sorted((folder / "bench").rglob("*.npy"))
    for number, path in enumerate(files):
        shutil.copy(path, folder / "can" / f"{number}.npy")
    (folder / "more").mkdir()
    (folder / "old" / "of").mkdir(parents=True)
    for name in ("banana.npy", "more/one.npy", "old/of/two.npy"):
        shutil.copy(files[0], folder / name)
    (folder / "all.npz").unlink()
    shutil.rmtree(folder / "bench")
