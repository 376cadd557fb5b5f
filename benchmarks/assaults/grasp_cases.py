"""Files of grasps that are malicious, broken, or say what cannot be: each must be refused in one line."""

from __future__ import annotations

import io
import json
import os
import pickle
import random
import warnings
import zipfile
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np

from benchmarks.assaults.grasp_samples import OF_LINK, SAMPLES, of_palm, save, truth
from benchmarks.assaults.hostile_pickles import CALLS, CANARY, RAW, Call
from benchmarks.assaults.inputs import Case
from benchmarks.assaults.torch_sample import torch_file

_OBJECTS = b"{'descr': '|O', 'fortran_order': False, 'shape': (), }"
_PROTOCOLS = (2, 4)
# Of the samples, those that are one file.
_SINGLE = [name for name in SAMPLES if name not in ("dexgraspbench", "dexonomy", "dexonomy legacy")]


def cases(folder: Path) -> list[Case]:
    """Writes all of them into a folder."""
    found = []
    for kind, makes in KINDS.items():
        home = folder / kind
        home.mkdir(parents=True)
        for make in makes:
            for name, path in make(home):
                found.append(Case(kind, name, path))
    return found


def npy(content: bytes) -> bytes:
    """An `.npy` file of one object with this pickle."""
    header = _OBJECTS + b" " * (117 - len(_OBJECTS)) + b"\n"
    return b"\x93NUMPY\x01\x00" + len(header).to_bytes(2, "little") + header + content


def pickles(home: Path) -> Iterator[tuple[str, Path]]:
    for name, value in CALLS.items():
        for protocol in _PROTOCOLS:
            yield _written(home, f"{name} {protocol}", ".npy", npy(pickle.dumps({"grasp_qpos": value}, protocol)))
    for name, content in RAW.items():
        yield _written(home, name, ".npy", npy(content))
        if content.startswith(b"\x80"):
            yield _written(home, f"{name} bare", ".pkl", content)
    header, path = npy(b""), home / "sparse.npy"
    path.write_bytes(header)
    os.truncate(path, 100 << 20)
    yield "sparse", path
    large = b"\x8e" + (90 << 20).to_bytes(8, "little") + bytes(90 << 20)
    yield _written(home, "bytes", ".npy", npy(b"}X\x0a\0\0\0grasp_qpos" + large + b"s."))
    for name in ("os.system", "eval"):
        yield _written(home, f"{name} bare", ".pkl", pickle.dumps(CALLS[name], 2))
        # What ends before the pickle does, and a list of a good grasp and a call.
        yield _written(home, f"{name} second", ".npy", npy(pickle.dumps([{"qpos": {}}, CALLS[name]], 2)))


def torch(home: Path) -> Iterator[tuple[str, Path]]:
    values = {"values": np.arange(4.0), "parameters": {"root_pose": np.zeros((4, 7)), "a": np.arange(4.0)}}
    call = pickle.dumps(Call(os.system, f"touch {CANARY}"), 2)
    for name, change in {
        "a call": {"pickle": call},
        "more numbers than there are": {"numel": 10**12},
        "a shape beyond the storage": {"shape": (10**9,)},
        "strides beyond the storage": {"shape": (4,), "stride": (10**9,)},
        "an offset before the storage": {"offset": -1},
        "another member": {"key": "../../../etc/passwd"},
        "bytes to load": {"rebuild": ("torch.storage", "_load_from_bytes")},
        "a rebuild of elsewhere": {"rebuild": ("builtins", "eval")},
        "compressed": {"compression": zipfile.ZIP_DEFLATED},
        "no numbers at all": {"pickle": b"N."},
    }.items():
        path = home / f"{name}.pt"
        torch_file(path, values, **change)
        yield name, path
    yield _written(home, "of old", ".pt", b"\x80\x02\x8a\nl\xfc\x9cF\xf9 j\xa8P\x19.\x80\x02M\xe9\x03.")


