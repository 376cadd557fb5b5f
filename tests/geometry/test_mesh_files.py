"""Triangles of files, against trimesh's readers and writers; damaged and absurd ones."""

import re
import struct
import time

import numpy as np
import pytest
import trimesh

from jaxgrasp.geometry import Mesh, MeshError
from jaxgrasp.geometry.mesh_files import read_triangles
from jaxgrasp.storage import limited_to

MOST = 10_000
CUBE = np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)], float)
QUADS = np.array([[0, 1, 3, 2], [4, 6, 7, 5], [0, 4, 5, 1], [2, 3, 7, 6], [0, 2, 6, 4], [1, 5, 7, 3]])


def coloured() -> trimesh.Trimesh:
    made = trimesh.creation.icosphere(subdivisions=2, radius=0.03)
    made.visual.vertex_colors = np.random.default_rng(0).integers(0, 255, (len(made.vertices), 4), np.uint8)
    return made


@pytest.mark.parametrize(
    ("kind", "options"),
    [
        ("stl", {}),
        ("stl", {"file_type": "stl_ascii"}),
        ("obj", {"include_normals": True, "include_color": True}),
        ("ply", {"vertex_normal": True}),
        ("ply", {"vertex_normal": True, "encoding": "ascii"}),
    ],
)
def test_what_trimesh_writes(kind, options):
    made = coloured()
    content = made.export(**{"file_type": kind} | options)
    vertices, faces = read_triangles(content.encode() if isinstance(content, str) else content, kind, MOST)
    assert len(vertices) == len(made.vertices)
    np.testing.assert_allclose(vertices[faces], made.triangles, atol=1e-7)


def cube_of(kind: str, lengths: list[int], order: str = "<") -> bytes:
    """A cube as PLY, of squares and of triangles, with properties that are passed over."""
    name = {"<": "binary_little_endian", ">": "binary_big_endian", "": "ascii"}[order]
    header = (
        f"ply\r\nformat {name} 1.0\r\ncomment größe\r\nelement void 1\r\nproperty uchar a\r\nelement vertex 8\r\n"
        f"property double x\r\nproperty {kind} y\r\nproperty short z\r\nelement face {len(lengths)}\r\n"
        "property uchar flag\r\nproperty list uchar uint vertex_index\r\nproperty list ushort float more\r\n"
        "end_header\r\n"
    ).encode()
    faces = [q[:n] for q, n in zip(QUADS, lengths, strict=True)]
    if not order:
        rows = [f"{x} {y} {z:.0f}" for x, y, z in CUBE]
        rows += [f"9 {len(f)} {' '.join(map(str, f))} {i % 3} {'0.5 ' * (i % 3)}" for i, f in enumerate(faces)]
        return header + "\n".join(["7", *rows]).encode()
    letter = {"float": "f", "int": "i"}[kind]
    body = b"\7" + b"".join(struct.pack(f"{order}d{letter}h", x, int(y), int(z)) for x, y, z in CUBE)
    for i, f in enumerate(faces):
        body += struct.pack(f"{order}BB{len(f)}IH{i % 3}f", 9, len(f), *f, i % 3, *[0.5] * (i % 3))
    return header + body


@pytest.mark.parametrize("order", ["<", ">", ""])
@pytest.mark.parametrize("kind", ["float", "int"])
@pytest.mark.parametrize("lengths", [[4] * 6, [4, 4, 4, 4, 3, 4]])
def test_polygons_and_orders_of_bytes(order, kind, lengths):
    vertices, faces = read_triangles(cube_of(kind, lengths, order), "ply", MOST)
    np.testing.assert_array_equal(vertices, CUBE)
    wanted = [[q[0], q[i], q[i + 1]] for q, n in zip(QUADS, lengths, strict=True) for i in range(1, n - 1)]
    np.testing.assert_array_equal(faces, wanted)


