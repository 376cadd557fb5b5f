"""Malformed archives of candidates, and arrays of wrenches."""

from __future__ import annotations

import io
import os
import pickle
import random
import struct
import zipfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.assaults.damage import damaged
from benchmarks.assaults.zips import zips

GRASPS, CONTACTS = 6, 4


def grasps() -> dict[str, np.ndarray]:
    draw = np.random.default_rng(0)
    normals = draw.normal(size=(GRASPS, CONTACTS, 3))
    normals /= np.linalg.norm(normals, axis=-1, keepdims=True)
    return {
        "positions": 0.05 * normals,
        "outward_normals": normals,
        "friction": np.full(GRASPS, 0.6),
        "max_force": np.full((GRASPS, CONTACTS), 10.0),
        "mass": np.full(GRASPS, 0.2),
        "object_name": np.full(GRASPS, "thing"),
    }


def saved(compress: bool = False, **fields: Any) -> bytes:
    stream = io.BytesIO()
    (np.savez_compressed if compress else np.savez)(stream, **fields)
    return stream.getvalue()


def member(value: Any, **options: Any) -> bytes:
    stream = io.BytesIO()
    np.lib.format.write_array(stream, np.asarray(value), **options)
    return stream.getvalue()


def zipped(members: list[tuple[str, bytes]], method: int = zipfile.ZIP_STORED) -> bytes:
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w", method) as archive:
        for name, content in members:
            archive.writestr(name, content)
    return stream.getvalue()


def raw(header: str | bytes, data: bytes = b"", version: tuple[int, int] = (1, 0)) -> bytes:
    text = header.encode() if isinstance(header, str) else header
    return b"\x93NUMPY" + bytes(version) + struct.pack("<H" if version[0] == 1 else "<I", len(text)) + text + data


class Evil:
    def __reduce__(self) -> tuple:
        return os.system, ("echo unpickled > UNPICKLED",)


HEADERS = {
    "huge": "{'descr': '<f8', 'fortran_order': False, 'shape': (1000000000000, 4, 3), }",
    "100M": "{'descr': '<f8', 'fortran_order': False, 'shape': (4000000, 4, 3), }",
    "negative": "{'descr': '<f8', 'fortran_order': False, 'shape': (-6, 4, 3), }",
    "overflow": "{'descr': '<f8', 'fortran_order': False, 'shape': (9223372036854775807, 4, 3), }",
    "wraps": "{'descr': '<f8', 'fortran_order': False, 'shape': (4611686018427387904, 4, 3), }",
    "boolean": "{'descr': '<f8', 'fortran_order': False, 'shape': (True, 4, 3), }",
    "float": "{'descr': '<f8', 'fortran_order': False, 'shape': (6.0, 4, 3), }",
    "text": "{'descr': '<f8', 'fortran_order': False, 'shape': ('6', 4, 3), }",
    "digits": "{'descr': '<f8', 'fortran_order': False, 'shape': (%s, 4, 3), }" % ("9" * 4000),
    "dimensions": "{'descr': '<f8', 'fortran_order': False, 'shape': (%s), }" % ("1," * 70),
    "code": "__import__('os').system('echo run > UNPICKLED')",
    "deep": "[" * 3000 + "]" * 3000,
    "deeper": "(" * 4900 + ")" * 4900,
    "minus": "-" * 9000 + "1",
    "objects": "{'descr': '|O', 'fortran_order': False, 'shape': (6, 4, 3), }",
    "fields": "{'descr': [('a', '<f8')], 'fortran_order': False, 'shape': (6, 4, 3), }",
    "unknown": "{'descr': 'zzz', 'fortran_order': False, 'shape': (6, 4, 3), }",
    "subarray": "{'descr': ('<f8', (1099511627776,)), 'fortran_order': False, 'shape': (6, 4, 3), }",
    "subarray2": "{'descr': ('<f8', (2,)), 'fortran_order': False, 'shape': (6, 4, 3), }",
    "void": "{'descr': '|V0', 'fortran_order': False, 'shape': (1000000000, 4, 3), }",
    "wide": "{'descr': '<U500000000', 'fortran_order': False, 'shape': (6, 4, 3), }",
    "empty_text": "{'descr': '<U0', 'fortran_order': False, 'shape': (6, 1000000000000), }",
    "missing": "{'descr': '<f8', 'shape': (6, 4, 3), }",
    "more": "{'descr': '<f8', 'fortran_order': False, 'shape': (6, 4, 3), 'x': 1, }",
    "order": "{'descr': '<f8', 'fortran_order': 7, 'shape': (6, 4, 3), }",
    "list": "['<f8', False, (6, 4, 3)]",
    "nothing": "",
    "bytes": b"\xff\xfe" * 50,
    "nul": b"{'descr': '<f8\x00', 'fortran_order': False, 'shape': (6, 4, 3), }",
}
VERSIONS = ((1, 0), (2, 0), (3, 0), (9, 9))


