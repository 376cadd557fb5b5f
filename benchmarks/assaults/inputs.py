"""Malformed inputs by kind: each a file that `jaxgrasp` is given."""

from __future__ import annotations

import itertools
import os
import random
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from benchmarks.assaults.arrays import archives, arrays
from benchmarks.assaults.distributions import archived_distributions, distributions
from benchmarks.assaults.further import more_archives, more_arrays, more_models, more_obj, more_ply, more_stl
from benchmarks.assaults.models import models
from benchmarks.assaults.shapes import large_obj, large_ply, large_stl, obj, ply, stl
from benchmarks.assaults.streamed import arrows, parquets, runs


@dataclass(frozen=True)
class Case:
    kind: str
    """One of `MAKERS`."""
    name: str
    path: Path


MAKERS = {
    "npz": (archives, more_archives),
    "npy": (arrays, more_arrays),
    "stl": (stl, more_stl, large_stl),
    "obj": (obj, more_obj, large_obj),
    "ply": (ply, more_ply, large_ply),
    "xml": (models, more_models),
    "json": (distributions,),
    "errors.npz": (archived_distributions,),
    "parquet": (parquets,),
    "arrow": (arrows,),
    "run": (runs,),
}
LARGE = (large_stl, large_obj, large_ply)


def cases(folder: Path, only: str | None = None, seed: int = 0, large: bool = False) -> list[Case]:
    """Writes all of them, or those of one kind, into a folder; megabytes that are slow to make only where asked for."""
    found = []
    for kind, makes in MAKERS.items():
        if only not in (None, kind):
            continue
        home = folder / kind
        home.mkdir(parents=True)
        names = os.fspath(home)
        made = (make(random.Random(seed), home) for make in makes if large or make not in LARGE)
        for name, content in itertools.chain.from_iterable(made):
            path = Path(names, f"{len(found):04d}_{name}.{kind}")
            if isinstance(content, bytes):
                path.write_bytes(content)
            else:
                content(path)
            found.append(Case(kind, name, path))
        for name, content in special(home):
            path = home / f"{len(found):04d}_{name}.{kind}"
            content(path)
            found.append(Case(kind, name, path))
    return found


def special(home: Path) -> Iterator[tuple[str, Any]]:
    """Files that are none, and text that no encoding takes."""
    yield "fifo", os.mkfifo
    yield "folder", os.mkdir
    yield "loop", lambda path: path.symlink_to(path)
    yield "dangling", lambda path: path.symlink_to(home / "nothing")
    for device in ("zero", "null", "urandom", "full"):
        yield f"dev_{device}", lambda path, device=device: path.symlink_to(f"/dev/{device}")
    yield "memory", lambda path: path.symlink_to("/proc/self/mem")
    yield "sparse_20G", lambda path: os.truncate(os.open(path, os.O_CREAT | os.O_WRONLY), 20 << 30)
    yield "absent", lambda path: None
    for label in ("line\nend", "\x1b[31mred", "[red]x", "$x$", "%s%n", "größe 猫", "\udcff\udcfe"):
        yield f"named_{label}", lambda path: path.write_bytes(b"broken")
    yield "empty", lambda path: path.write_bytes(b"")
    yield "noise", lambda path: path.write_bytes(random.Random(1).randbytes(5000))
    yield "text", lambda path: path.write_bytes(b"hello\n" * 100)
    yield "zeros", lambda path: path.write_bytes(bytes(100_000))
