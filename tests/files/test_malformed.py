"""Malformed files by the hundred, as readers and writers of tables take them; the whole study is under benchmarks."""

import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))

from benchmarks.assaults import arrays  # noqa: E402
from benchmarks.assaults.commands import unsolved  # noqa: E402
from benchmarks.assaults.inputs import cases  # noqa: E402
from jaxgrasp.candidates import CandidateError, read_candidates, read_wrenches  # noqa: E402
from jaxgrasp.geometry import Mesh, MeshError  # noqa: E402
from jaxgrasp.ranking import write_table  # noqa: E402


def candidates(path: Path, folder: Path) -> None:
    found = read_candidates([path], friction=0.6, max_force=10.0)
    with np.load(path, allow_pickle=False) as theirs:
        np.testing.assert_array_equal(found.positions, theirs["positions"].astype(float))
    for ending in (".parquet", ".csv", ".npz"):
        write_table(unsolved(found), folder / f"table{ending}")


def wrenches(path: Path, folder: Path) -> None:
    found, theirs = read_wrenches(path), np.load(path, allow_pickle=False)
    np.testing.assert_array_equal(found, (theirs["wrenches"] if hasattr(theirs, "files") else theirs).astype(float))


def mesh(path: Path, folder: Path) -> None:
    assert np.isfinite(Mesh.from_file(path).vertices).all()


READERS: dict[str, Callable[[Path, Path], None]] = {
    "npz": candidates,
    "npy": wrenches,
    "stl": mesh,
    "obj": mesh,
    "ply": mesh,
}


@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize("kind", READERS)
def test_every_malformed_file_is_refused_in_one_line_or_has_its_meaning(tmp_path, monkeypatch, kind):
    # Gigabytes of zeros take long to write; test_storage has some.
    monkeypatch.setattr(arrays, "bomb", lambda *_: b"")
    refused = 0
    for case in cases(tmp_path / "inputs", kind):
        try:
            READERS[kind](case.path, tmp_path)
        except (CandidateError, MeshError) as error:
            refused += 1
            assert str(error).isprintable(), case.name
        except Exception as error:
            raise AssertionError(f"{case.name}: {type(error).__name__}") from error
    assert refused > 50
