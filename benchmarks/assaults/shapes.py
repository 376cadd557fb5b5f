"""Malformed meshes."""

from __future__ import annotations

import itertools
import os
import random
import struct
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.assaults.damage import damaged

TETRAHEDRON = np.array([[0, 0, 0], [0.05, 0, 0], [0, 0.05, 0], [0, 0, 0.05]])
FACES = np.array([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]])


def stl_binary(corners: np.ndarray, count: int | None = None) -> bytes:
    rows = b"".join(bytes(12) + np.asarray(c, "<f4").tobytes() + bytes(2) for c in corners)
    return bytes(80) + struct.pack("<I", len(corners) if count is None else count) + rows


def stl(draw: random.Random, home: Path) -> Iterator[tuple[str, Any]]:
    corners = TETRAHEDRON[FACES]
    good = stl_binary(corners)
    text = "solid a\n" + "".join(
        "facet normal 0 0 0\nouter loop\n" + "".join(f"vertex {x} {y} {z}\n" for x, y, z in c) + "endloop\nendfacet\n"
        for c in corners
    )
    yield from damaged(good, draw, 30, 10)
    yield from damaged((text + "endsolid a\n").encode(), draw, 25, 8)
    for count in (0, 3, 5, 1_000_000, 2**32 - 1):
        yield f"count_{count}", stl_binary(corners, count)
    for label, value in {"nan": np.nan, "inf": np.inf, "huge": 3e38, "tiny": 1e-40, "flat": 0.0}.items():
        spoilt = corners.copy()
        spoilt[0] = value
        yield label, stl_binary(spoilt)
        yield f"all_{label}", stl_binary(corners * 0 + value)
    yield "one", stl_binary(corners[:1])
    yield "open", stl_binary(corners[:3])
    yield "scaled_1e30", stl_binary(corners * 1e30)
    yield "scaled_1e-30", stl_binary(corners * 1e-30)
    yield "words", text.replace("0.05", "many").encode()
    yield "digits", text.replace("0.05", "9" * 5000).encode()
    yield "unfinished", text.encode()[:-100]
    yield "named_solid", b"solid" + good[5:]
    yield "longer", good + b"more"
    yield "doubled_text", 2 * (text + "endsolid a\n").encode()
    yield "capitals", (text + "endsolid a\n").upper().encode()
    yield "bom", b"\xef\xbb\xbf" + (text + "endsolid a\n").encode()


def obj(draw: random.Random, home: Path) -> Iterator[tuple[str, Any]]:
    points = "".join(f"v {x} {y} {z}\n" for x, y, z in TETRAHEDRON)
    faces = "".join("f " + " ".join(str(i + 1) for i in f) + "\n" for f in FACES)
    good = (points + faces).encode()
    yield from damaged(good, draw, 40, 12)
    os.mkfifo(home / "pipe.mtl")
    yield "mtllib_pipe", b"mtllib pipe.mtl\nusemtl a\n" + good
    yield "mtllib_zero", b"mtllib /dev/zero\nusemtl a\n" + good
    yield "mtllib_absent", b"mtllib nothing.mtl\nusemtl a\n" + good
    for label, line in {
        "beyond": "f 1 2 9\n", "zero": "f 0 1 2\n", "negative": "f -1 -2 -3\n", "two": "f 1 2\n",
        "float": "f 1.5 2 3\n",
        "huge": "f 99999999999999999999 1 2\n", "slashes": "f 1// 2// 3//\n", "wrong": "f 1/9/9 2/9/9 3/9/9\n",
        "many": "f " + "1 2 3 " * 5000 + "\n", "words": "f a b c\n", "only": "f\n",
    }.items():  # fmt: skip
        yield f"face_{label}", (points + faces + line).encode()
        yield f"only_{label}", (points + line).encode()
    for label in ("nan", "inf", "1e999", "x", "", "1 2 3 4 5 6 7 8 9", "9" * 5000):
        yield "vertex", (points.replace("0.05", label, 1) + faces).encode()
    yield "points", points.encode()
    yield "faces", faces.encode()
    yield "flat", (points.replace("0.05", "0") + faces).encode()
    yield "lines", (points + "l 1 2 3\n" + faces).encode()
    yield "long_line", b"v " + b"1 " * 300_000 + b"\n" + good
    yield "comment", b"#" * 5_000_000 + b"\n" + good
    for label in ("1_0", "٣", "３", "0x1p3", "infinity", "1e-400", "+0.05", "1,0"):
        yield "number", (points.replace("0.05", label, 1) + faces).encode()
    yield "nul", good.replace(b"\n", b"\n\0")
    yield "utf16", good.decode().encode("utf-16")


