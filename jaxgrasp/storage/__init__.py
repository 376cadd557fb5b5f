"""The disk: the one writer and the one reader of the package, and the folder of what is kept between runs."""

from jaxgrasp.storage.arrays import (
    PICKLE_COST,
    Archive,
    Header,
    archive_in,
    array_of_bytes,
    open_archive,
    read_archive,
    read_array,
    read_members,
    read_objects,
)
from jaxgrasp.storage.cache import cache_folder
from jaxgrasp.storage.reading import (
    FileError,
    allowance,
    check_inflation,
    limited_to,
    open_regular,
    printable,
    reason_of,
)
from jaxgrasp.storage.rows import ArchiveRows
from jaxgrasp.storage.writing import atomic_write, check_writable, claimed, discard_unfinished, made_folder, unfinished

__all__ = [
    "PICKLE_COST",
    "Archive",
    "ArchiveRows",
    "FileError",
    "Header",
    "allowance",
    "archive_in",
    "array_of_bytes",
    "atomic_write",
    "cache_folder",
    "check_inflation",
    "check_writable",
    "claimed",
    "discard_unfinished",
    "limited_to",
    "made_folder",
    "open_archive",
    "open_regular",
    "printable",
    "read_archive",
    "read_array",
    "read_members",
    "read_objects",
    "reason_of",
    "unfinished",
]
