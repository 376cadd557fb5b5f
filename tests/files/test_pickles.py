"""Pickles and torch files of strangers are data: nothing in them runs, and what they declare is checked first."""

from __future__ import annotations

import io
import os
import pickle
import pickletools
import sys
import zipfile
from collections import OrderedDict
from pathlib import Path

import numpy as np
import pytest

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))

from benchmarks.assaults.hostile_pickles import CALLS, CANARY, RAW, Call  # noqa: E402
from benchmarks.assaults.torch_sample import torch_file  # noqa: E402
from jaxgrasp.files.pickles import unpickle  # noqa: E402
from jaxgrasp.files.torch_files import read_torch  # noqa: E402
from jaxgrasp.storage import FileError, limited_to  # noqa: E402

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
