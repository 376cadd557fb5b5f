"""Files are written whole or not at all, and read only where they are regular ones and within the budget."""

import io
import os
import pickle
import struct
import subprocess
import sys
import time
import zipfile
from pathlib import Path

import numpy as np
import pytest

from jaxgrasp.storage import (
    FileError,
    atomic_write,
    cache_folder,
    check_writable,
    limited_to,
    open_archive,
    open_regular,
    printable,
    read_archive,
    read_array,
    unfinished,
)


def write(path, content: bytes) -> None:
    with atomic_write(path) as stream:
        stream.write(content)


def test_a_file_is_replaced_at_the_end_alone(tmp_path):
    path = tmp_path / "file"
    path.write_bytes(b"old")
    with atomic_write(path) as stream:
        stream.write(b"new")
        stream.flush()
        assert path.read_bytes() == b"old" and unfinished()
    assert path.read_bytes() == b"new" and not unfinished()
    assert os.listdir(tmp_path) == ["file"]


def test_an_error_leaves_the_old_file_and_nothing_else(tmp_path):
    path = tmp_path / "file"
    path.write_bytes(b"old")
    with pytest.raises(OSError, match="disk"), atomic_write(path) as stream:
        stream.write(b"new")
        raise OSError(28, "the disk is full")
    assert path.read_bytes() == b"old" and os.listdir(tmp_path) == ["file"] and not unfinished()


def test_a_full_disk_leaves_the_old_file(tmp_path):
    resource = pytest.importorskip("resource")
    path = tmp_path / "file"
    path.write_bytes(b"old")
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (10_000, before[1]))
    try:
        with pytest.raises(OSError):
            write(path, bytes(20_000))
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
    assert path.read_bytes() == b"old" and os.listdir(tmp_path) == ["file"]


def test_links_stay_and_what_they_point_to_is_replaced(tmp_path):
    (tmp_path / "folder").mkdir()
    link, dangling = tmp_path / "link", tmp_path / "dangling"
    (tmp_path / "folder" / "there").write_bytes(b"old")
    link.symlink_to(Path("folder", "there"))
    dangling.symlink_to(Path("folder", "new"))
    for name in (link, dangling):
        check_writable(name)
        write(name, b"new")
        assert name.is_symlink() and name.read_bytes() == b"new"
    assert sorted(os.listdir(tmp_path / "folder")) == ["new", "there"]


def test_permissions_are_kept_and_new_files_have_usual_ones(tmp_path):
    old, new = tmp_path / "old", tmp_path / "new"
    old.write_bytes(b"")
    old.chmod(0o640)
    mask = os.umask(0o027)
    try:
        write(old, b"x")
        write(new, b"x")
    finally:
        os.umask(mask)
    assert old.stat().st_mode & 0o777 == 0o640 and new.stat().st_mode & 0o777 == 0o640


@pytest.mark.parametrize("kind", ["folder", "pipe", "loop", "absent folder"])
def test_what_cannot_be_written(tmp_path, kind):
    path = tmp_path / "file"
    if kind == "folder":
        path.mkdir()
    elif kind == "pipe":
        os.mkfifo(path)
    elif kind == "loop":
        path.symlink_to(path)
    else:
        path = tmp_path / "none" / "file"
    before = os.listdir(tmp_path)
    for attempt in (check_writable, lambda p: write(p, b"x")):
        with pytest.raises(OSError):
            attempt(path)
    assert os.listdir(tmp_path) == before


WRITING = """
import sys, time
from jaxgrasp.storage import atomic_write
with atomic_write(sys.argv[1]) as stream:
    stream.write(b"x")
    stream.flush()
    time.sleep(60)
"""


def test_litter_of_the_dead_is_swept_and_that_of_the_living_is_not(tmp_path):
    def parts() -> int:
        return sum(name.endswith(".part") for name in os.listdir(tmp_path))

    def begun(number: int) -> subprocess.Popen:
        child = subprocess.Popen([sys.executable, "-c", WRITING, str(tmp_path / "file")])
        while parts() < number:
            time.sleep(0.01)
        return child

    def kill(child: subprocess.Popen) -> None:
        child.kill()
        child.wait()

    living = begun(1)
    kill(begun(2))
    assert parts() == 2
    write(tmp_path / "file", b"mine")
    assert parts() == 1
    kill(living)
    write(tmp_path / "file", b"mine")
    assert os.listdir(tmp_path) == ["file"]


def test_only_regular_files_are_read(tmp_path):
    os.mkfifo(tmp_path / "pipe")
    (tmp_path / "loop").symlink_to(tmp_path / "loop")
    for path, word in (
        (tmp_path, "directory"),
        (tmp_path / "pipe", "pipe"),
        (tmp_path / "loop", "symbolic"),
        (Path("/dev/zero"), "device"),
        (tmp_path / "none", "no such file"),
        (tmp_path / "nul\0", "null"),
    ):
        with pytest.raises(FileError, match=word) as caught, open_regular(path):
            pass
        assert "\n" not in str(caught.value)


