"""Malformed meshes."""

from __future__ import annotations

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
    yield "nul", good.replace(b"\n", b"\n\0")
    yield "utf16", good.decode().encode("utf-16")


def ply(draw: random.Random, home: Path) -> Iterator[tuple[str, Any]]:
    def header(kind: str, vertices: object = 4, faces: object = 4, extra: str = "", count: str = "uchar") -> bytes:
        return (
            f"ply\nformat {kind} 1.0\n{extra}element vertex {vertices}\nproperty float x\nproperty float y\n"
            f"property float z\nelement face {faces}\nproperty list {count} int vertex_indices\nend_header\n"
        ).encode()

    text = (
        "".join(f"{x} {y} {z}\n" for x, y, z in TETRAHEDRON) + "".join(f"3 {a} {b} {c}\n" for a, b, c in FACES)
    ).encode()
    body = TETRAHEDRON.astype("<f4").tobytes() + b"".join(b"\3" + f.astype("<i4").tobytes() for f in FACES)
    binary, ascii_ = "binary_little_endian", "ascii"
    yield from damaged(header(binary) + body, draw, 40, 12)
    yield from damaged(header(ascii_) + text, draw, 30, 8)
    for kind, content in ((binary, body), (ascii_, text)):
        for number in ("0", "3", "5", "1000", "1000000000", "99999999999999999999", "-4", "4.5", "x", "9" * 5000):
            yield f"vertices_{number[:12]}", header(kind, vertices=number) + content
            yield f"faces_{number[:12]}", header(kind, faces=number) + content
        for extra in (
            "comment TextureFile /dev/zero\n", "comment TextureFile pipe\n", "element void 1000000000\n",
            "property int x\n",
            "element vertex 4\n", "obj_info x\n", "element\n", "property list\n",
        ):  # fmt: skip
            yield "extra", header(kind, extra=extra) + content
    for count in ("char", "int", "float", "double", "uint", "long"):
        yield f"list_{count}", header(binary, count=count) + body
    yield "list_huge", header(binary, faces=1, count="uint") + body[:48] + b"\xff\xff\xff\x7f" + bytes(12)
    yield "list_negative", header(binary, faces=1, count="int") + body[:48] + b"\xff\xff\xff\xff" + bytes(12)
    yield "no_end", header(ascii_).replace(b"end_header\n", b"")
    yield "big", header("binary_big_endian") + body
    yield "format", header("utf8") + text
    yield "beyond", header(ascii_) + text.replace(b"3 0 2 1", b"3 0 2 9")
    yield "nan", header(ascii_) + text.replace(b"0.05", b"nan")
    yield "digits", header(ascii_) + text.replace(b"0.05", b"9" * 5000)
