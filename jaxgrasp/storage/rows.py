"""Arrays of an archive read some rows at a time: the file may be larger than memory."""

from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path

import numpy as np

from jaxgrasp.storage.arrays import BROKEN, Archive, array_of_bytes, damaged
from jaxgrasp.storage.reading import FileError, allowance, in_bytes

_PIECE = 1 << 20


class ArchiveRows:
    """The arrays with a leading axis of N, read from row 0 on; other arrays come whole with all rows."""

    def __init__(self, path: Path | str, archive: Archive, names: Iterable[str], count: int):
        """Opens the arrays.

        Args:
            path: The file, for messages.
            archive: What they are in; it stays open.
            names: Of its headers.
            count: N.

        Raises:
            FileError: One of them cannot be read.
        """
        self._path, self._headers = path, archive.headers
        names = tuple(names)
        # What is stored column by column has no row in one place.
        apart = [n for n in names if self._headers[n].shape[:1] == (count,) and not self._headers[n].fortran_order]
        self._whole = archive.read(name for name in names if name not in apart)
        self._streams = archive.open_data(apart)
        self._count, self._at = count, 0

    def skip(self, rows: int) -> None:
        """Passes some rows over.

        Raises:
            FileError: The file is damaged.
        """
        for name, stream in self._streams.items():
            left = rows * self._row(name)
            try:
                # zipfile's own `seek` reads all of it, too, in larger pieces.
                while left > 0:
                    part = len(stream.read(min(left, _PIECE)))
                    if not part:
                        raise EOFError("it ends early")
                    left -= part
            except BROKEN as error:
                damaged(self._path, name, error)
        self._at += rows

    def read(self, rows: int) -> dict[str, np.ndarray]:
        """Reads the next rows.

        Raises:
            FileError: The file is damaged, or so many rows take more memory than one file may.
        """
        size = sum(rows * self._row(name) for name in self._streams)
        if size > allowance():
            limit = f"at most {in_bytes(allowance())} (see --read-limit)"
            raise FileError(self._path, None, f"{rows:,} rows that take {in_bytes(size)}", limit)
        found = {name: self._read(name, rows) for name in self._streams}
        for name, array in self._whole.items():
            found[name] = array[self._at : self._at + rows] if array.shape[:1] == (self._count,) else array
        self._at += rows
        return {name: found[name] for name in self._headers if name in found}

    def _row(self, name: str) -> int:
        return self._headers[name].size // max(self._count, 1)

    def _read(self, name: str, rows: int) -> np.ndarray:
        header, stream = self._headers[name], self._streams[name]
        data, done = bytearray(rows * self._row(name)), 0
        view = memoryview(data)
        try:
            # `readinto` of zip files copies what `read` gives.
            while done < len(data):
                part = stream.read(min(len(data) - done, _PIECE))
                if not part:
                    raise EOFError("it ends early")
                view[done : done + len(part)] = part
                done += len(part)
            if self._at + rows == self._count:
                # At the end zipfile compares the checksum.
                stream.read(1)
        except BROKEN as error:
            damaged(self._path, name, error)
        part = replace(header, shape=(rows, *header.shape[1:]))
        return array_of_bytes(self._path, name, part, np.frombuffer(data, np.uint8))
