"""Malformed distributions of what is not known of grasps, in JSON and in archives, for `rank --uncertainty`."""

from __future__ import annotations

import random
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.assaults.arrays import CONTACTS, member, zipped
from benchmarks.assaults.damage import damaged

# What a JSON file says of a quantity, as some program or some person would write it.
_VALUES = (
    "NaN",
    "Infinity",
    "-Infinity",
    "1e400",
    "-0.1",
    "true",
    "null",
    '"0.1"',
    "[]",
    "[[]]",
    "{}",
    "[0.1, [0.2]]",
    "[null]",
    "[0.1, 0.2, 0.3, 0.4, 0.5]",
    "9" * 5000,
    "[" * 100_000,
    "1" * 400,
    "0x1",
    "1_0",
    ".1",
    "[true]",
    '{"std": {}}',
    '{"std": 0.1, "half_width": 0.1}',
    '{"std": 0.1, "lower": 1, "upper": -1}',
    '{"std": 0.1, "lower": null}',
    '{"std": 0.1, "correlation": 2}',
    '{"std": 0.1, "correlation": "x"}',
    '{"std": 0.1, "correlation": [[1, 2], [2, 1]]}',
    '{"std": 0.1, "correlation": [[1]]}',
    '{"std": 0.1, "correlation": NaN}',
    '{"std": 0.1, "sdt": 0.1}',
    '{"std": 1e300}',
    '{"mean": 0.1}',
    '{"half_width": -1}',
    '{"samples": []}',
    '{"samples": 0.1}',
    '{"samples": [[0.1], [0.1, 0.2]]}',
    '{"samples": [[NaN]]}',
    '{"samples": [0.1]}',
    '{"half_width": 0.1, "lower": 0}',
    '{"std": 1e-320}',
    '{"\\ud800": 1}',
    '{"std": 0.1, "lower": -1e-300, "upper": 1e-300}',
    '{"std": 0.1, "mean": 1e308}',
    '{"std": 0, "lower": 1}',
)


def distributions(draw: random.Random, home: Path) -> Iterator[tuple[str, Any]]:
    good = b'{"friction": {"std": 0.1, "correlation": 1.0, "lower": -0.3}, "position": 0.002, "normal": 0.12}'
    yield from damaged(good, draw, 25, 6)
    for name in ("friction", "position", "mass"):
        for number, value in enumerate(_VALUES):
            yield f"{name}_{number}", f'{{"{name}": {value}}}'.encode()
    yield from {
        "list": b"[1]",
        "number": b"1",
        "text": b'"x"',
        "null": b"null",
        "nothing": b"{}",
        "unknown": b'{"frictoin": 1}',
        "twice": b'{"friction": 0.1, "friction": "x"}',
        "bom": b"\xef\xbb\xbf" + good,
        "utf16": good.decode().encode("utf-16"),
        "latin": b'{"gr\xf6\xdfe": 1}',
        "nul": good.replace(b" ", b"\0"),
        "after": good + b" x",
        "control": b'{"a\x1b[31m": 1}',
        "comment": b"// x\n" + good,
        "comma": b'{"friction": 0.1,}',
        "surrogate": b'{"\\udcff": 0.1}',
        "long_name": b'{"' + b"x" * 10**6 + b'": 1}',
        "deep": b'{"a":' * 100_000,
        "numbers": b'{"friction": [' + b"0.1," * 3_000_000 + b"0.1]}",
        "lists": b'{"friction": {"samples": [' + b"[0.1]," * 2_000_000 + b"[0.1]]}}",
        "many": b'{"friction": 0.1, "a": [' + b"{}," * 5_000_000 + b"{}]}",
        "samples_apart": b'{"friction": {"samples": [[1, 1, 1], [1, 1, 1]]}, "mass": {"samples": [1]}}',
    }.items()


def archived_distributions(draw: random.Random, home: Path) -> Iterator[tuple[str, Any]]:
    draws = np.random.default_rng(0).normal(scale=0.1, size=(40, CONTACTS))

    def archive(**fields: Any) -> bytes:
        return zipped([(f"{name}.npy", member(np.asarray(value))) for name, value in fields.items()])

    yield from damaged(archive(friction=draws, mass=draws[:, 0]), draw, 40, 10)
    options: dict[str, Any] = {"friction.std": 0.1}
    for label, fields in {
        "complex": {"friction": draws * 1j},
        "text": {"friction": draws.astype("U")},
        "dates": {"friction": draws.astype("M8[s]")},
        "truth": {"friction": draws > 0},
        "rows": {"friction": np.zeros(3, [("a", "f8")])},
        "none": {"friction": draws[:0]},
        "point": {"friction": 0.1},
        "nan": {"friction": draws * np.nan},
        "huge": {"friction": draws * 1e308},
        "deep": {"friction": draws[..., None, None]},
        "other_counts": {"friction": draws, "mass": draws[:7, 0]},
        "unknown": {"slip": draws},
        "dots": {"friction.std.std": 0.1},
        "dot": {"friction.": draws},
        "nameless": {"": draws},
        "option": {"friction.sdt": 0.1},
        "both": {"friction": draws, "friction.std": 0.1},
        "long_double": {"friction": draws.astype("g")},
        "big_endian": {"friction": draws.astype(">f8")},
        "six_contacts": {"friction": np.ones((40, 6))},
        "uniform": {"friction.half_width": 0.1, "friction.lower": 0},
        "correlation_none": options | {"friction.correlation": np.zeros((CONTACTS, CONTACTS))},
        "correlation_large": options | {"friction.correlation": np.eye(7)},
        "correlation_nan": options | {"friction.correlation": np.eye(CONTACTS) * np.nan},
        "correlation_row": options | {"friction.correlation": np.ones(CONTACTS)},
        "correlation_none_at_all": options | {"friction.correlation": np.zeros((0, 0))},
        "std_negative": {"friction.std": -np.ones(CONTACTS)},
        "a_million": {"friction": np.full((1_000_000, CONTACTS), 0.01)},
        "one": {"friction": draws[:1]},
    }.items():
        yield label, archive(**fields)
