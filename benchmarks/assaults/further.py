"""Malformed inputs that other programs write: numbers as people spell them, rare layouts, headers of others."""

from __future__ import annotations

import gzip
import random
import zipfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.assaults.arrays import grasps, member, raw, zipped
from benchmarks.assaults.shapes import FACES, TETRAHEDRON, stl_binary

# fmt: off
# One number, as some program or some person would write it; Python reads a few that nobody means.
SPELLINGS = (
    "0,05",
    "0_05",
    "0x1p-4",
    "5d-2",
    "1/20",
    "٠.٠٥",
    "0.05f",
    "+.05",
    "--0.05",
    "0.05.1",
    "1e",
    "1e400",
    "∞",
    "NULL",
)


def more_archives(draw: random.Random, home: Path) -> Iterator[tuple[str, Any]]:
    good = grasps()
    fields = {name: member(value) for name, value in good.items()}

    def with_field(name: str, value: Any) -> bytes:
        return zipped([(f"{n}.npy", content) for n, content in (fields | {name: member(value)}).items()])

    positions = good["positions"]
    for label, value in {
        "fortran": np.asfortranarray(positions), "big_endian": positions.astype(">f8"), "one": positions[0],
        "long_double": positions.astype("g"), "whole": (1e3 * positions).astype(np.int64), "flat": positions.ravel(),
        "complex": positions.astype(complex), "dates": positions.astype("M8[s]"), "text": positions.astype("U"),
        "truth": positions > 0, "turned": positions.swapaxes(0, 1), "doubled": np.repeat(positions, 2, -1),
        "rows": np.rec.fromarrays(positions.reshape(-1, 3).T, names="x,y,z"), "subnormal": positions * 1e-310,
    }.items():  # fmt: skip
        yield f"positions_{label}", with_field("positions", value)
    count = len(positions)
    for name in ("friction", "max_force", "mass"):
        for label, value in {"negative": -1.0, "nan": np.nan, "inf": np.inf, "text": "x", "zero": 0.0}.items():
            yield f"{name}_{label}", with_field(name, np.full(count, value))
    yield "masses_too_few", with_field("mass", np.ones(count - 1))
    yield "active_none", with_field("active", np.zeros(positions.shape[:2], bool))
    yield "active_numbers", with_field("active", np.full(positions.shape[:2], 0.5))
    yield "names_nul", with_field("object_name", np.full(count, "a\0b"))
    yield "names_bytes", with_field("object_name", np.full(count, b"\xff\xfe"))
    yield "column_of_margins", with_field("margin", np.ones(count))
    whole = zipped([(f"{n}.npy", content) for n, content in fields.items()])
    yield "gzipped", gzip.compress(whole)
    yield "utf16_names", zipped([(f"{n}\0.npy", content) for n, content in fields.items()])
    for method in (zipfile.ZIP_BZIP2, zipfile.ZIP_LZMA):
        yield f"method_{method}", zipped([(f"{n}.npy", content) for n, content in fields.items()], method)
    yield "windows_names", zipped([(f"folder\\{n}.npy", content) for n, content in fields.items()])
    yield "upper_names", zipped([(f"{n.upper()}.NPY", content) for n, content in fields.items()])


