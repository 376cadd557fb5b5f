"""Archives that lie about themselves, as zip knows many ways to."""

from __future__ import annotations

import io
import struct
import zipfile
import zlib
from collections.abc import Iterator
from typing import Any

import numpy as np

Members = list[tuple[str, bytes]]
ENTRY, END = b"PK\x01\x02", b"PK\x05\x06"


def stored(members: Members, **fields: Any) -> bytes:
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w", fields.pop("method", zipfile.ZIP_STORED)) as archive:
        archive.comment = fields.pop("comment", b"")
        for name, content in members:
            info = zipfile.ZipInfo(name)
            info.compress_type = archive.compression
            for field, value in fields.items():
                setattr(info, field, value)
            archive.writestr(info, content)
    return stream.getvalue()


def changed(content: bytes, mark: bytes, offset: int, value: bytes, which: int = 0) -> bytes:
    """Overwrites bytes after the mark's occurrence of this number."""
    where, found = -1, bytearray(content)
    for _ in range(which + 1):
        where = content.index(mark, where + 1)
    found[where + offset : where + offset + len(value)] = value
    return bytes(found)


def header_of(fields: int) -> bytes:
    """A member whose header says much about nothing."""
    kind = np.dtype([(f"f{n}", "f8") for n in range(fields)])
    stream = io.BytesIO()
    np.lib.format.write_array(stream, np.zeros(0, kind))
    return stream.getvalue()


def zips(members: Members) -> Iterator[tuple[str, bytes]]:
    plain = stored(members)
    inner = plain
    for _ in range(60):
        inner = stored([("positions.npy", inner)])
    yield "nested_60", inner
    yield "nested_field", stored([*members, ("extra.npy", plain)])
    yield "in_front", stored([("positions.npy", b"junk")]) + plain
    yield "behind", plain + stored([("positions.npy", b"junk")])
    yield "end_in_comment", stored(members, comment=END + bytes(18))
    yield "comment", stored(members, comment=b"c" * 65_535)
    yield "extra_field", stored(members, extra=b"\xff\xff" + struct.pack("<H", 60_000) + bytes(60_000))
    yield "extra_cut", stored(members, extra=b"\x75\x70\xff\x00abc")
    for size in (0, 1, 2**31, 2**63 - 1, 2**64 - 1):
        lies = changed(plain, ENTRY, 20, b"\xff" * 8)
        where = lies.index(ENTRY)
        length = struct.unpack_from("<H", lies, where + 28)[0]
        extra = struct.pack("<HHQQ", 1, 16, size, size)
        lies = lies[: where + 30] + struct.pack("<H", 20) + lies[where + 32 : where + 46 + length] + extra
        lies += plain[where + 46 + length :]
        directory = plain[plain.index(END) + 12 : plain.index(END) + 16]
        yield f"zip64_{size}", changed(lies, END, 12, struct.pack("<I", struct.unpack("<I", directory)[0] + 20))
    yield "zip64_without", changed(plain, ENTRY, 20, b"\xff" * 8)
    yield "zip64_end", changed(plain, END, 10, b"\xff" * 10)
    for which in range(len(members)):
        yield f"checksum_{which}", changed(plain, ENTRY, 16, b"abcd", which)
        yield f"smaller_{which}", changed(plain, ENTRY, 20, struct.pack("<II", 40, 40), which)
        yield f"larger_{which}", changed(plain, ENTRY, 20, struct.pack("<II", 1 << 20, 1 << 20), which)
        yield f"inflated_{which}", changed(plain, ENTRY, 24, struct.pack("<I", 1 << 30), which)
        yield f"deflated_{which}", changed(plain, ENTRY, 10, struct.pack("<H", 8), which)
        yield f"offset_{which}", changed(plain, ENTRY, 42, struct.pack("<I", 0), which)
        yield f"descriptor_{which}", changed(plain, ENTRY, 8, struct.pack("<H", 8), which)
        yield f"encrypted_{which}", changed(plain, ENTRY, 8, struct.pack("<H", 1), which)
        yield f"strong_{which}", changed(plain, ENTRY, 8, struct.pack("<H", 0x41), which)
        yield f"local_name_{which}", changed(plain, b"PK\x03\x04", 30, b"X", which)
        yield f"attributes_{which}", changed(plain, ENTRY, 38, struct.pack("<I", 0o120777 << 16), which)
    yield "name_not_utf8", changed(changed(plain, ENTRY, 8, b"\0\x08"), ENTRY, 46, b"\xff\xfe")
    for name in ("positions.npy.npy", "positions.NPY", "./positions.npy", "/positions.npy", "x\\positions.npy", ".npy"):
        yield f"named_{len(name)}", stored([(name, members[0][1]), *members[1:]])
        yield f"also_{len(name)}", stored([*members, (name, members[0][1])])
    blocks = zlib.compressobj(0, wbits=-15)
    empty = b"\x00\x00\x00\xff\xff" * 2_000_000 + blocks.compress(members[0][1]) + blocks.flush()
    slow = stored([("positions.npy", empty), *members[1:]])
    slow = changed(slow, b"PK\x03\x04", 8, struct.pack("<H", 8))
    yield "empty_blocks", changed(changed(slow, ENTRY, 10, b"\x08\0"), ENTRY, 24, struct.pack("<I", len(members[0][1])))
    many = [(f"m{n}.npy", header_of(450)) for n in range(900)]
    yield "long_headers", stored([*members, *many], method=zipfile.ZIP_DEFLATED)
    yield "longest_headers", stored([*members, *many * 11], method=zipfile.ZIP_DEFLATED)
    distinct = [(f"m{n}.npy", header_of(450)) for n in range(9_000)]
    yield "many_long_headers", stored([*members, *distinct], method=zipfile.ZIP_DEFLATED)
