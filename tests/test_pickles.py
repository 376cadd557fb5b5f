"""Pickles and torch files of strangers are data: nothing in them runs, and what they declare is checked first."""

from __future__ import annotations

import io
import os
import pickle
import pickletools
import struct
import zipfile
from collections import OrderedDict
from pathlib import Path

import numpy as np
import pytest
from torch_sample import torch_file

from jaxgrasp.files.pickles import unpickle
from jaxgrasp.files.torch_files import read_torch
from jaxgrasp.storage import FileError, limited_to

HERE = Path("file.npy")
TREE = {
    "array": np.arange(6.0).reshape(2, 3),
    "turned": np.asfortranarray(np.arange(6, dtype=">i2").reshape(2, 3)),
    "text": np.array(["ab", "cde"]),
    "truth": np.array([True, False]),
    "none": np.zeros((0, 3), np.float32),
    "list": [1, -5, 2**60, 2.5, True, None, "é☃", (np.float32(3), np.int64(4))],
    "objects": np.array([1, "x", None], object),
    "ordered": OrderedDict(a=1),
}


def alike(ours: object, theirs: object) -> bool:
    if isinstance(theirs, dict):
        return type(ours) is dict and list(ours) == list(theirs) and all(alike(ours[k], theirs[k]) for k in theirs)
    if isinstance(theirs, list | tuple):
        return type(ours) is type(theirs) and all(map(alike, ours, theirs)) and len(ours) == len(theirs)
    if isinstance(theirs, np.ndarray) and theirs.dtype == object:
        return alike(ours, theirs.tolist())
    if isinstance(theirs, np.ndarray):
        return ours.dtype == theirs.dtype and ours.shape == theirs.shape and np.array_equal(ours, theirs)
    return type(ours) is type(theirs) and ours == theirs


@pytest.mark.parametrize("protocol", range(6))
def test_data_come_back_as_python_has_them(protocol):
    content = pickle.dumps(TREE, protocol)
    assert alike(unpickle(HERE, content), TREE)
    if protocol < 4:
        # As NumPy before 2 named it.
        assert alike(unpickle(HERE, content.replace(b"numpy._core", b"numpy.core")), TREE)


class Call:
    def __init__(self, function, *arguments):
        self.what = function, arguments

    def __reduce__(self):
        return self.what


class WithState:
    def __reduce__(self):
        return np.dtype, ("f8", False, True), {"descr": "O8"}


CANARY = "canary"
CALLS = {
    "os.system": Call(os.system, f"touch {CANARY}"),
    "eval": Call(eval, f"open('{CANARY}', 'w')"),
    "open": Call(open, CANARY, "w"),
    "getattr": Call(getattr, "x", "upper"),
    "load": Call(np.load, "x.npy"),
    "in an array": np.array([Call(os.system, f"touch {CANARY}")], object),
    "in arrays in arrays": np.array([np.array([Call(exec, f"open('{CANARY}', 'w')")], object), 1], object),
    "in a dict": {"grasp_qpos": Call(exec, f"open('{CANARY}', 'w')")},
    "another array": np.array([1.0]).view(np.matrix),
    "masked array": np.ma.array([1.0]),
    "record": np.zeros(2, [("a", "f8")]),
    "date": np.array(["2020-01-01"], "M8[D]"),
    "complex": np.zeros(2, complex),
    "path": Path("/etc/passwd"),
    "set": {1, 2},
    "bound": Call("x".upper),
    "state": WithState(),
    "encoding": Call(__import__("codecs").encode, "eval", "rot13"),
    "long": 1 << 9000,
    "key": {(1, 2): 3},
}
_CORE = b"cnumpy.core.multiarray\n_reconstruct\n"
_START = _CORE + b"(cnumpy\nndarray\n(K\x00tC\x01btR"
_TYPE = b"cnumpy\ndtype\n(X\x02\x00\x00\x00f8\x89\x88tR"
RAW = {
    "another kind": _CORE + b"(cos\nsystem\n(K\x00tC\x01btR.",
    "kind as text": _CORE + b"(X\x05\x00\x00\x00eval!(K\x00tC\x01btR.",
    "gigantic": _START + b"(K\x01(I99999999999\nt" + _TYPE + b"\x89C\x08aaaaaaaatb.",
    "negative": _START + b"(K\x01(J\xff\xff\xff\xfft" + _TYPE + b"\x89C\x08aaaaaaaatb.",
    "truth as a length": _START + b"(K\x01(\x88t" + _TYPE + b"\x89C\x08aaaaaaaatb.",
    "objects of bytes": _START + b"(K\x01(K\x01tcnumpy\ndtype\n(X\x02\x00\x00\x00O8tR\x89C\x08aaaaaaaatb.",
    "no state": _START + b".",
    "state twice": _START + b"(K\x01(K\x00t" + _TYPE + b"\x89C\x00tbNb.",
    "state of a dict": b"}}b.",
    "call of a dict": b"})R.",
    "call of an array": b"cnumpy\nndarray\n)R.",
    "circle": b"]q\x00h\x00a.",
    "circle of dicts": b"}q\x00K\x01h\x00s.",
    "deep": b"]" * 1000 + b"a" * 999 + b".",
    "deep tuples": b"N" + b"\x85" * 100_000 + b".",
    "marks": b"(" * 100_000 + b".",
    "repeats": b"]q\x00" + b"".join(b"](" + b"h%c" % k * 40 + b"eq%c" % (k + 1) for k in range(6)) + b".",
    "opcodes": b"}0" * 3_000_000 + b"N.",
    "gigantic bytes": b"\x8e" + struct.pack("<Q", 2**62) + b"x.",
    "gigantic text": b"X\xff\xff\xff\xffx.",
    "gigantic whole number": b"\x8b\xff\xff\xff\x7f1.",
    "whole number of digits": b"I" + b"9" * 5000 + b"\n.",
    "memo": b"h\x07.",
    "empty stack": b"0.",
    "instance": b"(ios\nsystem\n.",
    "object": b"(cos\nsystem\no.",
    "new": b"\x80\x02cbuiltins\nobject\n)\x81.",
    "extension": b"\x82\x01.",
    "persistent": b"X\x01\x00\x00\x00aQ.",
    "later protocol": b"\x80\x09N.",
    "name as bytes": b"C\x02osC\x06system\x93.",
    "nothing": b"",
}