def more_arrays(draw: random.Random, home: Path) -> Iterator[tuple[str, Any]]:
    wrenches = np.concatenate([np.eye(6), -np.eye(6)])
    for label, value in {
        "fortran": np.asfortranarray(wrenches), "big_endian": wrenches.astype(">f4"), "half": wrenches.astype("e"),
        "long_double": wrenches.astype("g"), "truth": wrenches > 0, "turned": wrenches.T, "flat": wrenches.ravel(),
        "row": wrenches[0], "none": wrenches[:0], "text": wrenches.astype("S"), "dates": wrenches.astype("m8[s]"),
        "seven": np.ones((4, 7)), "three": wrenches[None], "one": np.array(1.0), "huge": wrenches * 1e308,
        "subnormal": wrenches * 1e-310, "zero": wrenches * 0, "same": np.ones((4, 6)),
        "rows": np.rec.fromarrays(wrenches.T, names="a,b,c,d,e,f"),
    }.items():  # fmt: skip
        yield f"wrenches_{label}", member(value)
    data = wrenches.tobytes()
    for label, header in {
        "keys_again": "{'descr': '<f8', 'fortran_order': False, 'shape': (12, 6), 'shape': (6, 12)}\n",
        "more_keys": "{'descr': '<f8', 'fortran_order': False, 'shape': (12, 6), 'x': 1}\n",
        "order_one": "{'descr': '<f8', 'fortran_order': 1, 'shape': (12, 6)}\n",
        "list": "{'descr': '<f8', 'fortran_order': False, 'shape': [12, 6]}\n",
        "floats": "{'descr': '<f8', 'fortran_order': False, 'shape': (12.0, 6.0)}\n",
        "power": "{'descr': '<f8', 'fortran_order': False, 'shape': (9**9**9, 6)}\n",
        "nested": "{'descr': [('a', [('b', '<f8', (6,))])], 'fortran_order': False, 'shape': (12,)}\n",
        "void": "{'descr': 'V48', 'fortran_order': False, 'shape': (12,)}\n",
        "parentheses": "(" * 900 + ")" * 900 + "\n",
        "comment": "{'descr': '<f8', 'fortran_order': False, 'shape': (12, 6)} # more\n",
        "lambda": "(lambda: {'descr': '<f8', 'fortran_order': False, 'shape': (12, 6)})()\n",
    }.items():
        yield f"header_{label}", raw(header, data)


def more_stl(draw: random.Random, home: Path) -> Iterator[tuple[str, Any]]:
    corners = TETRAHEDRON[FACES]
    text = "solid a\n" + "".join(
        "facet normal 0 0 0\nouter loop\n" + "".join(f"vertex {x} {y} {z}\n" for x, y, z in c) + "endloop\nendfacet\n"
        for c in corners
    )
    good = text + "endsolid a\n"
    for spelling in SPELLINGS:
        yield f"spelt_{spelling.replace('/', '|')}", good.replace("0.05", spelling).encode()
    yield "turned", stl_binary(corners[:, ::-1])
    yield "half_turned", stl_binary(np.concatenate([corners[:2], corners[2:, ::-1]]))
    yield (
        "big_endian",
        stl_binary(corners)[:84] + b"".join(bytes(12) + c.astype(">f4").tobytes() + bytes(2) for c in corners),
    )
    yield "utf16", good.encode("utf-16")
    yield "one_line", good.replace("\n", " ").encode()
    yield "returns", good.replace("\n", "\r").encode()
    yield "html", b"<!DOCTYPE html><html><body>404 Not Found</body></html>"
    yield "pointer", b"version https://git-lfs.github.com/spec/v1\noid sha256:" + b"0" * 64 + b"\nsize 1\n"


def more_obj(draw: random.Random, home: Path) -> Iterator[tuple[str, Any]]:
    points = "".join(f"v {x} {y} {z}\n" for x, y, z in TETRAHEDRON)
    faces = "".join("f " + " ".join(str(i + 1) for i in f) + "\n" for f in FACES)
    for spelling in SPELLINGS:
        yield f"spelt_{spelling.replace('/', '|')}", (points.replace("0.05", spelling) + faces).encode()
    for index in ("1.0", "1e0", "+1", "0_1", "١", "1/", "1//", "/1", "1/1/1/1", "1\\1", "-0", "1,", "0x1"):
        yield f"index_{index.replace('/', '|')}", (points + faces.replace("f 1 ", f"f {index} ")).encode()
    yield "polyline", (points + "l 1 2 3\np 1\n" + faces).encode()
    yield "curves", (points + "cstype bezier\ncurv 0 1 1 2 3 4\n" + faces).encode()
    yield "capitals", (points + faces).upper().encode()
    yield "form_feeds", (points + faces).replace(" ", "\f").encode()
    yield "colours", points.replace("\n", " 1 0 0\n").encode() + faces.encode()
    yield "faces_first", (faces + points).encode()
    yield "utf16", (points + faces).encode("utf-16")
    yield "pointer", b"version https://git-lfs.github.com/spec/v1\noid sha256:" + b"0" * 64 + b"\nsize 1\n"


