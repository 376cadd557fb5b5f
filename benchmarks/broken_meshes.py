"""Breaks meshes in five ways each and reads them: `python -m benchmarks.broken_meshes [FILES] [FOLDERS]`.

A ball, a box and a cylinder, and those of the given mesh files and of the folders' files that are whole; 25 meshes at
most. Broken are they one way at a time: faces flipped, faces cut out, faces twice, a smaller copy nested inside, stray
triangles metres away. Volume and mass centre are held against those of the whole mesh by tetrahedra. Writes
broken_meshes.md beside this file.
"""

from __future__ import annotations

import argparse
import warnings
from pathlib import Path

import numpy as np
import trimesh

from jaxgrasp.geometry import Mesh, MeshError

MOST = 25
# Shares of faces that are flipped, cut out, and there twice.
FLIPPED, CUT_OUT, TWICE = 0.3, 0.05, 0.4
STRAYS = 5
CLOSE = 0.01
GIVEN = (".stl", ".obj", ".ply")


def whole_meshes(paths: list[Path]) -> dict[str, trimesh.Trimesh]:
    found = {
        "ball": trimesh.creation.icosphere(subdivisions=4, radius=0.05),
        "box": trimesh.creation.box(extents=(0.1, 0.06, 0.08)).subdivide().subdivide().subdivide(),
        "cylinder": trimesh.creation.cylinder(radius=0.03, height=0.12, sections=64).subdivide().subdivide(),
    }
    files = [f for path in paths for f in (sorted(path.rglob("*")) if path.is_dir() else [path])]
    for path in (f for f in files if f.suffix.lower() in GIVEN):
        mesh = trimesh.load(path, force="mesh")
        # Others have no volume that is known.
        if len(found) < MOST and mesh.is_volume and mesh.body_count == 1:
            found[path.stem] = mesh
    return found


def broken(mesh: trimesh.Trimesh, way: str, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    vertices, faces = np.array(mesh.vertices), np.array(mesh.faces)
    chosen = rng.random(len(faces))
    if way == "flips":
        return vertices, np.where((chosen < FLIPPED)[:, None], faces[:, ::-1], faces)
    if way == "holes":
        return vertices, faces[chosen >= CUT_OUT]
    if way == "doubles":
        again = faces[chosen < TWICE]
        return vertices, np.concatenate([faces, np.where(rng.random(len(again))[:, None] < 0.5, again[:, ::-1], again)])
    if way == "nests":
        places = rng.uniform(vertices.min(0), vertices.max(0), (2000, 3))
        depth = Mesh.from_arrays(vertices, faces).signed_distance(places)
        deepest = places[depth.argmin()]
        smaller = 0.8 * -depth.min() / np.linalg.norm(vertices - mesh.center_mass, axis=-1).max()
        inner = deepest + smaller * (vertices - mesh.center_mass)
        return np.concatenate([vertices, inner]), np.concatenate([faces, faces + len(vertices)])
    extent = np.ptp(vertices, axis=0).max()
    places = rng.uniform(10, 100, (STRAYS, 1, 3)) * extent + 0.1 * extent * rng.normal(size=(STRAYS, 3, 3))
    added = len(vertices) + np.arange(3 * STRAYS).reshape(-1, 3)
    return np.concatenate([vertices, places.reshape(-1, 3)]), np.concatenate([faces, added])


WAYS = ("flips", "holes", "doubles", "nests", "strays")


def main() -> None:
    options = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    options.add_argument("paths", nargs="*", type=Path)
    meshes = whole_meshes(options.parse_args().paths)
    rng = np.random.default_rng(0)
    rows, close, refused = [], 0, 0
    for name, mesh in meshes.items():
        cells = []
        for way in WAYS:
            try:
                with warnings.catch_warnings(action="ignore"):
                    found = Mesh.from_arrays(*broken(mesh, way, rng))
                    volume, centre = found.volume, found.centroid
            except MeshError as error:
                cells.append(f"refused: {error}")
                refused += 1
                continue
            extent = np.ptp(mesh.vertices, axis=0).max()
            off = volume / mesh.volume - 1, np.linalg.norm(centre - mesh.center_mass) / extent
            close += max(abs(off[0]), off[1]) <= CLOSE
            cells.append(f"{100 * off[0]:z.2f}, {100 * off[1]:z.2f}")
        rows.append(f"| {name} | {len(mesh.faces):,} | " + " | ".join(cells) + " |")
        print(rows[-1])
    count = len(WAYS) * len(meshes)
    lines = [
        "# Broken meshes",
        "",
        f"Made by `python -m benchmarks.broken_meshes FILES FOLDERS`: {len(meshes)} meshes broken in {len(WAYS)} ways. "
        f"{FLIPPED:.0%} of the faces flipped; {CUT_OUT:.0%} of them cut out; {TWICE:.0%} there twice, half of these "
        f"the other way round; a smaller copy nested inside; {STRAYS} stray triangles 10 to 100 extents away.",
        "",
        f"**{close} of {count} within {CLOSE:.0%}, {refused} refused.** Percent that the volume is off that of "
        "the whole mesh, and percent of the extent that the mass centre is off.",
        "",
        f"| mesh | triangles | {' | '.join(WAYS)} |",
        "|---" * (2 + len(WAYS)) + "|",
        *rows,
        "",
    ]
    Path(__file__).with_suffix(".md").write_text("\n".join(lines))


if __name__ == "__main__":
    main()
