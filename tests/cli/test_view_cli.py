"""`jaxgrasp view` without a browser: what it takes, and what it refuses in a line. The page is in tests/viewer."""

import importlib.util
import socket
from pathlib import Path

import numpy as np
import pytest

from jaxgrasp.candidates import read_candidates, sample_grasps
from jaxgrasp.cli import main
from jaxgrasp.cli.view import View
from jaxgrasp.cli.viewed_table import is_table, joined, read_table
from jaxgrasp.storage import FileError

COUNT = 40


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    path = tmp_path_factory.mktemp("view")
    found = sample_grasps(COUNT, seed=2)
    fields = {"positions": found.positions, "outward_normals": found.outward_normals, "mass": found.mass}
    for name, part in (("a.npz", slice(0, 25)), ("b.npz", slice(25, COUNT))):
        np.savez(path / name, friction=0.6, max_force=5.0, **{key: value[part] for key, value in fields.items()})
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(path)
        assert main(["rank", "a.npz", "b.npz", "--figure", "None", "--output", "ranking.parquet"]) == 0
    return path


@pytest.fixture(autouse=True)
def there(folder, monkeypatch):
    monkeypatch.chdir(folder)


def viewed(*files: str, **options):
    from jaxgrasp.cli.checks import Skipped
    from jaxgrasp.cli.setting import named_disturbances

    return View(files=files, **options)._viewed(*named_disturbances("forces"), Skipped())[0]


def test_a_table_finds_the_grasps_that_it_is_of(folder):

    found = viewed(Path("ranking.parquet"))
    assert len(found) == COUNT and found.table["rank"].tolist() == list(range(1, COUNT + 1))
    files = {name: read_candidates([name], friction=0.6, max_force=5.0) for name in ("a.npz", "b.npz")}
    for row in range(COUNT):
        own = files[found.table["source"][row]]
        np.testing.assert_array_equal(found.candidates.positions[row], own.positions[found.table["index"][row]])
        assert found.name(row) == f"{found.table['source'][row]}:{found.table['index'][row]}"


def test_files_are_ranked_as_the_table_is(folder):

    found, table = viewed(Path("a.npz"), Path("b.npz")), read_table(Path("ranking.parquet"))
    np.testing.assert_allclose(found.table["margin"], table["margin"], rtol=1e-9)
    np.testing.assert_array_equal(found.candidates.index, table["index"])


@pytest.mark.parametrize("ending", ["csv", "npz"])
def test_tables_of_all_kinds_are_read(folder, ending):

    assert main(["rank", "a.npz", "--figure", "None", "--output", f"other.{ending}"]) == 0
    path = Path(f"other.{ending}")
    assert is_table(path) and not is_table(Path("a.npz"))
    table = read_table(path)
    assert table["source"].tolist() == ["a.npz"] * 25 and (np.diff(table["margin"]) <= 0).all()


def test_a_table_is_joined_to_other_candidates(folder):

    table = read_table(Path("ranking.parquet"))
    candidates, rows = joined(table, read_candidates(["b.npz"]), Path("ranking.parquet"))
    assert len(candidates) == 15 and set(rows["source"].tolist()) == {"b.npz"}
    np.testing.assert_array_equal(candidates.index, rows["index"])
    with pytest.raises(FileError, match=r"source: got rows of .*; wanted rows of superquadric"):
        joined(table, sample_grasps(3), Path("ranking.parquet"))


def refused(capsys, *arguments: str) -> str:
    assert main(["view", *arguments]) == 2
    line = capsys.readouterr().err
    assert line.count("\n") == 1 and line.startswith("jaxgrasp: ")
    return line


def test_the_missing_extra_is_named(capsys, monkeypatch):
    find = importlib.util.find_spec
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None if name == "viser" else find(name))
    assert "wanted pip install 'jaxgrasp[view]'" in refused(capsys, "a.npz")


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["--port", "70000"], "--port: got 70000; wanted 0 to 65535"),
        (["--share", "0"], "--share: got 0.0; wanted a number in (0, 1]"),
        (["--export", "a.obj"], "wanted one of .glb, .usda, .xml"),
        (["--top", "0"], "--top: got 0; wanted at least 1"),
        (["missing.parquet"], "missing.parquet"),
        (["--scene", "four_fingers", "a.npz", "b.npz"], "wanted one table at most"),
    ],
)
def test_it_refuses_in_a_line(capsys, arguments, words):
    pytest.importorskip("viser")
    assert words in refused(capsys, *arguments)


def test_a_port_in_use_is_refused(capsys):
    pytest.importorskip("viser")
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        port = taken.getsockname()[1]
        assert f"--port {port}: cannot be listened at" in refused(capsys, "a.npz", "--port", str(port))


def test_a_table_without_its_files_says_so(folder, capsys, tmp_path, monkeypatch):
    (tmp_path / "ranking.parquet").write_bytes((folder / "ranking.parquet").read_bytes())
    monkeypatch.chdir(tmp_path)
    assert "a.npz, which is not there" in refused(capsys, "ranking.parquet", "--export", "best.usda")
    np.savez(tmp_path / "odd.npz", rank=[1], source=["a.npz"], index=[0.5], margin=[1.0])
    assert "odd.npz: index: got float64" in refused(capsys, "odd.npz", "--export", "best.usda")


def test_a_server_answers_and_ends(folder):
    pytest.importorskip("viser")
    from urllib.request import urlopen

    from jaxgrasp.viewer.browser.server import served

    with served(viewed(Path("ranking.parquet")), port=0) as address:
        assert address.startswith("http://127.0.0.1:")
        with urlopen(address) as answer:
            assert answer.status == 200 and b"<html" in answer.read()
    with pytest.raises(OSError, match="refused"):
        urlopen(address)