def more_ply(draw: random.Random, home: Path) -> Iterator[tuple[str, Any]]:
    head = "ply\nformat ascii 1.0\nelement vertex 4\nproperty float x\nproperty float y\nproperty float z\n"
    head += "element face 4\nproperty list uchar int vertex_indices\nend_header\n"
    rows = "".join(f"{x} {y} {z}\n" for x, y, z in TETRAHEDRON)
    faces = "".join("3 " + " ".join(map(str, f)) + "\n" for f in FACES)
    for spelling in SPELLINGS:
        yield f"spelt_{spelling.replace('/', '|')}", (head + rows.replace("0.05", spelling) + faces).encode()
    yield "strips", (head.replace("vertex_indices", "tristrips") + rows + faces).encode()
    yield "version_11", (head.replace("1.0", "1.1") + rows + faces).encode()
    yield "element_words", (head.replace("vertex 4", "vertex 4 4") + rows + faces).encode()
    yield "indices_floats", (head + rows + faces.replace("3 0", "3 0.5")).encode()
    yield "indices_negative", (head + rows + faces.replace("3 0", "3 -1")).encode()
    yield "count_float", (head + rows + faces.replace("3 ", "3.5 ", 1)).encode()
    yield "count_nan", (head + rows + faces.replace("3 ", "nan ", 1)).encode()
    yield "data_after", (head + rows + faces + "1 2 3\n").encode()
    yield "ends_twice", (head + "end_header\n" + rows + faces).encode()
    yield "long_ints", (head.replace("uchar int", "uchar int64") + rows + faces).encode()
    yield "tabs", (head.replace(" ", "\t") + rows + faces).encode()


def more_models(draw: random.Random, home: Path) -> Iterator[tuple[str, Any]]:
    def scene(head: str = "", bodies: str = "", tail: str = "", position: str = "0 0 0.1") -> bytes:
        return (
            f'<mujoco>{head}<worldbody><body name="object" pos="{position}"><freejoint/><geom size="0.02"/></body>'
            f'<body name="palm"><geom size="0.01"/><body pos="0 0 .03"><joint name="j"/><geom size="0.01"/></body>'
            f"</body>{bodies}</worldbody>{tail}</mujoco>"
        ).encode()

    for spelling in SPELLINGS:
        yield f"spelt_{spelling.replace('/', '|')}", scene(position=f"0 0 {spelling}")
    for count in ("1000 1000 1000", "-1 2 2", "1 1 1", "100 100 1"):
        flex = f'<flexcomp type="grid" count="{count}" spacing=".1 .1 .1" dim="2" name="f"/>'
        yield f"flex_{count[:6]}", scene(bodies=flex)
    for count in ("1000000", "100000 1 1", "-5"):
        yield f"cable_{count[:6]}", scene(bodies=f'<composite type="cable" count="{count}" curve="s" size="1"/>')
    for keys in ("<key qpos='nan'/>", "<key qpos='1 2 3'/>", "<key time='inf'/>"):
        yield f"key_{keys[5:9]}", scene(tail=f"<keyframe>{keys}</keyframe>")
    for option in ("timestep='nan'", "timestep='0'", "gravity='nan 0 0'", "gravity='1e300 0 0'", "iterations='-1'"):
        yield f"option_{option[:10]}", scene(head=f"<option {option}/>")
    yield "plugin", scene(head='<extension><plugin plugin="mujoco.sdf.bolt"/></extension>')
    yield "texture", scene(head='<asset><texture type="2d" file="/dev/zero" name="t"/></asset>')
    yield "skin", scene(head='<asset><skin file="/dev/zero"/></asset>')
    yield "user", scene(head='<size nuser_body="1000000000"/>')
    yield "tendon", scene(tail='<tendon><fixed><joint joint="j" coef="nan"/></fixed></tendon>')
    yield "equality", scene(tail='<equality><weld body1="object" body2="object"/></equality>')
    yield "sensor", scene(tail='<sensor><user dim="2000000000"/></sensor>')
    yield "html", b"<!DOCTYPE html><html><body>404 Not Found</body></html>"
    yield "gzipped", gzip.compress(scene())