def ply_header(kind: str, vertices: object = 4, faces: object = 4, extra: str = "", count: str = "uchar") -> bytes:
    return (
        f"ply\nformat {kind} 1.0\n{extra}element vertex {vertices}\nproperty float x\nproperty float y\n"
        f"property float z\nelement face {faces}\nproperty list {count} int vertex_indices\nend_header\n"
    ).encode()


def ply(draw: random.Random, home: Path) -> Iterator[tuple[str, Any]]:
    text = (
        "".join(f"{x} {y} {z}\n" for x, y, z in TETRAHEDRON) + "".join(f"3 {a} {b} {c}\n" for a, b, c in FACES)
    ).encode()
    body = TETRAHEDRON.astype("<f4").tobytes() + b"".join(b"\3" + f.astype("<i4").tobytes() for f in FACES)
    binary, ascii_ = "binary_little_endian", "ascii"
    yield from damaged(ply_header(binary) + body, draw, 40, 12)
    yield from damaged(ply_header(ascii_) + text, draw, 30, 8)
    for kind, content in ((binary, body), (ascii_, text)):
        for number in ("0", "3", "5", "1000", "1000000000", "99999999999999999999", "-4", "4.5", "x", "9" * 5000):
            yield f"vertices_{number[:12]}", ply_header(kind, vertices=number) + content
            yield f"faces_{number[:12]}", ply_header(kind, faces=number) + content
        for extra in (
            "comment TextureFile /dev/zero\n", "comment TextureFile pipe\n", "element void 1000000000\n",
            "property int x\n",
            "element vertex 4\n", "obj_info x\n", "element\n", "property list\n",
        ):  # fmt: skip
            yield "extra", ply_header(kind, extra=extra) + content
    for count in ("char", "int", "float", "double", "uint", "long"):
        yield f"list_{count}", ply_header(binary, count=count) + body
    yield "list_huge", ply_header(binary, faces=1, count="uint") + body[:48] + b"\xff\xff\xff\x7f" + bytes(12)
    yield "list_negative", ply_header(binary, faces=1, count="int") + body[:48] + b"\xff\xff\xff\xff" + bytes(12)
    swapped = TETRAHEDRON.astype(">f4").tobytes() + b"".join(b"\3" + f.astype(">i4").tobytes() for f in FACES)
    yield "big_right", ply_header("binary_big_endian") + swapped
    yield "returns", ply_header(binary).replace(b"\n", b"\r\n") + body
    yield (
        "faces_first",
        (
            b"ply\nformat ascii 1.0\nelement face 4\nproperty list uchar int vertex_index\nelement vertex 4\n"
            b"property float x\nproperty float y\nproperty float z\nend_header\n"
            + b"\n".join(text.split(b"\n")[4:] + text.split(b"\n")[:4])
        ),
    )
    yield "no_end", ply_header(ascii_).replace(b"end_header\n", b"")
    yield "big", ply_header("binary_big_endian") + body
    yield "format", ply_header("utf8") + text
    yield "beyond", ply_header(ascii_) + text.replace(b"3 0 2 1", b"3 0 2 9")
    yield "nan", ply_header(ascii_) + text.replace(b"0.05", b"nan")
    yield "digits", ply_header(ascii_) + text.replace(b"0.05", b"9" * 5000)


def large_stl(draw: random.Random, home: Path) -> Iterator[tuple[str, Any]]:
    corners = TETRAHEDRON[FACES]
    text = "solid a\n" + "facet\nvertex 0 0 0\nvertex 0 1 0\nvertex 1 0 0\nendfacet\n" * 4
    yield "solids", (text + "endsolid a\n").encode() * 20_000
    yield "line", b"solid " + b"1 " * 20_000_000
    yield "millions", stl_binary(corners[:1])[:80] + struct.pack("<I", 1_000_000) + bytes(50_000_000)
    yield "too_many", bytes(80) + struct.pack("<I", 1_070_000) + bytes(53_500_000)