def archives(draw: random.Random, home: Path) -> Iterator[tuple[str, Any]]:
    good = grasps()
    plain, small = saved(**good), saved(compress=True, **good)
    yield from damaged(plain, draw, 60, 15)
    yield from damaged(small, draw, 40, 10)
    yield from damaged(plain, draw, 60, 0, within=600)
    for name, head in HEADERS.items():
        for version in VERSIONS:
            text = head if isinstance(head, bytes) else (head + "\n").encode()
            rest = [(f"{k}.npy", member(v)) for k, v in good.items() if k != "positions"]
            if version == (1, 0) or name in ("huge", "boolean", "digits", "deep", "bytes"):
                broken = raw(text, bytes(576), version)
                yield f"header_{name}_{version[0]}", zipped([("positions.npy", broken), *rest])
                yield (
                    f"column_{name}_{version[0]}",
                    zipped([(f"{k}.npy", member(v)) for k, v in good.items()] + [("extra.npy", broken)]),
                )
    for dtype in ("U5", "S5", "c16", "?", "M8[s]", "m8[s]", "V8", "f2", "g", ">f8", "i1", "u8", "f4", "i8", "U0", "S0"):
        for field in ("positions", "friction", "active", "object_name"):
            value = np.zeros((GRASPS, CONTACTS, 3) if field == "positions" else GRASPS, dtype)
            yield f"dtype_{field}_{dtype.strip('>').replace('[s]', '')}", saved(**{**good, field: value})
    for field in good:
        yield f"pickle_{field}", saved(**{**good, field: np.array([Evil()] * GRASPS, object)})
        for label, value in {"nan": np.nan, "inf": np.inf, "huge": 1e308, "tiny": 5e-324, "minus": -1.0}.items():
            if good[field].dtype.kind == "f":
                spoilt = good[field].copy()
                spoilt.flat[1] = value
                yield f"value_{field}_{label}", saved(**{**good, field: spoilt})
        shapes = ((), (0,), (5,), (7, 4), (6, 5), (6, 4, 2), (6, 0, 3), (0, 4, 3), (24, 3), (6, 4, 3, 1), (1,) * 30)
        for shape in shapes:
            yield f"shape_{field}_{len(shape)}", saved(**{**good, field: np.zeros(shape, good[field].dtype)})
        yield f"without_{field}", saved(**{k: v for k, v in good.items() if k != field})
    yield "pickle", pickle.dumps(Evil())
    yield "pickle_member", zipped([("positions.npy", pickle.dumps(Evil()))])
    for count in (1, 3, 65, 200):
        wide = np.tile(good["positions"][:, :1], (1, count, 1))
        yield (
            f"contacts_{count}",
            saved(**{**good, "positions": wide, "outward_normals": wide, "max_force": np.full(6, 1.0)}),
        )
    std = [(f"{name}.npy", member(value)) for name, value in good.items()]
    for label in (
        "größe_猫", "a\nb", "\x1b[31mred", "[red]x[/red]", "a\x00b", "n" * 60000, "a/b", 'comma,"b"', "", "file",
        "rank",
        "forces_0_x", "margin", "..", "\u202egnp", "../../x", "/etc/x", "$\\frac$", "positions ", "Positions", "x" * 5,
    ):  # fmt: skip
        yield "column_named", zipped([*std, (f"{label}.npy", member(np.arange(6.0)))])
    for label, value in {
        "wide": np.full(6, "x" * 200_000), "nul": np.array(["a\x00b", "\x1b[31m", "[bold]", "x\ny", "", "\u202e"]),
        "surrogates": np.array(["\ud800"] * 6), "bytes": np.array([b"\xff\xfe"] * 6),
        "dollars": np.full(6, "a$b$\\c_{"),
        "big_endian": np.full(6, "ab").astype(">U2"), "nothing": np.zeros((6, 0)), "many": np.zeros((6, 3000)),
        "dimensions": np.zeros((6,) + (1,) * 30), "booleans": np.frombuffer(bytes([0, 1, 2, 3, 255, 128]), bool),
        "large": np.full(6, 2**63 + 1, "u8"), "text": np.full((6, 3), "abc"), "date": np.zeros(6, "M8[s]"),
    }.items():  # fmt: skip
        yield f"column_{label}", zipped([*std, ("extra.npy", member(value))])
        if label in ("wide", "nul", "surrogates", "dollars", "bytes"):
            yield f"name_{label}", zipped([*std[:-1], ("object_name.npy", member(value))])
    codes = np.full(6, "ab").view("u4")
    codes[:] = 0x7FFFFFFF
    yield "column_codes", zipped([*std, ("extra.npy", member(codes.view("U2")))])
    yield "twice", zipped([*std, ("positions.npy", member(good["positions"] * 2))])
    yield "twice_bare", zipped([*std, ("positions", member(good["positions"] * 2))])
    yield "readme", zipped([*std, ("readme.txt", b"hello")])
    yield "folder", zipped([*std, ("folder/", b"")])
    yield "nested", zipped([("positions.npy", plain)])
    yield "longer", zipped([("positions.npy", member(good["positions"]) + b"more"), *std[1:]])
    yield "prepended", b"#!/bin/sh\n" * 50 + plain
    yield "appended", plain + b"x" * 70_000
    yield "no_members", zipped([])
    yield "many_members", zipped([*std, *((f"m{n}.npy", member(np.zeros(1))) for n in range(20_000))])
    yield "300_members", zipped([*std, *((f"m{n}.npy", member(np.zeros(6))) for n in range(300))])
    for method in (zipfile.ZIP_BZIP2, zipfile.ZIP_LZMA):
        yield f"method_{method}", zipped(std, method)
    for position, value in ((8, 1), (8, 9), (8, 99), (6, 1), (6, 0x41)):
        changed = bytearray(zipped(std))
        changed[changed.find(b"PK\x03\x04") + position] = value
        changed[changed.find(b"PK\x01\x02") + position + 2] = value
        yield f"local_{position}_{value}", bytes(changed)
    for offset, size in ((8, 4), (12, 4), (16, 4)):
        for value in (b"\xff" * size, b"\0" * size, b"\xff\xff\xff\x7f"):
            changed = bytearray(plain)
            end = changed.find(b"PK\x05\x06")
            changed[end + offset : end + offset + size] = value
            yield f"end_{offset}", bytes(changed)
    for offset in (20, 24, 28, 30, 42):
        for value in (b"\xff\xff\xff\x7f", b"\0\0\0\0", b"\xff\xff\xff\xff"):
            changed = bytearray(plain)
            entry = changed.find(b"PK\x01\x02")
            changed[entry + offset : entry + offset + len(value)] = value
            yield f"entry_{offset}", bytes(changed)
    for name, shape, field in (
        ("bomb_candidates", (25_000_000, 4, 3), "positions"),
        ("bomb_passed_over", (500_000_000,), "extra"),
        ("bomb_column", (6, 60_000_000), "extra"),
        ("bomb_below_budget", (6, 30_000_000), "extra"),
    ):
        yield name, bomb(std, shape, field)
    yield from zips(std)
    frames = np.broadcast_to(np.eye(3), (GRASPS, CONTACTS, 3, 3))
    for label, value in {
        "good": frames,
        "left_handed": -frames,
        "long": 2 * frames,
        "zero": 0 * frames,
        "nan": np.nan * frames,
        "skew": frames + 0.1,
        "flat": frames[..., 0],
        "fortran": np.asfortranarray(frames),
        "swapped": frames.astype(">f4"),
    }.items():
        yield f"frames_{label}", saved(**{k: v for k, v in good.items() if k != "outward_normals"}, frames=value)
        yield f"both_{label}", saved(**good, frames=value)
    yield "bomb_header", zipped([*std, ("extra.npy", raw(b" " * 80_000_000, version=(2, 0)))], zipfile.ZIP_DEFLATED)


