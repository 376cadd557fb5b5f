"""What `jaxgrasp` does with malformed inputs: one line and exit 2, or the right meaning, in little time and memory.

Every input is given to the command's `main` in a process of its own, forked from one that has imported everything, so
that a thousand of them take minutes; `--sample N` runs every Nth as a command from its very start. What is accepted is
read, checked and written as the command does, without the computation between. What is accepted from an archive
or an array is held against NumPy's own reader. Seconds are the processor's, so that busy machines tell the same;
what takes three minutes on the clock is killed.

    python -m benchmarks.assaults.malformed [--sample 40] [--kind npz] [--output malformed.md]
"""

from __future__ import annotations

import argparse
import os
import pickle
import sys
import tempfile
import warnings
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.assaults import outcomes
from benchmarks.assaults.arrays import grasps
from benchmarks.assaults.commands import leave_out_computation
from benchmarks.assaults.inputs import Case, cases
from benchmarks.assaults.outcomes import Outcome, table

# Of what a command does by itself.
_OF_MESHES = ["--starts", "8", "--steps", "10"]
_FEW = {"xml": ["--samples", "8"], "stl": _OF_MESHES, "obj": _OF_MESHES, "ply": _OF_MESHES}
RANK = ["--output", "table.csv", "--figure", "None", "--top", "2"]


def arguments(case: Case, good: Path) -> list[str]:
    path = os.fspath(case.path)
    if case.kind in ("npz", "parquet", "arrow"):
        return ["rank", path, *RANK]
    if case.kind in ("json", "errors.npz"):
        return ["rank", os.fspath(good), "--uncertainty", path, *RANK]
    if case.kind == "run":
        return ["rank", "--resume", path, "--sorted", "--top", "2"]
    if case.kind == "npy":
        return ["rank", os.fspath(good), "--disturbances", path, *RANK]
    if case.kind == "xml":
        return ["rank", "--scene", path, *RANK, "--picture", "None"]
    return ["synthesize", "--object", path, "--figure", "None", "--output", "table.npz"]


def made(folder: Path, kind: str | None) -> list[Case]:
    """Makes the inputs in a process of its own: those that are forked from this one begin with its memory."""
    path = folder / "cases"
    child = os.fork()
    if child == 0:
        try:
            # Some of the archives have two members of one name.
            warnings.simplefilter("ignore")
            path.write_bytes(pickle.dumps(cases(folder / "inputs", kind, large=True)))
            os._exit(0)
        finally:
            os._exit(1)
    os.waitpid(child, 0)
    return pickle.loads(path.read_bytes())


def forked(case: Case, good: Path, home: Path) -> Outcome:
    found = outcomes.forked(case, arguments(case, good), home, _leave_out_computation)
    return replace(found, accepted_wrongly=_wrongly_accepted(case)) if found.code == 0 else found


def commanded(case: Case, good: Path, home: Path) -> Outcome:
    few = _FEW.get(case.kind, [])
    return outcomes.commanded(case, [*arguments(case, good), *few], home)


def _leave_out_computation() -> None:
    """Ranks nothing, and ends the process where a mesh or a model has been accepted."""
    import jaxgrasp.cli.scene
    import jaxgrasp.geometry

    def accept(*_: Any, **__: Any) -> None:
        sys.stderr.flush()
        os._exit(0)

    leave_out_computation()
    jaxgrasp.geometry.sample_surface = accept
    # The first that a command does with a model that was read.
    jaxgrasp.cli.scene.Scene._sampled = accept


def _wrongly_accepted(case: Case) -> str:
    """What differs from NumPy's reader, in what was accepted."""
    from jaxgrasp.candidates import read_candidates, read_wrenches

    try:
        if case.kind == "npy":
            theirs = np.load(case.path, allow_pickle=False)
            theirs, ours = (theirs["wrenches"] if hasattr(theirs, "files") else theirs), read_wrenches(case.path)
            return "" if np.array_equal(theirs.astype(float), ours) else "other wrenches than NumPy"
        if case.kind == "npz":
            ours = read_candidates([case.path], friction=0.6, max_force=10.0)
            with np.load(case.path, allow_pickle=False) as theirs:
                same = np.array_equal(theirs["positions"].astype(float), ours.positions, equal_nan=True)
                for name, column in ours.columns.items():
                    if column.dtype.kind in "iuf":
                        same &= np.array_equal(theirs[name].astype(float), column.astype(float), equal_nan=True)
            return "" if same else "other columns than NumPy"
    except Exception as error:
        return f"accepted what NumPy refuses ({type(error).__name__})"
    return ""


def main() -> None:
    options = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    options.add_argument("--sample", type=int, default=40, help="every how manieth is run as a command; 0 for none")
    options.add_argument("--kind", help="of one kind alone")
    options.add_argument("--name", help="of names with this in them alone")
    options.add_argument("--every", type=int, default=1, help="every how manieth is tried at all")
    options.add_argument("--output", type=Path)
    options.add_argument("--verbose", action="store_true", help="print every outcome")
    given = options.parse_args()
    import jaxgrasp.cli.subcommands
    import jaxgrasp.geometry
    import jaxgrasp.hands.scenes
    import jaxgrasp.ranking.streams.run
    import jaxgrasp.uncertainty
    import jaxgrasp.viewer  # noqa: F401

    with tempfile.TemporaryDirectory() as folder:
        good, home = Path(folder, "good.npz"), Path(folder, "home")
        home.mkdir()
        np.savez(good, **grasps())
        tried = made(Path(folder), given.kind)[:: given.every]
        tried = [c for c in tried if (given.name or "") in c.name]
        found = []
        for case in tried:
            found.append(forked(case, good, home))
            if given.verbose or found[-1].faults:
                print(case.kind, repr(case.name[:60]), found[-1].code, f"{found[-1].seconds:.1f} s", end=" ")
                print(f"{found[-1].mebibytes:.0f} MiB", found[-1].faults, found[-1].errors[-300:].strip(), flush=True)
        text = table(found, "In forked processes")
        if given.sample:
            text += "\n" + table([commanded(c, good, home) for c in tried[:: given.sample]], "As commands")
        left = sorted(path.name for path in home.iterdir())
        text += f"\nFiles left in the working folder: {', '.join(left)}.\n"
    print(text)
    if given.output:
        given.output.write_text(text)


if __name__ == "__main__":
    main()
