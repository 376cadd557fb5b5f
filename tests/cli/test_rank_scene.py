"""`jaxgrasp rank --scene`: configurations of a hand in, a table, a figure and a rendered picture out."""

from pathlib import Path

import numpy as np
import pyarrow.parquet
import pytest
from pictures import has_context

from jaxgrasp.cli import main
from jaxgrasp.cli.errors import CommandError
from jaxgrasp.cli.scene import Scene
from jaxgrasp.cli.streams import tell_notices

COUNT = 48


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
    return tmp_path_factory.mktemp("scenes")


@pytest.fixture(scope="module")
def sampled(folder) -> pyarrow.parquet.ParquetFile:
    """The table of a ranking of sampled configurations; compiled once for all tests."""
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        assert (
            main(["rank", "--scene", "four_fingers", "--samples", str(COUNT), "--min-contacts", "0", "--top", "6"]) == 0
        )
    return pyarrow.parquet.read_table(folder / "ranking.parquet")


def test_table_has_what_the_hand_does(sampled):
    columns = sampled.to_pydict()
    assert len(columns["rank"]) == COUNT and set(columns["source"]) == {"four_fingers"}
    assert np.array(columns["qpos"]).shape == (COUNT, 19)
    assert np.array(columns["margin"])[0] > 1 and min(columns["touching"]) >= 4
    assert max(columns["penetration"]) <= 2e-3
    controls = np.array(columns["controls"])
    assert controls.shape == (COUNT, 12)
    assert np.isfinite(controls[:6]).all() and np.isnan(controls[6:]).all()
    # A servo that squeezes is sent beyond where its joint is, by at most what its largest force asks for.
    ahead = np.abs(controls[:6] - np.array(columns["qpos"])[:6, :12])
    assert 0.01 < ahead.max() <= 0.25 + 1e-6


def test_best_are_rendered(sampled, folder):
    if not has_context():
        pytest.skip("no OpenGL context can be had here")
    assert (folder / "hands.png").stat().st_size > 50_000


def ranked(folder, monkeypatch, *arguments, **columns) -> tuple[int, dict]:
    monkeypatch.chdir(folder)
    np.savez(folder / "candidates.npz", **columns)
    command = ["rank", "--scene", "four_fingers", "--qpos", "candidates.npz", "--top", "6", "--min-contacts", "0"]
    code = main([*command, "--figure", "None", "--picture", "again.png", "--output", "again.npz", *arguments])
    with np.load(folder / "again.npz", allow_pickle=False) as table:
        return code, dict(table)


def test_files_give_the_same_and_bad_rows_are_alone(sampled, folder, monkeypatch, capsys):
    def nothing(*_):
        raise RuntimeError("no OpenGL context for MuJoCo's renderer; set MUJOCO_GL=egl")

    monkeypatch.setattr("jaxgrasp.viewer.scene.offscreen", nothing)
    given = sampled.to_pydict()
    qpos = np.array(given["qpos"])
    qpos[5, 3], qpos[7, 15:19] = np.nan, 2.0
    code, found = ranked(folder, monkeypatch, qpos=qpos, name=np.arange(COUNT))
    # A picture that cannot be made is told, and keeps nothing else back.
    assert code == 0 and "MUJOCO_GL=egl" in capsys.readouterr().err
    back = np.argsort(found["index"])
    assert np.all(found["name"] == found["index"])
    bad = np.isin(np.arange(COUNT), (5, 7))
    assert np.all((found["status"][back] == "INVALID_INPUT") == bad)
    np.testing.assert_allclose(found["margin"][back][~bad], np.array(given["margin"])[~bad], atol=1e-7)


def test_what_is_left_out_is_counted(sampled, folder, monkeypatch, capsys):
    monkeypatch.chdir(folder)
    qpos, half = np.array(sampled.to_pydict()["qpos"]), COUNT // 2
    scene = Scene(scene="four_fingers", qpos=Path("moved.npy"), min_contacts=3)
    qpos[:half, 12] += 0.5
    np.save("moved.npy", qpos)
    found = scene.candidates(None, None)[0]
    np.testing.assert_array_equal(found.index, np.arange(half, COUNT))
    text = f"left out {half} of {COUNT} configurations: {half} with fewer than 3 contacts, 0 deeper than 2 mm"
    tell_notices()
    assert text in capsys.readouterr().err
    qpos[half:, 12] += 1.0
    np.save("moved.npy", qpos)
    with pytest.raises(CommandError, match=f"none of {COUNT} configurations has 3 contacts.* --contact-distance"):
        scene.candidates(None, None)


@pytest.mark.parametrize(
    "arguments, message",
    [
        (["--qpos", "q.npy"], "--qpos: got a file without --scene"),
        (["--scene", "absent.xml"], "absent.xml cannot be read"),
        (
            ["--scene", "four_fingers", "--object-body", "cup"],
            "object_body: got 'cup', wanted one of the scene's bodies",
        ),
        (["--scene", "four_fingers", "--object-shape", "cone"], "got 'cone', wanted one of sphere"),
        (["--scene", "four_fingers", "--gravity", "9.81"], "--scene: got --gravity, too"),
        (["--scene", "four_fingers", "--qpos", "short.npy"], "qpos: got float64 (3, 18); wanted (N, 19)"),
        (["--scene", "four_fingers", "--qpos", "other.npz"], "got fields q; wanted qpos (N, 19)"),
        (["--scene", "four_fingers", "--qpos", "ragged.npz"], "name: got shape (2,); wanted (3, ...)"),
        (["--scene", "four_fingers", "--max-contacts", "0"], "--max-contacts: got 0; wanted at least 1"),
        (["--scene", "four_fingers", "--picture", "hands.txt"], "--picture hands.txt: got the ending '.txt'"),
    ],
)
def test_what_cannot_be_used_is_one_line(tmp_path, monkeypatch, capsys, arguments, message):
    monkeypatch.chdir(tmp_path)
    np.save("short.npy", np.zeros((3, 18)))
    np.savez("other.npz", q=np.zeros((3, 19)))
    np.savez("ragged.npz", qpos=np.zeros((3, 19)), name=np.zeros(2))
    assert main(["rank", *arguments]) == 2
    error = capsys.readouterr().err
    assert error.count("\n") == 1 and error.startswith("jaxgrasp: ") and message in error