def lines_of(corners: np.ndarray) -> str:
    return "".join(f"f {i} {j} {k}\n" for i, j, k in corners.tolist())


def lines_of_points(points: np.ndarray) -> str:
    return "".join(f"v {x:.4f} {y:.4f} {z:.4f}\n" for x, y, z in points.tolist())


def fine_ball(count: int) -> bytes:
    """A ball of 2 count (count - 1) triangles, none of them like another."""
    rows, columns = np.mgrid[0 : count + 1, 0:count]
    down, around = np.pi * rows / count, 2 * np.pi * columns / count
    radius = 0.05 + 0.005 * np.sin(7 * down) * np.cos(5 * around)
    flat = np.sin(down)
    points = radius[..., None] * np.stack([flat * np.cos(around), flat * np.sin(around), np.cos(down)], -1)
    rows, columns = np.mgrid[0:count, 0:count]
    here, right = 1 + rows * count + columns, 1 + rows * count + (columns + 1) % count
    lower, upper = np.stack([here, here + count, right + count], -1), np.stack([here, right + count, right], -1)
    corners = np.concatenate([lower[:-1].reshape(-1, 3), upper[1:].reshape(-1, 3)])
    return (lines_of_points(points.reshape(-1, 3)) + lines_of(corners)).encode()


def large_obj(draw: random.Random, home: Path) -> Iterator[tuple[str, Any]]:
    points = "".join(f"v {x} {y} {z}\n" for x, y, z in TETRAHEDRON)
    faces = "".join("f " + " ".join(str(i + 1) for i in f) + "\n" for f in FACES)
    good = (points + faces).encode()
    for label, line in {
        "groups": "o a\nf 1 2 3\n", "materials": "usemtl a\nf 1 2 3\n", "continued": "f 1 \\\n", "points": "v 0 0 0\n",
        "triangles": "f 1/1/1 2/2/2 3/3/3\n", "quads": "f 1 2 3 4\n", "backwards": "f -1 -2 -3\n", "empty": "\n",
    }.items():  # fmt: skip
        yield f"many_{label}", (points + line * (12_000_000 // len(line)) + faces).encode()
    yield "even", fine_ball(540)
    many = np.random.default_rng(0).normal(scale=0.05, size=(185, 3))
    corners = np.array(list(itertools.combinations(range(1, 186), 3)))[:1_000_000]
    yield "all_different", (lines_of_points(many) + lines_of(corners)).encode()
    yield "very_long_line", b"v " + b"1 " * 9_000_000 + b"\n" + good
    yield "many_corners", (points + "f " + "1 2 3 " * 1_000_000 + "\n").encode()
    yield "uneven", (points + "".join(f"f {'1 2 3 ' * (n % 100 + 1)}\n" for n in range(20_000))).encode()


def large_ply(draw: random.Random, home: Path) -> Iterator[tuple[str, Any]]:
    binary, ascii_ = "binary_little_endian", "ascii"
    text = b"0 0 0\n1 0 0\n0 1 0\n0 0 1\n"
    body = TETRAHEDRON.astype("<f4").tobytes() + b"".join(b"\3" + f.astype("<i4").tobytes() for f in FACES)
    for label, extra in {
        "comments": "comment x\n" * 1_000_000,
        "comment": f"comment {'x' * 20_000_000}\n",
        "twice": "format ascii 1.0\n",
        "elements": "element e 0\nproperty int x\n" * 100_000,
        "obj_info": "obj_info \x1b[31m\n",
    }.items():
        yield f"header_{label}", ply_header(binary, extra=extra) + body
    yield "properties", ply_header(ascii_).replace(b"property float x\n", b"property float x\n" * 1_000_000) + text
    yield "line", ply_header(ascii_, vertices=2_000_000) + b"1 " * 20_000_000
    yield "many", ply_header(ascii_, vertices=2_000_000) + b"1 2 3\n" * 2_000_000 + text
    row = b"\3" + FACES[0].astype("<i4").tobytes()
    yield "many_faces", ply_header(binary, faces=2_000_000) + body[:48] + row * 2_000_000
    other = b"\4" + np.arange(4).astype("<i4").tobytes()
    yield "uneven", ply_header(binary, faces=1_000_000) + body[:48] + (row + other) * 500_000
