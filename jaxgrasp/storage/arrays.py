"""NumPy's files: what they declare is checked against the budget before anything is inflated or allocated.

A header says how large its array is in a few bytes, and a few kilobytes of archive inflate to gigabytes. Headers are
therefore read first, members that nobody asks for are never inflated, and objects are never unpickled.
"""

import contextlib
import io
import math
import struct
import zipfile
import zlib
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO, NoReturn

import numpy as np

from jaxgrasp.storage.reading import FileError, allowance, check_inflation, in_bytes, open_regular, reason_of

# What zipfile and zlib raise for damaged, encrypted or oddly compressed members.
BROKEN = (ValueError, KeyError, IndexError, EOFError, OSError, RuntimeError, MemoryError, OverflowError)
BROKEN += (zipfile.BadZipFile, zlib.error, struct.error)
_MAGIC = b"\x93NUMPY"
# NumPy takes a millisecond for a thousand characters. Headers of plain arrays have at most some 800.
_HEADER = 1024
_DIMENSIONS = 32
_CHUNK = 1 << 18
_MEMBERS, _DIRECTORY = 2_000, 4 << 20
PICKLE_COST = 16
"""Bytes of memory that a byte of a pickle, or of an archive with one, may come to take in other types and objects."""


@dataclass(frozen=True)
class Header:
    """What an array's file says before its data."""

    shape: tuple[int, ...]
    """Of the array."""
    dtype: np.dtype
    """Of its entries."""
    fortran_order: bool
    """Whether the first axis is the one whose entries lie beside each other."""
    offset: int
    """Where the data begin, bytes."""

    @property
    def size(self) -> int:
        """Bytes of the data."""
        return math.prod(self.shape) * self.dtype.itemsize

    @property
    def cost(self) -> int:
        """Bytes that the array takes in memory as eight-byte numbers, or as text where it is bytes."""
        wide = 4 if self.dtype.kind == "S" else 1
        return math.prod(self.shape) * max(8, wide * self.dtype.itemsize)


class Archive:
    """An open `.npz` file, see `open_archive`."""

    def __init__(self, path: Path | str, archive: zipfile.ZipFile):
        """Reads the headers of all members, and none of their data."""
        self._path, self._archive = path, archive
        self.headers: dict[str, Header] = {}
        """What each array declares, by name, in the file's order."""
        self._members: dict[str, zipfile.ZipInfo] = {}
        members = archive.infolist()
        if len(members) > _MEMBERS:
            raise FileError(path, None, f"{len(members):,} members", f"at most {_MEMBERS:,}")
        for member in members:
            name = member.filename.removesuffix(".npy")
            if name in self.headers:
                raise FileError(path, name, "two arrays of this name", "one")
            self.headers[name], self._members[name] = self._header(name, member), member

    def read(self, names: Iterable[str]) -> dict[str, np.ndarray]:
        """Reads some of the arrays.

        Args:
            names: Of `headers`.

        Raises:
            FileError: One of them is damaged, or has Python objects, or they are too large together.
        """
        names = tuple(names)
        for name in names:
            _refuse_objects(self._path, name, self.headers[name].dtype)
        self._check_cost(names)
        return {name: self._read(name) for name in names}

    def open_data(self, names: Iterable[str]) -> dict[str, BinaryIO]:
        """Opens some of the arrays where their data begin, for files that are larger than memory.

        Args:
            names: Of `headers`.

        Raises:
            FileError: One of them is damaged, or has Python objects, or they would inflate a hundredfold.
        """
        names = tuple(names)
        self._check_inflation(names)
        opened = {}
        for name in names:
            _refuse_objects(self._path, name, self.headers[name].dtype)
            try:
                opened[name] = self._open(name, self._members[name])
                opened[name].read(self.headers[name].offset)
            except BROKEN as error:
                damaged(self._path, name, error)
        return opened

    def _check_cost(self, names: tuple[str, ...]) -> None:
        headers = [self.headers[name] for name in names]
        largest = max(names, key=lambda name: self.headers[name].cost, default=None)
        _check_cost(self._path, largest, sum(header.cost for header in headers))
        self._check_inflation(names)

    def _check_inflation(self, names: tuple[str, ...]) -> None:
        members = [self._members[name] for name in names]
        largest = max(names, key=lambda name: self.headers[name].cost, default=None)
        inflated, stored = (sum(getattr(m, which) for m in members) for which in ("file_size", "compress_size"))
        check_inflation(self._path, largest, stored, inflated, " (numpy.savez does so)")

    def _header(self, name: str, member: zipfile.ZipInfo) -> Header:
        try:
            with self._open(name, member) as stream:
                start = stream.read(_HEADER + 12)
        except BROKEN as error:
            damaged(self._path, name, error)
        if not start.startswith(_MAGIC):
            raise FileError(self._path, name, "a member that is no array", "arrays only")
        header = _parsed(self._path, name, start)
        if member.file_size != header.offset + header.size and not header.dtype.hasobject:
            declared = f"{in_bytes(member.file_size)} where the header declares {in_bytes(header.offset + header.size)}"
            raise FileError(self._path, name, f"damaged data ({declared})", "an intact .npz file")
        return header

    def _read(self, name: str) -> np.ndarray:
        header, data = self.headers[name], np.empty(self.headers[name].size, np.uint8)
        try:
            with self._open(name, self._members[name]) as stream:
                stream.read(header.offset)
                for start in range(0, len(data), _CHUNK):
                    part = stream.read(min(_CHUNK, len(data) - start))
                    data[start : start + len(part)] = np.frombuffer(part, np.uint8)
                    if len(part) < min(_CHUNK, len(data) - start):
                        raise EOFError("it ends early")
                # At the end zipfile compares the checksum.
                stream.read(1)
        except BROKEN as error:
            damaged(self._path, name, error)
        return array_of_bytes(self._path, name, header, data)

    def _open(self, name: str, member: zipfile.ZipInfo) -> Any:
        if member.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED):
            raise FileError(self._path, name, "another compression", "that of numpy.savez or savez_compressed")
        return self._archive.open(member)


