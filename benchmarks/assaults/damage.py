"""Damage that any file can take."""

from __future__ import annotations

import random
from collections.abc import Iterator


def damaged(
    content: bytes, draw: random.Random, flips: int, cuts: int, within: int | None = None
) -> Iterator[tuple[str, bytes]]:
    """Bits flipped, of all bytes or of the last ones; bytes cut off, left out, doubled or overwritten."""
    for _ in range(flips):
        changed, where = bytearray(content), len(content) - 1 - draw.randrange(within or len(content))
        changed[where] ^= 1 << draw.randrange(8)
        yield f"flip{where}", bytes(changed)
    for _ in range(cuts):
        where, length = draw.randrange(len(content)), draw.randrange(1, 200)
        yield f"cut{where}", content[:where]
        yield f"left_out{where}", content[:where] + content[where + length :]
        yield f"doubled{where}", content[: where + length] + content[where:]
        yield f"noise{where}", content[:where] + draw.randbytes(length) + content[where + length :]
