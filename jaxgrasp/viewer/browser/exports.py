"""Grasps for other programs: glTF and USD with all that the page draws, and MuJoCo keyframes."""

import json
import re
import struct
from collections.abc import Sequence
from pathlib import Path
from xml.sax.saxutils import quoteattr

import numpy as np
from jaxtyping import Float

from jaxgrasp.storage import atomic_write
from jaxgrasp.viewer.browser.shapes import (
    Shape,
    body_shapes,
    contact_shapes,
    disturbance_shapes,
    force_shapes,
    load_shape,
    newtons_per_metre,
)
from jaxgrasp.viewer.browser.viewed import Viewed
from jaxgrasp.viewer.browser.what_if import Change, answer, reasons

# glTF's numbers: float32 triples, an array of corners, triangles.
_FLOAT, _ARRAY, _TRIANGLES = 5126, 34962, 4
_APART = 3.5


def write_shapes(viewed: Viewed, rows: Sequence[int], path: Path) -> None:
    """Writes grasps side by side as glTF (.glb) or USD text (.usda), in m, the object's z upwards.

    Args:
        viewed: The grasps.
        rows: Which of them.
        path: The file; its ending says the format.

    Raises:
        OSError: The file cannot be written.
    """
    grasps = [_shapes_of(viewed, row) for row in rows]
    apart = _APART * max((viewed.reach(row) for row in rows), default=0.0)
    names = [f"grasp {place + 1}" for place in range(len(rows))]
    write = _glb if path.suffix == ".glb" else _usd
    with atomic_write(path) as stream:
        stream.write(write(names, grasps, apart))


def write_keyframes(
    path: Path,
    names: Sequence[str],
    qpos: Float[np.ndarray, "batch nq"],
    controls: Float[np.ndarray, "batch nu"],
) -> None:
    """Writes configurations as an MJCF file of keyframes alone, for `<include file=.../>` in the scene's own file.

    Args:
        path: The file, .xml.
        names: Of the keyframes.
        qpos: Configurations of the scene, rad and m.
        controls: Commands of all its actuators; where NaN, none are written for the grasp.

    Raises:
        OSError: The file cannot be written.
    """
    lines = ["<mujoco>", "  <keyframe>"]
    for name, each, commands in zip(names, qpos, controls, strict=True):
        own = f" ctrl={quoteattr(_numbers(commands))}" if len(commands) and np.isfinite(commands).all() else ""
        lines.append(f"    <key name={quoteattr(name)} qpos={quoteattr(_numbers(each))}{own}/>")
    lines += ["  </keyframe>", "</mujoco>", ""]
    with atomic_write(path) as stream:
        stream.write("\n".join(lines).encode())


def _shapes_of(viewed: Viewed, row: int) -> list[Shape]:
    """All that the page draws of a grasp as it is."""
    change, reach = Change(share=viewed.share), viewed.reach(row)
    found, why = answer(viewed, row, change), reasons(viewed, row, change)
    load = load_shape(-found.load[:3], reach)
    return [
        *(body_shapes(viewed.bodies(row)) if viewed.bodies is not None else ()),
        *contact_shapes(found, reach, why.binding),
        *force_shapes(found, found.forces, reach, newtons_per_metre(found.forces, reach)),
        *disturbance_shapes(why, reach),
        *([] if load is None else [load]),
    ]