@contextlib.contextmanager
def open_archive(path: Path | str, wanted: str = "an .npz file (numpy.savez)") -> Iterator[Archive]:
    """Opens an `.npz` file, of which only headers are read until arrays are asked for.

    Args:
        path: The file.
        wanted: What the file should be, for the message.

    Yields:
        The archive, with `headers` by name and `read`.

    Raises:
        FileError: The file is absent, unreadable, not an archive, truncated or damaged.
    """
    path = Path(path)
    with open_regular(path, wanted) as stream, archive_in(stream, path, wanted) as archive:
        yield archive


@contextlib.contextmanager
def archive_in(stream: BinaryIO, path: Path | str, wanted: str = "an .npz file (numpy.savez)") -> Iterator[Archive]:
    """Opens the `.npz` file that a stream of bytes is, see `open_archive`.

    Args:
        stream: The file's bytes; it can be sought in.
        path: The file, for messages.
        wanted: What the file should be, for the message.

    Raises:
        FileError: It is not an archive, truncated or damaged.
    """
    try:
        magic = stream.read(len(_MAGIC))
        # zipfile would also find an archive behind something else, which NumPy takes for no archive.
        if not magic.startswith(b"PK") or not zipfile.is_zipfile(stream):
            _refuse_kind(path, magic, wanted)
        archive = zipfile.ZipFile(_Bounded(stream))  # type: ignore[arg-type]
    except FileError:
        raise
    except BROKEN as error:
        damaged(path, None, error)
    with archive:
        yield Archive(path, archive)


def read_archive(path: Path | str) -> dict[str, np.ndarray]:
    """Reads every array of an `.npz` file; objects are never unpickled.

    Args:
        path: The file.

    Returns:
        The arrays by name, in the file's order.

    Raises:
        FileError: The file is absent, unreadable, not an archive, truncated, damaged, too large, or has an array of
            objects.
    """
    with open_archive(path) as archive:
        return archive.read(archive.headers)


def read_array(path: Path | str) -> np.ndarray:
    """Reads the one array of an `.npy` file; objects are never unpickled.

    Args:
        path: The file.

    Returns:
        The array.

    Raises:
        FileError: The file is absent, unreadable, of another kind, truncated, too large, or has an array of objects.
    """
    path, wanted = Path(path), "an intact .npy file of plain numbers"
    with open_regular(path, wanted) as stream:
        start = stream.read(_HEADER + 12)
        if not start.startswith(_MAGIC):
            raise FileError(path, None, "a file of another kind" if start else "an empty file", wanted)
        header = _parsed(path, None, start)
        _refuse_objects(path, None, header.dtype)
        _check_cost(path, None, header.cost)
        there = stream.seek(0, io.SEEK_END) - header.offset
        if there < header.size:
            raise FileError(path, None, f"{in_bytes(there)} of {in_bytes(header.size)} of data", wanted)
        stream.seek(header.offset)
        data = np.fromfile(stream, np.uint8, header.size)
    return array_of_bytes(path, None, header, data)


def read_objects(path: Path | str) -> tuple[Header, bytes]:
    """Reads an `.npy` file of Python objects as the bytes that it has; nothing of them is looked at.

    Args:
        path: The file.

    Returns:
        The header and all bytes of the file, the pickle from `header.offset` on.

    Raises:
        FileError: The file is absent, unreadable, of another kind or too large.
    """
    path, wanted = Path(path), "an .npy file of numpy.save"
    with open_regular(path, wanted, cost=PICKLE_COST) as stream:
        content = stream.read()
    if not content.startswith(_MAGIC):
        raise FileError(path, None, "a file of another kind" if content else "an empty file", wanted)
    return _parsed(path, None, content[: _HEADER + 12]), content