def yaml(home: Path) -> Iterator[tuple[str, Path]]:
    good = SAMPLES["isaac_grasp"](home, truth(), of_palm).read_text()
    (home / "mug.yaml").unlink()
    bomb = "a0: &a0 [x, x]\n" + "".join(f"a{k}: &a{k} [*a{k - 1}, *a{k - 1}, *a{k - 1}]\n" for k in range(1, 40))
    tags = (
        "apply:os.system [touch canary]",
        "new:os.system [touch canary]",
        "name:os.system",
        "module:os",
        "object:x.Y",
    )
    for number, tag in enumerate(tags):
        kind = "object/" if number < 2 else ""
        yield _written(home, f"tag {number}", ".yaml", good.replace("grasps:", f"x: !!python/{kind}{tag}\ngrasps:"))
    for name, (old, new) in {
        "tag binary": ("grasps:", "x: !!binary aGVsbG8=\ngrasps:"),
        "own tag": ("grasps:", "x: !mine 1\ngrasps:"),
        "aliases without end": ("format:", bomb + "format:"),
        "alias of itself": ("grasps:", "x: &a [*a]\ngrasps:"),
        "deep": ("grasps:", "x: " + "[" * 100_000 + "\ngrasps:"),
        "deep maps": ("grasps:", "x: " + "{a: " * 5_000 + "\ngrasps:"),
        "keys of lists": ("grasps:", "? [1, 2]\n: 3\ngrasps:"),
        "a long number": ("position: [", "position: [" + "9" * 100_000 + ", "),
        "another version": ("version: 1.0", "version: 9.0"),
        "a version of words": ("version: 1.0", "version: newest"),
        "no grasps": ("grasps:", "grasp:"),
        "no turn": ("orientation:", "orientated:"),
        "words for numbers": ("w: ", "w: north "),
        "two places": ("position: [", "position: [1, 2, "),
        "other joints": ("      c:", "      d:"),
        "joints of one grasp alone": ("    cspace_position:", "    cspace:"),
        "a scale of words": ("object_scale: 0.08", "object_scale: large"),
        "tabs": ("grasps:", "grasps:\n\t- x"),
        "no Unicode": ("mug", "\udcff"),
    }.items():
        assert old in good, name
        yield _written(home, name, ".yaml", good.replace(old, new, 1).encode("utf-8", "surrogateescape"))


