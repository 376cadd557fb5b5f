"""Which files of candidates the words of a command line mean: files, folders, patterns, and all of these as URLs."""

import fnmatch
import glob
from collections.abc import Callable, Iterable
from urllib.parse import urlsplit, urlunsplit

from jaxgrasp.files.paths import grasp_files
from jaxgrasp.ranking.streams.sources import Given, Source, file_system, is_url, reading, source_of
from jaxgrasp.storage import FileError

ENDINGS = (".npz", ".parquet", ".arrow", ".feather", ".ipc")
"""Of the files that are looked for in folders."""


def names_of(words: Iterable[str]) -> list[str]:
    """Files, folders and patterns as files.

    Args:
        words: Files as they are; folders stand for the files in them and below with one of `ENDINGS`, in the order of
            their names; patterns for what they fit. Any of them may be a URL.

    Raises:
        FileError: A folder or a pattern has no such file, or a URL cannot be reached.
    """
    found: list[str] = []
    for word in words:
        found += _names_at(word) if is_url(word) else map(str, grasp_files([word], ENDINGS))
    return found


def sources_of(
    names: Iterable[str],
    given: Given,
    skipped: Callable[[FileError], None] | None = None,
    progress: Callable[[int], None] | None = None,
) -> list[Source]:
    """What files of candidates declare.

    Args:
        names: Of the files, see `names_of`.
        given: What files without some fields get.
        skipped: Told of those that cannot be used; None lets the error out.
        progress: Called with the number of files that were looked at.

    Raises:
        FileError: One cannot be used.
    """
    found: list[Source] = []
    for done, name in enumerate(names, 1):
        try:
            found.append(source_of(name, given))
        except FileError as error:
            if skipped is None:
                raise
            skipped(error)
        if progress is not None:
            progress(done)
    return found


def _names_at(url: str) -> list[str]:
    """The same for a URL."""
    from pyarrow import fs

    parts = urlsplit(url)
    magic = glob.has_magic(parts.netloc + parts.path)
    path = parts.path
    if magic:
        # The folder above the first part of the path that is a pattern.
        plain = path.split("/")
        path = "/".join(plain[: next(n for n, piece in enumerate(plain) if glob.has_magic(piece))])
    base = urlunsplit(parts._replace(path=path))
    with reading(url):
        system, inner = file_system(base)
        inner = inner.rstrip("/") or inner
        there = system.get_file_info(inner)
        if there.type == fs.FileType.File or (there.type == fs.FileType.NotFound and not magic):
            return [url]
        inside = system.get_file_info(fs.FileSelector(inner, recursive=True, allow_not_found=True))
    files = sorted(info.path for info in inside if info.type == fs.FileType.File)
    # Some file systems count the host, or the bucket, as part of the path.
    whole = lambda found: parts.netloc + "/" + found.lstrip("/").removeprefix(f"{parts.netloc}/")
    if magic:
        wanted = parts.netloc + "/" + parts.path.lstrip("/")
        fitting = [found for found in files if fnmatch.fnmatchcase(whole(found), wanted)]
    else:
        hidden = lambda found: any(piece.startswith((".", "_")) for piece in found[len(inner) :].split("/"))
        fitting = [found for found in files if found.lower().endswith(ENDINGS) and not hidden(found)]
    if not fitting:
        wanted = "files of candidates" if magic else f"some with {', '.join(ENDINGS)}"
        raise FileError(url, None, "no such files", wanted)
    return [urlunsplit(parts._replace(netloc="", path="//" + whole(found))) for found in fitting]