def _glb(names: Sequence[str], grasps: Sequence[list[Shape]], apart: float) -> bytes:
    """Binary glTF 2.0: a node a grasp, and below it a node with a mesh for each shape."""
    shapes = [shape for grasp in grasps for shape in grasp]
    buffer, views, accessors, meshes, materials, nodes = bytearray(), [], [], [], [], []
    for number, shape in enumerate(shapes):
        corners = np.asarray(shape.triangles.reshape(-1, 3), "<f4")
        edges = np.cross(*np.moveaxis(np.diff(shape.triangles, axis=1), 1, 0))
        length = np.linalg.norm(edges, axis=-1, keepdims=True)
        normals = np.where(length > 0, edges / np.where(length > 0, length, 1), [0.0, 0.0, 1.0])
        for array in (corners, np.asarray(np.repeat(normals, 3, 0), "<f4")):
            views.append({"buffer": 0, "byteOffset": len(buffer), "byteLength": 4 * array.size, "target": _ARRAY})
            bounds = {"min": array.min(0).tolist(), "max": array.max(0).tolist()}
            accessors.append(
                {"bufferView": len(views) - 1, "componentType": _FLOAT, "count": len(array), "type": "VEC3"} | bounds
            )
            buffer += array.tobytes()
        transparent = {"alphaMode": "BLEND"} if shape.opacity < 1 else {}
        colour = {"baseColorFactor": [*shape.colour, shape.opacity], "metallicFactor": 0, "roughnessFactor": 0.8}
        materials.append({"pbrMetallicRoughness": colour, "doubleSided": True} | transparent)
        attributes = {"POSITION": 2 * number, "NORMAL": 2 * number + 1}
        meshes.append({"primitives": [{"attributes": attributes, "material": number, "mode": _TRIANGLES}]})
        nodes.append({"name": shape.name, "mesh": number})
    first, roots = 0, []
    # glTF's y is up.
    upright = [-np.sqrt(0.5), 0.0, 0.0, np.sqrt(0.5)]
    for place, (name, grasp) in enumerate(zip(names, grasps, strict=True)):
        children = list(range(first, first + len(grasp)))
        first += len(grasp)
        roots.append(len(nodes))
        nodes.append({"name": name, "children": children, "translation": [apart * place, 0, 0], "rotation": upright})
    document = {
        "asset": {"version": "2.0", "generator": "jaxgrasp"},
        "scene": 0,
        "scenes": [{"nodes": roots}],
        "nodes": nodes,
        "meshes": meshes,
        "materials": materials,
        "accessors": accessors,
        "bufferViews": views,
        "buffers": [{"byteLength": len(buffer)}],
    }
    text = json.dumps(document).encode()
    text += b" " * (-len(text) % 4)
    chunks = struct.pack("<I4s", len(text), b"JSON") + text + struct.pack("<I4s", len(buffer), b"BIN\0") + buffer
    return struct.pack("<4sII", b"glTF", 2, 12 + len(chunks)) + chunks


def _usd(names: Sequence[str], grasps: Sequence[list[Shape]], apart: float) -> bytes:
    """USD as text: an Xform a grasp, and below it a Mesh for each shape."""
    lines = ["#usda 1.0", "(", '    defaultPrim = "grasps"', "    metersPerUnit = 1", '    upAxis = "Z"', ")", ""]
    lines += ['def Xform "grasps"', "{"]
    for place, (name, grasp) in enumerate(zip(names, grasps, strict=True)):
        lines += [f'    def Xform "{_identifier(name)}"', "    {"]
        lines.append(f"        double3 xformOp:translate = ({apart * place:.9g}, 0, 0)")
        lines.append('        uniform token[] xformOpOrder = ["xformOp:translate"]')
        for number, shape in enumerate(grasp):
            count = len(shape.triangles)
            points = ", ".join("({:.9g}, {:.9g}, {:.9g})".format(*p) for p in shape.triangles.reshape(-1, 3).tolist())
            red, green, blue = shape.colour
            lines += [
                f'        def Mesh "{_identifier(shape.name)}_{number}"',
                "        {",
                "            uniform bool doubleSided = 1",
                '            uniform token subdivisionScheme = "none"',
                f"            int[] faceVertexCounts = [{', '.join(['3'] * count)}]",
                f"            int[] faceVertexIndices = [{', '.join(map(str, range(3 * count)))}]",
                f"            point3f[] points = [{points}]",
                f"            color3f[] primvars:displayColor = [({red:.4g}, {green:.4g}, {blue:.4g})]",
                f"            float[] primvars:displayOpacity = [{shape.opacity:.4g}]",
                "        }",
            ]
        lines.append("    }")
    lines += ["}", ""]
    return "\n".join(lines).encode()


def _identifier(name: str) -> str:
    """A name that USD takes: letters, digits and underscores."""
    return re.sub(r"\W", "_", name, flags=re.ASCII)


def _numbers(values: np.ndarray) -> str:
    return " ".join(map(repr, values.tolist()))
