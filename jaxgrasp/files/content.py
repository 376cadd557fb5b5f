"""What a file is, by its first bytes, and what is in it, as plain data."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from jaxgrasp.files.pickles import unpickle
from jaxgrasp.files.tables_apart import read_apart
from jaxgrasp.files.text_trees import read_json, read_xml, read_yaml
from jaxgrasp.files.torch_files import read_torch
from jaxgrasp.storage import PICKLE_COST, FileError, open_regular, read_archive, read_array, read_objects

_HEAD = 4096
WANTED = "a file of grasps in a format that is known"
# The number that files of torch.save begin with that are no archive.
_OLD_TORCH = b"\x8a\nl\xfc\x9cF\xf9 j\xa8P\x19"


@dataclass(frozen=True)
class Content:
    """A file that has been read, and not yet understood."""

    path: Path
    """The file."""
    kind: str
    """"arrays" (several by name), "array", "objects" (a pickle), "torch", "json", "yaml", "xml", "hdf5", "table"."""
    data: object
    """Of a pickle, a torch file, JSON and YAML a tree; of XML pairs of tags and text; else arrays by name, or one."""

    @property
    def table(self) -> dict:
        """The data where they are a dict; an empty one else."""
        return self.data if isinstance(self.data, dict) else {}


def read_content(path: Path) -> Content:
    """Reads a file as plain data.

    Raises:
        FileError: It is absent, damaged, too large or of a kind that no format has.
    """
    with open_regular(path, WANTED) as stream:
        head = stream.read(_HEAD)
        size = stream.seek(0, 2)
        stream.seek(max(0, size - 2 * _HEAD))
        tail = stream.read(2 * _HEAD)
    if head.startswith(b"\x93NUMPY"):
        return _npy(path)
    if head.startswith(b"PK"):
        if b"/data.pkl" in head or b"/data.pkl" in tail:
            return Content(path, "torch", read_torch(path))
        return Content(path, "arrays", read_archive(path))
    if head.startswith(b"\x89HDF\r\n\x1a\n"):
        return Content(path, "hdf5", read_apart(path, "hdf5"))
    if head.startswith(b"PAR1"):
        return Content(path, "table", read_apart(path, "parquet"))
    if head.startswith(b"\x80"):
        return _pickle(path, head)
    return _text(path, head)


def _npy(path: Path) -> Content:
    header, content = read_objects(path)
    if not header.dtype.hasobject:
        return Content(path, "array", read_array(path))
    if header.dtype != np.dtype(object):
        raise FileError(path, None, f"an array of {header.dtype}", WANTED)
    return Content(path, "objects", unpickle(path, content, header.offset))


def _pickle(path: Path, head: bytes) -> Content:
    if _OLD_TORCH in head[:32]:
        raise FileError(path, None, "a torch file of before PyTorch 1.6", "one that torch.save of today has written")
    with open_regular(path, WANTED, cost=PICKLE_COST) as stream:
        return Content(path, "objects", unpickle(path, stream.read()))


def _text(path: Path, head: bytes) -> Content:
    if not head.strip():
        raise FileError(path, None, "an empty file", WANTED)
    start = head.removeprefix(b"\xef\xbb\xbf").lstrip()
    if start.startswith((b"{", b"[")):
        return Content(path, "json", read_json(path))
    if start.startswith(b"<"):
        return Content(path, "xml", read_xml(path))
    if b"\0" in head:
        raise FileError(path, None, "a file of another kind", WANTED)
    first = start.split(b"\n", 1)[0]
    if b"," in first and b":" not in first.split(b",", 1)[0]:
        return Content(path, "table", read_apart(path, "csv"))
    if b":" in start:
        return Content(path, "yaml", read_yaml(path))
    raise FileError(path, None, "text of another kind", WANTED)