def test_indices_of_obj_count_from_one_or_backwards():
    points = "".join(f"v {x} {y} {z} 1 1 1\n" for x, y, z in CUBE)
    ahead = points + "".join("f " + " ".join(f"{i + 1}/{i}//" for i in q) + "\n" for q in QUADS)
    back = points + "".join("f \\\n " + " ".join(str(i - 8) for i in q) + "\r\n" for q in QUADS)
    for text in (ahead, back, "g a\nusemtl b\ns 1\n" + ahead + "l 1 2\np 1\n"):
        vertices, faces = read_triangles(text.encode(), "obj", MOST)
        np.testing.assert_array_equal(vertices, CUBE)
        assert Mesh.from_arrays(vertices, faces).volume == pytest.approx(1.0)
    for line in ("f 0 1 2 3", "f -9 1 2", "f 1 2 9", "f 1 2", "f 1.0 2 3", "v 1 2", "v a 1 2"):
        with pytest.raises(ValueError):
            read_triangles(f"{ahead}{line}\n".encode(), "obj", MOST)


BOX = trimesh.creation.box((1, 2, 3))


@pytest.mark.parametrize(
    ("name", "content"),
    [
        ("materials.obj", b"v 0 0 0\n" * 3 + b"".join(b"usemtl a%d\nf 1 2 3\n" % n for n in range(20_000))),
        ("line.obj", b"v " + b"1 " * 3_000_000),
        ("corners.obj", b"v 0 0 0\n" * 3 + b"f " + b"1 2 3 " * 1_000_000),
        ("continued.obj", b"v 0 0 0\n" * 3 + b"f 1 \\\n" * 1_000_000),
        ("comment.ply", b"ply\ncomment " + b"x" * 10_000_000),
        ("elements.ply", b"ply\n" + b"".join(b"element e%d 0\nproperty int x\n" % n for n in range(100_000))),
        ("long_lists.ply", cube_of("int", [4] * 6).replace(b"\x09\x04", b"\x09\xff")),
        ("cut.ply", cube_of("int", [4, 3, 4, 3, 4, 3])[:-9]),
        ("cut.stl", BOX.export(file_type="stl_ascii").encode()[:-100]),
        ("longer.stl", BOX.export(file_type="stl") + b"more"),
        ("solids.stl", b"solid\nfacet\nvertex 0 0 0\nvertex 1 0 0\nvertex 0 1 0\nendsolid\n" * 20_000),
    ],
)
def test_what_a_few_lines_ask_for_is_not_given(tmp_path, name, content):
    path, begun = tmp_path / name, time.process_time()
    path.write_bytes(content)
    with pytest.raises(MeshError, match="got"):
        Mesh.from_file(path)
    assert time.process_time() - begun < 5.0


def test_triangles_that_are_repeated_count_once():
    corners = b"v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\n"
    content = corners + b"f 1 3 2\nf 3 2 1\nf 1 2 4\nf 2 3 4\nf 2 1 3\nf 1 2 3\nf 1 4 3\n"
    found = read_triangles(content, "obj", 100)[1]
    np.testing.assert_array_equal(found, [[0, 2, 1], [0, 1, 3], [1, 2, 3], [0, 1, 2], [0, 3, 2]])


def test_triangles_are_as_many_as_the_budget_allows(tmp_path):
    path = tmp_path / "ball.stl"
    coloured().export(path)
    with limited_to(len(coloured().faces) * 2048):
        Mesh.from_file(path)
    with limited_to(len(coloured().faces) * 2048 - 1), pytest.raises(MeshError, match="319 are allowed"):
        Mesh.from_file(path)


@pytest.mark.parametrize("kind", ["stl", "obj"])
@pytest.mark.parametrize("number", ["1_0", "1/20", "0x1", "1,5"])
def test_numbers_are_those_of_the_format(kind, number):
    made = trimesh.creation.box((10, 10, 10)).apply_translation((5, 5, 5))
    text = made.export(file_type="stl_ascii" if kind == "stl" else "obj")
    spoilt = re.sub(r"(?m)^(\s*v(?:ertex)? +)\S+", rf"\g<1>{number}", text, count=1)
    with pytest.raises(ValueError):
        read_triangles(spoilt.encode(), kind, MOST)