def text(home: Path) -> Iterator[tuple[str, Path]]:
    good = SAMPLES["multigrippergrasp"](home, truth(), of_palm).read_text()
    table = json.loads(good)
    (home / "claw-mug.json").unlink()
    for name, change in {
        "other counts": {"dofs": table["dofs"][:2]},
        "no dofs": {"dofs": []},
        "words": {"dofs": [["x"] * 3] * 4},
        "objects": {"dofs": {"a": 1}},
        "ragged": {"pose": [[0] * 7, [0] * 6]},
        "too many joints": {"dofs": [[0.0] * 50] * 4},
        "a number beyond all": {"pose": [[10**400] * 7] * 4},
        "nothing": {"pose": None},
        "ragged results": {"result": [1, [2], 3, 4]},
    }.items():
        yield _written(home, name, ".json", json.dumps(table | change))
    grasps = {"transforms": np.tile(np.eye(4), (20_000, 1, 1)).tolist()}
    yield _written(
        home, "a long name", ".json", json.dumps({"object": {"file": "x" * 10**6, "scale": 1}, "grasps": grasps})
    )
    yield _written(home, "long results", ".json", json.dumps(table | {"result": ["x", "y", "z", "x" * 10**6]}))
    yield _written(home, "long text", ".json", b'{"pose": "' + bytes([97]) * (31 << 20) + "\U0001f600".encode() + b'"}')
    yield _written(home, "deep", ".json", '{"pose": ' + "[" * 1_000_000)
    yield _written(home, "cut", ".json", good[: len(good) // 2])
    yield _written(home, "digits", ".json", '{"pose": ' + "9" * 1_000_000 + "}")
    yield _written(home, "entries", ".json", '{"pose": [' + "[]," * 3_000_000 + "[]]}")
    for name in ("no transforms", "flat transforms", "no scale", "three scales"):
        graspgen = {"object": {"file": "mug", "scale": 1.0}, "grasps": {"transforms": np.zeros((2, 4, 4)).tolist()}}
        if name == "no transforms":
            graspgen["grasps"]["transforms"] = []
        if name == "flat transforms":
            graspgen["grasps"]["transforms"] = [[0.0] * 16]
        if name == "no scale":
            del graspgen["object"]["scale"]
        if name == "three scales":
            graspgen["object"]["scale"] = [1.0, 2.0, 1.0]
        yield _written(home, name, ".json", json.dumps(graspgen))


def xml(home: Path) -> Iterator[tuple[str, Path]]:
    good = SAMPLES["graspit"](home, truth(), of_palm).read_text()
    (home / "mug.xml").unlink()
    head = '<?xml version="1.0" ?>'
    laughs = "".join(f'<!ENTITY l{k} "{f"&l{k - 1};" * 10}">' for k in range(1, 12))
    for name, (old, new) in {
        "entities without end": (head, f'{head}<!DOCTYPE w [<!ENTITY l0 "ha">{laughs}]>'),
        "a file": (head, f'{head}<!DOCTYPE w [<!ENTITY x SYSTEM "file:///etc/passwd">]>'),
        "a definition of elsewhere": (head, f'{head}<!DOCTYPE w SYSTEM "http://nowhere.invalid/w.dtd">'),
        "an entity of nobody": ("mug", "&nobody;"),
        "deep": ("<camera>", "<a>" * 100_000 + "<camera>"),
        "two robots": ("<camera>", "<robot><filename>x</filename></robot><camera>"),
        "no robot": ("robot", "robots"),
        "no pose": ("fullTransform", "halfTransform"),
        "a pose of words": ("(+1 +0", "(north +0"),
        "values of words": ("<dofValues>", "<dofValues>open "),
        "too few values": ("<dofValues>", "<dofValues>1 2 3 4 5 "),
        "cut": ("</world>", ""),
        "another root": ("world>", "worlds>"),
    }.items():
        assert old in good, name
        count = -1 if name in ("no robot", "another root", "no pose") else 1
        yield _written(home, name, ".xml", good.replace(old, new, count))


def tables(home: Path) -> Iterator[tuple[str, Path]]:
    import h5py
    import pyarrow as pa
    from pyarrow import parquet

    def hdf5(name: str, fill: Callable[[h5py.File], None]) -> tuple[str, Path]:
        path = home / f"{name}.h5"
        with h5py.File(path, "w") as file:
            fill(file)
        return name, path

    def large(file: h5py.File) -> None:
        file.create_dataset("grasps/transforms", (10**10, 4, 4), "f4", chunks=(1, 4, 4))

    def inflated(file: h5py.File) -> None:
        file.create_dataset("grasps/transforms", (30_000_000, 4, 4), "f8", chunks=(1000, 4, 4), compression="gzip")

    def zeros(file: h5py.File) -> None:
        data = file.create_dataset("grasps/transforms", (5_000_000, 4, 4), "f8", chunks=(10_000, 4, 4), compression=9)
        data[:20_000] = 0.0

    def outside(file: h5py.File) -> None:
        file.create_dataset("grasps/transforms", (4, 4, 4), "f8", external=[("/etc/passwd", 0, 512)])

    def virtual(file: h5py.File) -> None:
        layout = h5py.VirtualLayout((4, 4, 4), "f8")
        layout[:] = h5py.VirtualSource("/etc/passwd", "x", (4, 4, 4))
        file.create_virtual_dataset("grasps/transforms", layout)

    def link(kind: object) -> Callable[[h5py.File], None]:
        return lambda file: file.__setitem__("grasps/transforms", kind)

    def dexnet(file: h5py.File) -> None:
        file["objects/mug/mesh/vertices"] = np.zeros((3, 3))

    yield hdf5("large", large)
    yield hdf5("inflated", inflated)
    yield hdf5("zeros", zeros)
    yield hdf5("data of another file", outside)
    yield hdf5("virtual", virtual)
    yield hdf5("link to a file", link(h5py.ExternalLink("/etc/passwd", "/x")))
    yield hdf5("link to nothing", link(h5py.SoftLink("/nowhere")))
    yield hdf5("Dex-Net", dexnet)
    yield hdf5("nothing in it", lambda file: None)
    yield hdf5("flat", lambda file: file.__setitem__("grasps/transforms", np.zeros((4, 16))))
    good = SAMPLES["acronym"](home, truth(), of_palm).read_bytes()
    draw = random.Random(0)
    for cut in (100, len(good) // 2, len(good) - 1000):
        yield _written(home, f"cut at {cut}", ".h5", good[:cut])
    for number in range(6):
        broken = bytearray(good)
        # The superblock and the first headers: what the library follows.
        for place in draw.sample(range(8, 600), 60):
            broken[place] = draw.randrange(256)
        yield _written(home, f"noise {number}", ".h5", bytes(broken))
    stream = io.BytesIO()
    parquet.write_table(pa.table({"grasp_qpos": pa.array([[0.0] * 9, [0.0] * 10])}), stream)
    yield _written(home, "ragged", ".parquet", stream.getvalue())
    yield _written(home, "cut", ".parquet", stream.getvalue()[:-20])
    repeated = pa.ListArray.from_arrays(pa.array([0, 30_000_000], pa.int32()), pa.array(np.zeros(30_000_000)))
    stream = io.BytesIO()
    parquet.write_table(pa.table({"grasp_qpos": repeated}), stream)
    yield _written(home, "repeated", ".parquet", stream.getvalue())
    yield _written(home, "no footer", ".parquet", b"PAR1" + b"\0" * 1000)
    yield _written(home, "a footer beyond the file", ".parquet", b"PAR1" + b"\0" * 100 + b"\xff\xff\xff\x7fPAR1")
    yield _written(home, "words", ".csv", "grasp_qpos_0,grasp_qpos_1\nx,y\n")
    yield _written(home, "ragged", ".csv", "grasp_qpos_0,grasp_qpos_1\n1,2\n3\n")
    yield _written(home, "narrow", ".csv", "grasp_qpos_0,grasp_qpos_1\n1,2\n")


def arrays(home: Path) -> Iterator[tuple[str, Path]]:
    good = {"grasp_qpos": np.zeros((4, 10)), "joint_names": np.array(["a", "b", "c"])}
    for name, change in {
        "other joints": {"joint_names": np.array(["a", "b", "x"])},
        "a joint twice": {"joint_names": np.array(["a", "b", "b"])},
        "names as numbers": {"joint_names": np.arange(3)},
        "too few names": {"joint_names": np.array(["a", "b"])},
        "flat": {"grasp_qpos": np.zeros(10)},
        "no grasps": {"grasp_qpos": np.zeros((0, 10))},
        "complex": {"grasp_qpos": np.zeros((4, 10), complex)},
        "text": {"grasp_qpos": np.full((4, 10), "x")},
        "another pre-grasp": {"pregrasp_qpos": np.zeros((4, 9))},
        "poses of six": {"obj_pose": np.zeros((4, 6))},
        "scales of three": {"obj_scale": np.ones((4, 3))},
        "objects": {"grasp_qpos": np.array([{}, {}, {}, {}])},
        "names that are numbers": {"object_name": np.arange(4)},
        "long names": {"joint_names": np.array(["a", "b", "x" * 10**6])},
    }.items():
        np.savez(home / f"{name}.npz", **(good | change))
        yield name, home / f"{name}.npz"
    np.savez(home / "nothing known.npz", what=np.zeros(3))
    yield "nothing known", home / "nothing known.npz"
    np.save(home / "wrist_mug.npy", np.zeros((4, 3)))
    yield "SpringGrasp", home / "wrist_mug.npy"
    header = b"{'descr': '<f8', 'fortran_order': False, 'shape': (99999999999999, 7), }"
    header = header + b" " * (117 - len(header)) + b"\n"
    yield _written(home, "gigantic", ".npy", b"\x93NUMPY\x01\x00" + len(header).to_bytes(2, "little") + header)
    structured = io.BytesIO()
    np.save(structured, np.zeros(2, [("a", object)]), allow_pickle=True)
    yield _written(home, "fields of objects", ".npy", structured.getvalue())
    with (
        zipfile.ZipFile(home / "bomb.npz", "w", zipfile.ZIP_DEFLATED) as archive,
        archive.open("grasp_qpos.npy", "w", force_zip64=True) as member,
    ):
        np.lib.format.write_array_header_1_0(member, {"descr": "<f8", "fortran_order": False, "shape": (5_000_000, 10)})
        for _ in range(400):
            member.write(bytes(1_000_000))
    yield "bomb", home / "bomb.npz"


def broken(home: Path) -> Iterator[tuple[str, Path]]:
    """Files of every format, cut short, with something of another format in them, or without what they need."""
    for name in _SINGLE:
        folder = home / name
        folder.mkdir()
        path = SAMPLES[name](folder, truth(), of_palm if name in OF_LINK else lambda base: base)
        content = path.read_bytes()
        # Of YAML nothing says where it should have ended.
        for share in () if name == "isaac_grasp" else (0.3, 0.8):
            yield _written(folder, f"cut {share}", "".join(path.suffixes), content[: int(share * len(content))])
        yield _written(folder, "behind something else", "".join(path.suffixes), b"MZ\0\0" + content)
        path.unlink()
    for name, change in {
        "dexgraspnet": lambda rows: rows[1]["qpos"].pop("a"),
        "bodex": lambda table: table.pop("joint_names"),
        "get_a_grip": lambda table: table.update(rot=np.zeros((4, 3))),
    }.items():
        path = SAMPLES[name](_made(home / f"{name} changed"), truth(), of_palm)
        value = np.load(path, allow_pickle=True)
        value = value.item() if value.ndim == 0 else value.tolist()
        change(value)
        yield f"{name} changed", save(path, value)
    yield "no such file", home / "nowhere.npy"
    yield "a folder without any", _made(home / "empty")
    os.mkfifo(home / "pipe.npy")
    yield "a pipe", home / "pipe.npy"
    (home / "loop.npy").symlink_to(home / "loop.npy")
    yield "a loop of links", home / "loop.npy"
    yield "a device", Path("/dev/zero")
    yield _written(home, "nothing", ".npy", b"")
    yield _written(home, "noise", ".npy", random.Random(0).randbytes(10_000))
    yield _written(home, "zeros", ".yaml", bytes(10_000))
    yield _written(home, "prose", ".yaml", "Here are no grasps.\n" * 100)


KINDS: dict[str, tuple[Callable[[Path], Iterator[tuple[str, Path]]], ...]] = {
    "pickle": (pickles,),
    "torch": (torch,),
    "yaml": (yaml,),
    "json": (text,),
    "xml": (xml,),
    "tables": (tables,),
    "arrays": (arrays,),
    "broken": (broken,),
}


def _made(folder: Path) -> Path:
    folder.mkdir()
    return folder


def _written(home: Path, name: str, ending: str, content: bytes | str) -> tuple[str, Path]:
    path = home / f"{name}{ending}"
    path.write_bytes(content.encode() if isinstance(content, str) else content)
    return name, path


def quietly(folder: Path) -> list[Case]:
    """Returns the same cases, without NumPy's warnings about how they are made."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        return cases(folder)
