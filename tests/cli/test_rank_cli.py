"""The command `jaxgrasp rank`: what it prints and writes, and the one line and exit code for what it cannot use."""

import os
import re
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pyarrow.parquet
import pytest

from jaxgrasp.candidates import sample_grasps
from jaxgrasp.cli import candidate_options, main, setting
from jaxgrasp.solvers.status import Status

YCB = Path(__file__).resolve().parents[3] / "shared" / "data" / "ycb_allegro_grasps.npz"


@pytest.fixture
def here(tmp_path, monkeypatch) -> Path:
    monkeypatch.chdir(tmp_path)
    return tmp_path


def write_candidates(path, count=24, **changes) -> Path:
    grasps = sample_grasps(count)
    fields = {
        "positions": grasps.positions,
        "outward_normals": grasps.normals,
        "friction": grasps.friction,
        "max_force": grasps.max_force,
        "mass": grasps.mass,
        "object_name": np.full(count, "a [bold] box"),
    }
    np.savez(path, **{name: value for name, value in (fields | changes).items() if value is not None})
    return path


def refused(capsys, *arguments) -> str:
    """The one line on standard error of a command that is refused, with nothing computed, printed or written."""
    before = set(Path.cwd().iterdir())
    assert main(["rank", *map(str, arguments)]) == 2
    captured = capsys.readouterr()
    assert captured.out == ""
    assert captured.err.count("\n") == 1 and captured.err.startswith("jaxgrasp: ")
    assert set(Path.cwd().iterdir()) == before
    return captured.err


def test_prints_and_writes(here, capsys):
    path = write_candidates(here / "grasps.npz")
    assert main(["rank", str(path), "--gravity", "9.81", "--top", "8"]) == 0
    printed = capsys.readouterr().out
    assert "grasps.npz:" in printed and "a [bold] box" in printed and "margin [N]" in printed
    counts = [int(number) for number in re.findall(r"(\d+) [A-Z_]{6,}", printed)][-len(Status) :]
    assert sum(counts) == 24 and "0 INVALID_INPUT" in printed
    assert "written: ranking.parquet, ranking.png" in printed
    table = pyarrow.parquet.read_table("ranking.parquet")
    assert table.num_rows == 24 and table["forces"].null_count == 16
    assert (here / "ranking.png").read_bytes().startswith(b"\x89PNG")
    assert sorted(file.name for file in here.iterdir()) == ["grasps.npz", "ranking.parquet", "ranking.png"]


def test_without_a_file_it_samples(here, capsys, monkeypatch):
    monkeypatch.setattr(candidate_options, "SAMPLED", 24)
    assert main(["rank", "--output", "table.csv", "--figure", "None"]) == 0
    assert "superquadric" in capsys.readouterr().out
    assert [file.name for file in here.iterdir()] == ["table.csv"]


@pytest.mark.parametrize("disturbances", ["ball", "box", "wrenches.npy", "wrenches.npz"])
def test_disturbances(here, capsys, disturbances):
    np.save("wrenches.npy", np.eye(6)[:3])
    np.savez("wrenches.npz", wrenches=np.eye(6)[:3])
    path = write_candidates(here / "grasps.npz")
    options = ["--disturbances", disturbances, "--top", "0", "--output", "table.npz", "--figure", "None"]
    assert main(["rank", str(path), *options]) == 0
    with np.load("table.npz", allow_pickle=False) as table:
        assert (table["status"] == "SOLVED").all() and table["margin"].max() > 0.0


def test_a_larger_set_of_disturbances_leaves_less(here, capsys):
    path = write_candidates(here / "grasps.npz")
    margins = {}
    for name in ("forces", "ball", "box"):
        options = ["--disturbances", name, "--top", "0", "--output", "table.npz", "--figure", "None"]
        assert main(["rank", str(path), *options]) == 0
        with np.load("table.npz", allow_pickle=False) as table:
            margins[name] = table["margin"][np.argsort(table["index"])]
    tolerance = 1e-6
    assert (margins["ball"] <= margins["forces"] + tolerance).all()
    assert (margins["box"] <= margins["ball"] + tolerance).all()
    assert (margins["box"] < margins["forces"] - 1e-3).any()


def test_bad_candidates_are_counted_last(here, capsys):
    positions = sample_grasps(24).positions.copy()
    positions[4] = np.nan
    path = write_candidates(here / "grasps.npz", positions=positions)
    assert main(["rank", str(path)]) == 0
    assert "1 INVALID_INPUT" in capsys.readouterr().out
    table = pyarrow.parquet.read_table("ranking.parquet")
    assert table["index"].to_pylist()[-1] == 4 and table["status"].to_pylist()[-1] == "INVALID_INPUT"


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (["--friction", "-1"], "--friction: got -1.0"),
        (["--friction", "nan"], "--friction: got nan"),
        (["--max-force", "0"], "--max-force: got 0.0"),
        (["--gravity", "inf"], "--gravity: got inf"),
        (["--cone-edges", "2"], "--cone-edges: got 2"),
        (["--share", "1.2"], "--share: got 1.2"),
        (["--top", "-1"], "--top: got -1"),
        (["--output", "table.xlsx"], "--output table.xlsx"),
        (["--output", "none/table.csv"], "--output none/table.csv"),
        (["--figure", "figure.txt"], "--figure figure.txt"),
        (["--figure", "none/figure.png"], "no such file or directory"),
        (["--disturbances", "bull"], "bull"),
        (["--output", "grasps.npz"], "read from"),
    ],
)
def test_bad_options(here, capsys, options, words):
    write_candidates(here / "grasps.npz")
    assert words in refused(capsys, "grasps.npz", *options)