def read_members(path: Path | str, wanted: str) -> dict[str, bytes]:
    """Reads every member of a zip archive that is not compressed, as those of PyTorch are.

    Args:
        path: The file.
        wanted: What the file should be, for the message.

    Returns:
        The members' bytes by name, together no more than the file has.

    Raises:
        FileError: The file is absent, unreadable, no archive, damaged, compressed or too large.
    """
    path = Path(path)
    with open_regular(path, wanted, cost=PICKLE_COST) as stream:
        try:
            size = stream.seek(0, io.SEEK_END)
            with zipfile.ZipFile(_Bounded(stream)) as archive:  # type: ignore[arg-type]
                members = archive.infolist()
                plain = all(m.compress_type == zipfile.ZIP_STORED and m.file_size == m.compress_size for m in members)
                if not plain or sum(m.file_size for m in members) > size or len(members) > _MEMBERS:
                    raise FileError(path, None, "members that are compressed, overlap or are too many", wanted)
                return {member.filename: archive.read(member) for member in members}
        except BROKEN as error:
            damaged(path, None, error, wanted)


class _Bounded:
    """A file whose reader cannot ask for much at once: zipfile reads the whole directory of an archive in one go."""

    def __init__(self, stream: BinaryIO):
        self._stream = stream
        self.seek, self.tell, self.seekable = stream.seek, stream.tell, stream.seekable

    def read(self, size: int = -1) -> bytes:
        if size > _DIRECTORY:
            raise zipfile.BadZipFile(f"a directory of {in_bytes(size)}")
        # To the end, of which Arrow's streams know no number.
        return self._stream.read() if size < 0 else self._stream.read(size)


def _refuse_kind(path: Path | str, magic: bytes, wanted: str) -> NoReturn:
    if magic.startswith(b"PK\x03\x04"):
        raise FileError(path, None, "a truncated .npz file", "the whole of it")
    kind = {b"": "an empty file", _MAGIC: "a single .npy array"}.get(magic, "a file of another kind")
    raise FileError(path, None, kind, wanted)


def _parsed(path: Path | str, name: str | None, start: bytes) -> Header:
    """The header at the start of an array's file."""
    stream = io.BytesIO(start)
    length = int.from_bytes(start[8 : 10 if start[6:7] == b"\1" else 12], "little")
    if length > _HEADER:
        raise FileError(path, name, f"a header of {length:,} characters", f"at most {_HEADER:,}")
    try:
        version = np.lib.format.read_magic(stream)
        if version not in ((1, 0), (2, 0), (3, 0)):
            raise ValueError(f"version {version}")
        # The third version differs from the second in the names of fields alone, which plain arrays do not have.
        read = np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
        shape, fortran_order, dtype = read(stream)
    except Exception as error:
        # NumPy reads the header as a Python literal, and answers with any exception that this can end in.
        raise FileError(path, name, f"a damaged header ({type(error).__name__})", "an array of numpy.save") from error
    # Truth values are integers to Python, and to NumPy.
    whole = all(type(length) is int and 0 <= length < 2**62 for length in shape)
    if not whole or len(shape) > _DIMENSIONS or dtype.subdtype is not None:
        raise FileError(path, name, "a header that declares no array", "an array of numpy.save")
    return Header(shape, dtype, fortran_order, stream.tell())


def _refuse_objects(path: Path | str, name: str | None, dtype: np.dtype) -> None:
    if dtype.hasobject:
        raise FileError(path, name, "Python objects, which are never unpickled", "a plain array")


def _check_cost(path: Path | str, name: str | None, cost: int) -> None:
    if cost > allowance():
        limit = f"at most {in_bytes(allowance())} (see --read-limit)"
        raise FileError(path, name, f"arrays that take {in_bytes(cost)} in memory", limit)


def array_of_bytes(path: Path | str, name: str | None, header: Header, data: np.ndarray) -> np.ndarray:
    """The array that bytes are the data of.

    Args:
        path: The file, for messages.
        name: The array in it.
        header: What the array is.
        data: As many bytes as it has.

    Raises:
        FileError: Text is no Unicode.
    """
    array = np.ndarray(header.shape[::-1] if header.fortran_order else header.shape, header.dtype, data)
    if array.dtype.kind == "b":
        # Truth values may be written as any byte; arithmetic knows 0 and 1.
        array = np.asarray(data.reshape(array.shape) != 0)
    if array.dtype.kind == "U" and array.size and array.dtype.itemsize:
        codes = data.view(array.dtype.byteorder.replace("|", "=") + "u4")
        if codes.max() > 0xD7FF and (((codes > 0xD7FF) & (codes < 0xE000)) | (codes > 0x10FFFF)).any():
            raise FileError(path, name, "text that is no Unicode (surrogates)", "characters")
    return array.T if header.fortran_order else array


def damaged(path: Path | str, name: str | None, error: Exception, wanted: str = "an intact .npz file") -> NoReturn:
    """Refuses a file for what was raised while it was read.

    Raises:
        FileError: Always.
    """
    if isinstance(error, FileError):
        raise error
    raise FileError(path, name, f"damaged data ({reason_of(error)})", wanted) from error