def test_a_file_above_the_budget_is_not_read(tmp_path):
    with open(tmp_path / "sparse.npy", "wb") as stream:
        np.lib.format.write_array_header_1_0(stream, {"descr": "<f8", "fortran_order": False, "shape": (1 << 30,)})
        stream.truncate(128 + (8 << 30))
    with pytest.raises(FileError, match="8 GiB; wanted at most 2 GiB"):
        read_array(tmp_path / "sparse.npy")
    np.save(tmp_path / "small.npy", np.zeros(1000))
    with limited_to(7000), pytest.raises(FileError, match="at most 6.84 KiB"):
        read_array(tmp_path / "small.npy")
    assert read_array(tmp_path / "small.npy").shape == (1000,)


def test_members_that_nobody_asks_for_are_not_inflated(tmp_path):
    path = tmp_path / "a.npz"
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED, compresslevel=1) as archive:
        for name, count in (("large", 1 << 26), ("small", 3)):
            with archive.open(f"{name}.npy", "w", force_zip64=True) as stream:
                np.lib.format.write_array(stream, np.zeros(count))
    with open_archive(path) as archive:
        assert archive.headers["large"].shape == (1 << 26,)
        assert archive.read(["small"])["small"].tolist() == [0, 0, 0]
        with pytest.raises(FileError, match="inflate to 512 MiB"):
            archive.read(["large"])
    with limited_to(4 << 20), pytest.raises(FileError, match="large: got arrays that take 512 MiB"):
        read_archive(path)


def npy(header: str, data: bytes = b"") -> bytes:
    return b"\x93NUMPY\x01\x00" + struct.pack("<H", len(header)) + header.encode() + data


@pytest.mark.parametrize(
    "shape",
    [
        "(10**12,)",
        "(1000000000000,)",
        "(True,)",
        "(-1,)",
        "(1.0,)",
        "9",
        "(" + "9" * 4000 + ",)",
        "(" + "1," * 50 + ")",
    ],
)
def test_what_a_header_declares_is_looked_at_first(tmp_path, shape):
    content = npy(f"{{'descr': '<f8', 'fortran_order': False, 'shape': {shape}, }}", bytes(64))
    (tmp_path / "a.npy").write_bytes(content)
    with zipfile.ZipFile(tmp_path / "a.npz", "w") as archive:
        archive.writestr("a.npy", content)
    for read, name in ((read_array, "a.npy"), (read_archive, "a.npz")):
        with pytest.raises(FileError) as caught:
            read(tmp_path / name)
        assert "\n" not in str(caught.value)


@pytest.mark.parametrize("compress", [False, True])
def test_arrays_are_what_numpy_reads(tmp_path, compress):
    draw = np.random.default_rng(0)
    given = {
        "numbers": draw.normal(size=(70_000, 4, 3)),
        "fortran": np.asfortranarray(draw.normal(size=(5, 7))),
        "booleans": draw.random(9) < 0.5,
        "text": np.array(["a", "größe 猫", ""]),
        "bytes": np.array([b"ab", b"c"]),
        "none": np.zeros((0, 3)),
        "scalar": np.array(2.5),
        "empty": np.zeros(3, "U0"),
        "big": np.arange(3, dtype=">i4"),
    }
    path = tmp_path / "a.npz"
    (np.savez_compressed if compress else np.savez)(path, **given)
    with np.load(path) as theirs:
        ours = read_archive(path)
        assert list(ours) == theirs.files
        for name in given:
            np.testing.assert_array_equal(ours[name], theirs[name])
            assert ours[name].dtype == theirs[name].dtype
    for value in given.values():
        np.save(tmp_path / "a.npy", value)
        np.testing.assert_array_equal(read_array(tmp_path / "a.npy"), value)


def test_text_and_truth_values_are_made_sound(tmp_path):
    path = tmp_path / "a.npy"
    np.save(path, np.frombuffer(bytes([0, 1, 2, 255]), bool))
    assert read_array(path).view(np.uint8).tolist() == [0, 1, 1, 1]
    np.save(path, np.array(["\ud800"]))
    with pytest.raises(FileError, match="no Unicode"):
        read_array(path)
    assert printable("a\nb\x1b\ud800é") == "a\\nb\\x1b\\ud800é"


def test_two_arrays_of_one_name(tmp_path):
    stream = io.BytesIO()
    np.save(stream, np.zeros(2))
    with zipfile.ZipFile(tmp_path / "a.npz", "w") as archive:
        for name in ("x.npy", "x"):
            archive.writestr(name, stream.getvalue())
    with pytest.raises(FileError, match="x: got two arrays of this name"):
        read_archive(tmp_path / "a.npz")


def test_the_cache_is_where_nobody_else_writes(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    folder = cache_folder("kernels")
    assert folder == tmp_path / "jaxgrasp" / "kernels"
    folder.chmod(0o777)
    with pytest.raises(OSError, match="written by others"):
        cache_folder("kernels")
    monkeypatch.setenv("XDG_CACHE_HOME", "relative")
    monkeypatch.delenv("HOME")
    monkeypatch.setattr("pwd.getpwuid", {}.__getitem__)
    with pytest.raises(OSError, match="no home"):
        cache_folder("kernels")
    assert not Path("relative").exists()


def test_an_error_goes_from_one_process_to_another():
    error = FileError("a.npz", "positions", "text", "numbers")
    assert str(pickle.loads(pickle.dumps(error))) == str(error)