@pytest.mark.parametrize(
    ("changes", "options", "words"),
    [
        ({"max_force": None}, [], "--max-force"),
        ({"friction": None}, [], "--friction"),
        ({"mass": None}, ["--gravity", "9.81"], "mass"),
        ({"positions": None, "position": np.ones((24, 4, 3))}, [], "'positions'"),
        ({"positions": np.ones((24, 4, 3), dtype=object)}, [], "never unpickled"),
    ],
)
def test_bad_files(here, capsys, changes, options, words):
    write_candidates(here / "grasps.npz", **changes)
    assert words in refused(capsys, "grasps.npz", *options)


def test_absent_and_truncated_files(here, capsys):
    assert "no such file" in refused(capsys, "none.npz")
    content = write_candidates(here / "grasps.npz").read_bytes()
    (here / "grasps.npz").write_bytes(content[: len(content) // 2])
    assert "truncated" in refused(capsys, "grasps.npz")


def test_a_folder_that_cannot_be_written(here, capsys):
    write_candidates(here / "grasps.npz")
    (here / "folder.csv").mkdir()
    assert "folder.csv" in refused(capsys, "grasps.npz", "--output", "folder.csv")


def test_an_older_table_survives_a_refused_command(here, capsys):
    (here / "table.csv").write_text("old")
    refused(capsys, "none.npz", "--output", "table.csv")
    assert (here / "table.csv").read_text() == "old"


def test_an_output_that_fails_in_the_end_costs_no_other(here, capsys, monkeypatch):
    import jaxgrasp.ranking

    def fail(*_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(jaxgrasp.ranking, "write_table", fail)
    path = write_candidates(here / "grasps.npz")
    assert main(["rank", str(path)]) == 2
    captured = capsys.readouterr()
    assert captured.err == "jaxgrasp: ranking.parquet: cannot be written (No space left on device)\n"
    assert "24 SOLVED" in captured.out and "written: ranking.png" in captured.out


def test_help_is_quick_and_loads_nothing_heavy():
    program = (
        "import sys; sys.argv = ['jaxgrasp', '--help']; from jaxgrasp.cli import main\n"
        "try: main()\nexcept SystemExit: pass\n"
        "assert not {'matplotlib', 'pyarrow'} & set(sys.modules)"
    )
    subprocess.run([sys.executable, "-c", program], check=True, capture_output=True)


def test_interrupted_it_keeps_what_it_has(here):
    path = write_candidates(here / "grasps.npz", count=200_000)
    program = (
        "import sys, time; from jaxgrasp.cli import main\n"
        "from jaxgrasp.ranking import tiles; tiles.TILE['cpu'] = 1024\n"
        "from jaxgrasp.cli import report; tick = report.Clock.tick\n"
        # All of it would take half a second otherwise, which a busy machine may need to send the signal.
        "def shown(self, done): tick(self, done); print(done, flush=True); time.sleep(0.02)\n"
        "report.Clock.tick = shown; sys.exit(main(['rank', 'grasps.npz', '--figure', 'None']))"
    )
    process = subprocess.Popen(
        [sys.executable, "-c", program], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, env=os.environ
    )
    assert process.stdout is not None and process.stderr is not None
    process.stdout.readline()
    time.sleep(0.05)
    process.send_signal(signal.SIGINT)
    printed, complaint = process.communicate(timeout=120)
    assert process.returncode == 130
    rows = pyarrow.parquet.read_table("ranking.parquet").num_rows
    assert 0 < rows < 200_000
    assert complaint.strip() == f"jaxgrasp: interrupted: ranked {rows:,} of 200,000"
    assert path.exists() and "written: ranking.parquet" in printed


@pytest.mark.skipif(not YCB.exists(), reason="the collection of real grasps is not here")
def test_real_grasps(here, capsys):
    assert main(["rank", str(YCB), "--max-force", "5", "--gravity", "9.81"]) == 0
    printed = capsys.readouterr().out
    assert "058_golf_ball" in printed and "292 SOLVED (292 with a margin above zero), 3 INFEASIBLE" in printed
    assert (here / "ranking.parquet").exists() and (here / "ranking.png").exists()


def test_programs_are_kept_where_nobody_else_writes(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    folder = setting._folder_of_programs()
    assert folder is not None and folder.is_relative_to(tmp_path / "jaxgrasp" / "programs")
    folder.chmod(0o777)
    assert setting._folder_of_programs() is None
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "file"))
    (tmp_path / "file").write_text("no folder")
    assert setting._folder_of_programs() is None
