"""Every example runs, below 80 lines, and leaves the file that it says."""

import runpy
from pathlib import Path

import pytest

EXAMPLES = sorted((Path(__file__).resolve().parents[1] / "examples").glob("*.py"))


def test_they_are_numbered():
    assert [int(path.name[:2]) for path in EXAMPLES] == list(range(1, len(EXAMPLES) + 1))
    assert len(EXAMPLES) >= 2


# What examples need beside the package.
NEEDED = {"08_tables_in_dask": "dask", "09_tables_in_spark": "pyspark", "10_tables_in_ray": "ray"}
SLOW = (*NEEDED, "02_tightening_and_blocking_forces", "03_mesh_to_grasp", "04_push_at_rest", "05_push_in_motion")


@pytest.mark.parametrize(
    "path",
    [pytest.param(path, marks=pytest.mark.thorough) if path.stem in SLOW else path for path in EXAMPLES],
    ids=lambda path: path.stem,
)
def test_example(path, tmp_path, monkeypatch, capsys):
    pytest.importorskip(NEEDED.get(path.stem, "jaxgrasp"))
    assert len(path.read_text().splitlines()) < 80
    monkeypatch.chdir(tmp_path)
    runpy.run_path(str(path), run_name="__main__")
    last = capsys.readouterr().out.splitlines()[-1]
    assert last.startswith("written: ")
    written = tmp_path / last.removeprefix("written: ")
    assert written.stat().st_size > 1000
