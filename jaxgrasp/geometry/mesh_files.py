"""Triangles in files: STL, OBJ and PLY, of which vertices and faces are read and nothing else.

Readers for viewers also make materials, textures, groups and scenes of a file, in time and memory that a few lines of
it can ask for without bound. Here both are proportional to the file's length, whatever is in it.
"""

import io
import re
import struct
import warnings
from array import array
from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

Triangles = tuple[np.ndarray, np.ndarray]
"""Vertices (V, 3) and indices of corners (F, 3)."""
_Polygons = tuple[np.ndarray, np.ndarray, np.ndarray]
"""Vertices, the corners of all faces one after the other, and how many each face has."""

# Bytes of memory that a byte of a file, and a triangle, may take until distances are known.
BYTE, TRIANGLE = 40, 2048
_LINE, _HEADER, _PIECE = 4096, 1 << 16, 1 << 20
_CORNER = re.compile(rb"^\s*vertex[ \t]+(\S+[ \t]+\S+[ \t]+\S+)", re.MULTILINE | re.IGNORECASE)
# In lines of OBJ: one that goes on in the next, up to three words of a vertex, and all of a face.
_CONTINUED = re.compile(rb"\\[ \t\r\f\v]*(?:\n|\Z)")
_VERTEX = re.compile(rb"^[ \t\r\f\v]*v(?=\s)[ \t\r\f\v]*(\S*[ \t\r\f\v]*\S*[ \t\r\f\v]*\S*)", re.MULTILINE)
_FACE = re.compile(rb"^[ \t\r\f\v]*f((?=\s).*\n)", re.MULTILINE)
_LAST_LINE = re.compile(rb"^\s*endsolid\b[^\n]*\s*\Z", re.MULTILINE | re.IGNORECASE)
_FACETS = np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("attribute", "<u2")])
_KINDS = ("i1", "u1", "i2", "u2", "i4", "u4", "f4", "f8")
_TYPES: dict[str, str] = dict(
    zip(("char", "uchar", "short", "ushort", "int", "uint", "float", "double"), _KINDS, strict=True)
)
_TYPES |= dict(zip(("int8", "uint8", "int16", "uint16", "int32", "uint32", "float32", "float64"), _KINDS, strict=True))


def read_triangles(content: bytes, kind: str, most: int) -> Triangles:
    """Reads vertices and triangles, and drops repeated ones; polygons become fans about their first corner.

    Args:
        content: The file's.
        kind: stl, obj or ply.
        most: How many triangles there may be.

    Raises:
        ValueError: The file is damaged, or has more.
    """
    vertices, corners, counts = {"stl": _stl, "obj": _obj, "ply": _ply}[kind](content)
    if counts.size and counts.min() < 3:
        raise ValueError("a face of fewer than three corners")
    if len(corners) - 2 * len(counts) > most:
        raise ValueError(f"{len(corners) - 2 * len(counts):,} triangles where {most:,} are allowed, see --read-limit")
    if corners.size and not (corners.min() >= 0 and corners.max() < len(vertices)):
        raise ValueError(f"corners that are none of its {len(vertices):,} vertices")
    return vertices, _once(_fans(corners, counts), len(vertices))


def _once(faces: np.ndarray, vertices: int) -> np.ndarray:
    """Drops repeated triangles, which take time and count twice in winding numbers; keeps all of very large meshes."""
    # One number stands for a triangle, as long as 64 bits hold it.
    if vertices >= 1 << 20:
        return faces
    first = faces.argmin(1)[:, None]
    turned = np.take_along_axis(faces, (first + np.arange(3)) % 3, 1).astype(np.int64)
    _, kept = np.unique((turned[:, 0] * vertices + turned[:, 1]) * vertices + turned[:, 2], return_index=True)
    return faces if len(kept) == len(faces) else faces[np.sort(kept)]


def _fans(corners: np.ndarray, counts: np.ndarray) -> np.ndarray:
    """Triangles of polygons with so many corners each."""
    if (counts == 3).all():
        return corners.reshape(-1, 3)
    of_polygon = np.repeat(np.cumsum(counts) - counts, counts - 2)
    turn = np.arange(len(of_polygon)) - np.repeat(np.cumsum(counts - 2) - (counts - 2), counts - 2)
    return np.stack([corners[of_polygon], corners[of_polygon + turn + 1], corners[of_polygon + turn + 2]], -1)


def _check_lines(content: bytes) -> None:
    """Refuses text that is none, before it is taken apart."""
    if max(map(len, io.BytesIO(content)), default=0) > _LINE:
        raise ValueError(f"a line of more than {_LINE:,} characters")


