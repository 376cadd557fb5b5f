"""The disk: the one writer and the one reader of the package, and the folder of what is kept between runs."""

from jaxgrasp.storage.arrays import Archive, Header, open_archive, read_archive, read_array
from jaxgrasp.storage.cache import cache_folder
from jaxgrasp.storage.reading import FileError, allowance, limited_to, open_regular, printable, reason_of
from jaxgrasp.storage.writing import atomic_write, check_writable, discard_unfinished, unfinished

__all__ = [
    "Archive",
    "FileError",
    "Header",
    "allowance",
    "atomic_write",
    "cache_folder",
    "check_writable",
    "discard_unfinished",
    "limited_to",
    "open_archive",
    "open_regular",
    "printable",
    "read_archive",
    "read_array",
    "reason_of",
    "unfinished",
]