@pytest.mark.parametrize("name", [*CALLS, *RAW])
def test_hostile_pickles_are_refused_in_one_line_and_nothing_runs(name, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for protocol in range(2, 6) if name in CALLS else (0,):
        content = pickle.dumps(CALLS[name], protocol) if name in CALLS else RAW[name]
        with pytest.raises(FileError) as caught:
            unpickle(HERE, content)
        assert "\n" not in str(caught.value) and str(caught.value).startswith("file.npy: pickle: got ")
    assert not (tmp_path / CANARY).exists()


def test_what_a_pickle_calls_is_told():
    with pytest.raises(FileError, match=f"got the name {os.system.__module__}.system; wanted NumPy arrays"):
        unpickle(HERE, pickle.dumps(CALLS["os.system"]))


def test_every_opcode_is_known_or_refused():
    """What Python adds later is refused until somebody has looked at it."""
    refused = {"INST", "OBJ", "NEWOBJ", "NEWOBJ_EX", "EXT1", "EXT2", "EXT4", "PERSID", "NEXT_BUFFER", "READONLY_BUFFER"}
    refused |= {"EMPTY_SET", "ADDITEMS", "FROZENSET", "DUP", "STRING", "LONG4"}
    for opcode in pickletools.opcodes:
        try:
            unpickle(HERE, opcode.code.encode("latin-1"))
        except FileError as error:
            assert ("the opcode" in str(error)) == (opcode.name in refused), opcode.name


def test_arrays_that_the_memo_repeats_count_every_time():
    # The array, as number 200 of the memo, and a list in which it comes 200 times.
    many = pickle.dumps(np.zeros(20_000), 2)[:-1] + b"q\xc8](" + b"h\xc8" * 200 + b"e."
    assert len(unpickle(HERE, many)) == 200
    with limited_to(4 << 20), pytest.raises(FileError, match="repeat beyond the budget"):
        unpickle(HERE, many)


def test_damage_anywhere_is_one_line_or_data():
    content = pickle.dumps(TREE, 2)
    rng = np.random.default_rng(0)
    for _ in range(2000):
        broken = bytearray(content)
        for place in rng.integers(len(content), size=rng.integers(1, 4)):
            broken[place] = rng.integers(256)
        try:
            unpickle(HERE, bytes(broken[: rng.integers(1, len(content) + 1)]))
        except FileError as error:
            assert "\n" not in str(error)


def test_files_of_torch(tmp_path):
    values = {"a": np.arange(12.0, dtype=np.float32).reshape(3, 4), "b": {"c": np.array([True, False]), "n": 3}}
    values["d"] = np.arange(4)
    torch_file(tmp_path / "x.pt", values)
    found = read_torch(tmp_path / "x.pt")
    assert alike(found, values)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"numel": 10**12}, "a storage of 1000000000000 numbers"),
        ({"shape": (10**9, 4)}, "a tensor of shape"),
        ({"shape": (3, 4), "stride": (0, 10**6)}, "a tensor of shape"),
        ({"offset": 5}, "a tensor of shape"),
        ({"offset": -1}, "a tensor that is none"),
        ({"key": "../../x"}, "a storage of 12 numbers"),
        ({"rebuild": ("torch.storage", "_load_from_bytes")}, "the name torch.storage._load_from_bytes"),
        ({"compression": zipfile.ZIP_DEFLATED}, "members that are compressed"),
        ({"pickle": pickle.dumps(Call(os.system, f"touch {CANARY}"), 2)}, "system"),
        ({"pickle_name": "data.txt"}, "an archive without data.pkl"),
    ],
)
def test_hostile_files_of_torch(tmp_path, monkeypatch, change, message):
    monkeypatch.chdir(tmp_path)
    torch_file(tmp_path / "x.pt", {"a": np.arange(12.0).reshape(3, 4)}, **change)
    with pytest.raises(FileError, match="x.pt: .*" + message):
        read_torch(tmp_path / "x.pt")
    assert not (tmp_path / CANARY).exists()


def test_truncated_files_of_torch(tmp_path):
    torch_file(tmp_path / "x.pt", {"a": np.arange(12.0)})
    content = (tmp_path / "x.pt").read_bytes()
    for end in range(0, len(content), 97):
        (tmp_path / "y.pt").write_bytes(content[:end])
        with pytest.raises(FileError, match="y.pt"):
            read_torch(tmp_path / "y.pt")


def test_pickled_twice_is_still_data():
    stream = io.BytesIO()
    np.save(stream, np.array({"a": pickle.dumps(1)}, object), allow_pickle=True)
    content = stream.getvalue()
    assert unpickle(HERE, content, content.index(b"\x80")) == {"a": pickle.dumps(1)}