def bomb(std: list[tuple[str, bytes]], shape: tuple[int, ...], field: str) -> Any:
    """Zeros that inflate a thousandfold."""

    def write(path: Path) -> None:
        left, zeros = 8 * int(np.prod(shape)), bytes(1 << 24)
        with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED, compresslevel=1) as archive:
            for name, content in std:
                if name != f"{field}.npy":
                    archive.writestr(name, content)
            with archive.open(f"{field}.npy", "w", force_zip64=True) as stream:
                np.lib.format.write_array_header_1_0(stream, {"descr": "<f8", "fortran_order": False, "shape": shape})
                while left > 0:
                    left -= stream.write(zeros[: min(left, len(zeros))])

    return write


def arrays(draw: random.Random, home: Path) -> Iterator[tuple[str, Any]]:
    wrenches = np.eye(6)
    good = member(wrenches)
    yield from damaged(good, draw, 60, 15)
    for name, head in HEADERS.items():
        text = head if isinstance(head, bytes) else (head.replace("4, 3)", "6)") + "\n").encode()
        yield f"header_{name}", raw(text, bytes(288))
    yield "header_long", raw(b" " * 5_000_000, version=(2, 0))
    for name, value in {
        "none": np.zeros((0, 6)), "seven": np.zeros((3, 7)), "one": np.zeros(6), "nan": wrenches * np.nan,
        "inf": wrenches * np.inf, "complex": wrenches * 1j, "booleans": wrenches > 0, "text": np.full((6, 6), "1"),
        "integers": wrenches.astype(int), "large": wrenches * 1e300, "tiny": wrenches * 1e-300, "zero": wrenches * 0,
        "half": wrenches.astype("f2"), "long": wrenches.astype("g"), "fields": np.zeros((6, 6), [("a", "f8")]),
        "fortran": np.asfortranarray(np.arange(12.0).reshape(2, 6)), "many": np.tile(wrenches, (30_000, 1)),
        "big_endian": wrenches.astype(">f8"), "deep": np.zeros((1, 1, 6)),
    }.items():  # fmt: skip
        yield name, member(value)
    yield "objects", member(np.array([Evil()], object), allow_pickle=True)
    yield "archive", saved(wrenches=wrenches)
    yield "longer", good + b"more"