def _numbers(text: bytes, kind: type = float) -> np.ndarray:
    """Numbers with space between them, in the spelling that is common to all languages."""
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        return np.fromstring(text.strip(), kind, sep=" ")


def _stl(content: bytes) -> _Polygons:
    count = int.from_bytes(content[80:84], "little")
    # Some binary files begin with "solid", as text does: their length tells.
    if len(content) >= 84 and len(content) == 84 + count * _FACETS.itemsize:
        corners = np.frombuffer(content, _FACETS, count, 84)["corners"].reshape(-1, 3).astype(float)
    elif content[:_LINE].lstrip()[:5].lower() == b"solid":
        _check_lines(content)
        if not _LAST_LINE.search(content[-_LINE:]):
            raise ValueError("the file ends early")
        corners = _numbers(b" ".join(_CORNER.findall(content))).reshape(-1, 3)
    else:
        raise ValueError(f"{len(content):,} bytes where {count:,} triangles are declared")
    if len(corners) % 3:
        raise ValueError(f"{len(corners):,} corners of triangles")
    # Each vertex is there once for every triangle that it is a corner of.
    order = np.lexsort(corners.T)
    ordered = corners[order]
    first = np.concatenate([np.ones(len(corners[:1]), bool), (ordered[1:] != ordered[:-1]).any(1)])
    indices = np.empty(len(corners), np.int64)
    indices[order] = np.cumsum(first) - 1
    return ordered[first], indices, np.full(len(corners) // 3, 3)


def _pieces(content: bytes) -> Iterator[tuple[int, bytes]]:
    """Pieces of whole lines and where they begin: of all lines at a time, as many words would be in memory."""
    begin = 0
    while begin < len(content):
        end = content.find(b"\n", begin + _PIECE) + 1 or len(content)
        yield begin, content[begin:end]
        begin = end


def _obj(content: bytes) -> _Polygons:
    content = b"".join(_CONTINUED.sub(b" ", piece) for _, piece in _pieces(content)) + b"\n"
    _check_lines(content)
    points, rows, faces = [], 0, []
    for _, piece in _pieces(content):
        found = _VERTEX.findall(piece)
        points.append(b" ".join(found))
        rows += len(found)
        # Of normals and textures nothing is kept.
        faces.append(re.sub(rb"/\S*", b"", b"".join(_FACE.findall(piece))))
    points = _numbers(b" ".join(points))
    if len(points) != 3 * rows:
        raise ValueError("a vertex of fewer than three numbers")
    faces = b"".join(faces)
    corners = _numbers(faces, int)
    text = np.frombuffer(b" " + faces, np.uint8)
    blank = text <= ord(" ")
    words, ends = np.flatnonzero(blank[:-1] & ~blank[1:]), np.flatnonzero(text == ord("\n"))
    counts = np.diff(np.searchsorted(words, ends), prepend=0)
    if (corners < 0).any():
        # Counted backwards from the last vertex before the face.
        of_points, of_faces = (_starts(kind, content) for kind in (_VERTEX, _FACE))
        before = np.repeat(np.searchsorted(of_points, of_faces), counts)
        corners = np.where(corners < 0, before + 1 + corners, corners)
    return points.reshape(-1, 3), corners - 1, counts


def _starts(kind: re.Pattern, content: bytes) -> np.ndarray:
    """Where matches begin."""
    starts = [
        np.array([begin + found.start() for found in kind.finditer(piece)], int) for begin, piece in _pieces(content)
    ]
    return np.concatenate(starts)


class _Property(NamedTuple):
    """A column of an element: its type, and that of its length where it is one of lists."""

    name: str
    kind: str
    length: str | None


class _Element(NamedTuple):
    name: str
    rows: int
    properties: list[_Property]


def _ply(content: bytes) -> _Polygons:
    end = re.search(rb"^end_header[ \t]*(?:\r\n|\n|\r)", content[:_HEADER], re.MULTILINE)
    if not end or not re.match(rb"ply\s", content):
        raise ValueError("no header, or one that does not end")
    order, elements = _declared(content[: end.start()].decode("latin-1"))
    if sum(element.rows for element in elements) > len(content):
        raise ValueError("more elements than bytes")
    data, at, found = memoryview(content)[end.end() :], 0, {}
    if order is None:
        # Numbers of text are as good as any in binary.
        text, order = content[end.end() :], "="
        _check_lines(text)
        data = _numbers(text).data.cast("B")
    for element in elements:
        if element.name in found:
            raise ValueError(f"two elements {element.name!r}")
        found[element.name], at = _columns(data, at, element, order)
    vertex, face = found.get("vertex", {}), found.get("face", {})
    lists = [face[name] for name in ("vertex_indices", "vertex_index") if name in face]
    if not {"x", "y", "z"} <= vertex.keys() or not lists:
        raise ValueError("no x, y and z of vertices, or no lists of corners")
    corners, counts = lists[0]
    if not (np.abs(corners) < 2**53).all() or (corners != np.floor(corners)).any():
        raise ValueError("corners that are no whole numbers")
    points = np.stack([vertex[axis][0] for axis in "xyz"], -1)
    return points.astype(float), corners.astype(np.int64, copy=False), counts


def _columns(
    data: memoryview, at: int, element: _Element, order: str
) -> tuple[dict[str, tuple[np.ndarray, np.ndarray]], int]:
    """An element's columns by name, each the values of all rows and how many a row has, and where the next begins."""
    row, lengths = [], []
    where = at
    for name, kind, length in element.properties:
        count = 1
        if length and element.rows:
            count = _whole(np.frombuffer(data, order + length, 1, where)[0])
            where += np.dtype(length).itemsize
            lengths.append((f"number of {name}", count))
            row.append((lengths[-1][0], order + length))
        if not 0 <= count <= len(data):
            raise ValueError("lists that are longer than the file")
        row.append((name, order + kind, (count,)))
        where += count * np.dtype(kind).itemsize
    kinds = np.dtype(row)
    if at + element.rows * kinds.itemsize <= len(data):
        table = np.frombuffer(data, kinds, element.rows, at)
        if all((table[name] == count).all() for name, count in lengths):
            columns = {
                p.name: (table[p.name].reshape(-1), np.full(element.rows, table[p.name].shape[1]))
                for p in element.properties
            }
            return columns, at + element.rows * kinds.itemsize
    return _uneven(data, at, element, order)


def _whole(count: float) -> int:
    if count != int(count):
        raise ValueError("lists that have no whole number of corners")
    return int(count)


def _uneven(
    data: memoryview, at: int, element: _Element, order: str
) -> tuple[dict[str, tuple[np.ndarray, np.ndarray]], int]:
    """An element's lists by name, where rows have lists of different lengths; other columns are passed over."""
    values = {p.name: bytearray() for p in element.properties if p.length}
    counts = {name: array("q") for name in values}
    sizes = [np.dtype(p.kind).itemsize for p in element.properties]
    lengths = [struct.Struct(order + np.dtype(p.length).char) if p.length else None for p in element.properties]
    steps = list(zip([p.name for p in element.properties], sizes, lengths, strict=True))
    for _ in range(element.rows):
        for name, size, length in steps:
            if length is None:
                at += size
                continue
            (count,) = length.unpack_from(data, at)
            count, at = _whole(count), at + length.size
            if not 0 <= count <= len(data):
                raise ValueError("lists that are longer than the file")
            values[name] += data[at : at + count * size]
            counts[name].append(count)
            at += count * size
        if at > len(data):
            raise ValueError("the file ends early")
    kinds = {p.name: order + p.kind for p in element.properties}
    return {name: (np.frombuffer(values[name], kinds[name]), np.array(counts[name])) for name in values}, at


def _declared(header: str) -> tuple[str | None, list[_Element]]:
    """The order of bytes, None for text, and the elements."""
    order, elements = "", []
    for words in map(str.split, header.splitlines()[1:]):
        match words:
            case ["format", "ascii" | "binary_little_endian" | "binary_big_endian" as name, "1.0"]:
                order = {"ascii": None, "binary_little_endian": "<", "binary_big_endian": ">"}[name]
            case ["element", name, count] if count.isdigit() and len(count) < 16:
                elements.append(_Element(name, int(count), []))
            case ["property", "list", length, kind, name] if elements and _TYPES[length][0] in "iu":
                elements[-1].properties.append(_Property(name, _TYPES[kind], _TYPES[length]))
            case ["property", kind, name] if elements:
                elements[-1].properties.append(_Property(name, _TYPES[kind], None))
            case ["comment" | "obj_info", *_] | []:
                pass
            case _:
                raise ValueError("a header that is none")
    if order == "":
        raise ValueError("no format")
    if order is None:
        elements = [e._replace(properties=[_in_text(p) for p in e.properties]) for e in elements]
    for element in elements:
        names = [column.name for column in element.properties]
        if len(set(names)) < len(names) or not names:
            raise ValueError("elements without properties, or with two of one name")
    return order, elements


def _in_text(column: _Property) -> _Property:
    return column._replace(kind="f8", length=column.length and "f8")
