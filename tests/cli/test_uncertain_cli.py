"""`jaxgrasp rank --uncertainty`: columns, order, runs in parts, and what is refused."""

from __future__ import annotations

import json

import numpy as np
import pyarrow.parquet as pq
import pytest

import jaxgrasp as jg
from jaxgrasp.candidates import read_candidates, sample_grasps
from jaxgrasp.cli import main
from jaxgrasp.ranking import Uncertain, uncertain_scores
from jaxgrasp.ranking.order import order_of
from jaxgrasp.uncertainty import read_uncertainty

SPEC = {"friction": {"std": 0.1, "correlation": 1.0}, "position": 0.001, "normal": 0.05}
COUNT, SAMPLES = 30, 40


@pytest.fixture(scope="module")
def files(tmp_path_factory):
    folder = tmp_path_factory.mktemp("uncertain")
    found = sample_grasps(COUNT, friction=0.6, max_force=5.0)
    np.savez(
        folder / "grasps.npz",
        positions=found.positions,
        outward_normals=found.normals,
        friction=found.friction,
        max_force=found.max_force,
    )
    (folder / "spec.json").write_text(json.dumps(SPEC))
    return folder


def rank(files, *options: str) -> int:
    given = ["rank", str(files / "grasps.npz"), "--uncertainty", str(files / "spec.json"), "--draws", str(SAMPLES)]
    return main([*given, "--top", "3", *options])


def test_a_table_has_the_columns_and_the_order_of_the_probability(files, tmp_path, capsys):
    table, figure = tmp_path / "a.parquet", tmp_path / "a.png"
    assert rank(files, "--output", str(table), "--figure", str(figure)) == 0
    assert "by p_hold" in capsys.readouterr().out
    found = pq.read_table(table).to_pydict()
    candidates = read_candidates([files / "grasps.npz"])
    asked = Uncertain(uncertainty=read_uncertainty(files / "spec.json"), samples=SAMPLES)
    wanted = uncertain_scores(candidates, asked, jg.DisturbanceSet.forces(1.0))
    for name, column in wanted.items():
        np.testing.assert_allclose(found[name], column[found["index"]], atol=1e-6)
    p = np.array(found["p_hold"])
    assert (np.diff(p) <= 0).all() and len(np.unique(p)) > 3
    ties = np.flatnonzero(np.diff(p) == 0)
    assert (np.diff(found["margin_quantile"])[ties] <= 0).all()
    assert figure.stat().st_size > 10_000


def test_a_folder_has_the_same_as_a_table_also_by_the_quantile(files, tmp_path):
    table, folder = tmp_path / "a.parquet", tmp_path / "run"
    assert rank(files, "--by", "quantile", "--output", str(table), "--figure", "None") == 0
    assert rank(files, "--by", "quantile", "--run", str(folder), "--part-size", "7", "--sorted") == 0
    one, parts = pq.read_table(table).to_pydict(), pq.read_table(folder / "sorted.parquet").to_pydict()
    assert one["index"] == parts["index"]
    np.testing.assert_allclose(one["margin_quantile"], parts["margin_quantile"], atol=1e-6)
    assert (np.diff(one["margin_quantile"]) <= 1e-12).all()
    top = pq.read_table(folder / "top.parquet").to_pydict()
    assert top["index"] == one["index"][:3]
    manifest = json.loads((folder / "manifest.json").read_text())
    assert manifest["options"]["by"] == "quantile"
    # Nothing is left to do, and the options are those that it began with.
    assert main(["rank", "--resume", str(folder), "--figure", "None"]) == 0


def test_a_file_that_changed_ends_a_run(files, tmp_path, capsys):
    folder, spec = tmp_path / "run", tmp_path / "spec.json"
    spec.write_text('{"friction": 0.1}')
    given = ["rank", str(files / "grasps.npz"), "--uncertainty", str(spec), "--draws", "4", "--top", "1"]
    assert main([*given, "--run", str(folder), "--figure", "None"]) == 0
    spec.write_text('{"friction": 0.2}')
    assert main(["rank", "--resume", str(folder)]) == 2
    assert "distributions" in capsys.readouterr().err


def test_equal_probabilities_are_ordered_by_the_quantile():
    metrics = {
        "p_hold": np.array([1.0, 1.0, 0.999, np.nan, 1.0]),
        "margin_quantile": np.array([1.0, 3.0, 9.0, np.nan, -np.inf]),
    }
    assert order_of(np.zeros(5), np.zeros(5, int), metrics).tolist() == [1, 0, 4, 2, 3]


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (["--by", "quantile"], "--by"),
        (["--draws", "5"], "--draws"),
        (["--uncertainty", "absent.json"], "absent.json"),
        (["--uncertainty", "SPEC", "--prune"], "--prune"),
        (["--uncertainty", "SPEC", "--quantile", "1"], "--quantile"),
        (["--uncertainty", "SPEC", "--load", "-1"], "--load"),
        (["--uncertainty", "SPEC", "--draws", "0"], "--draws"),
        (["--uncertainty", "WRONG"], "friction"),
    ],
)
def test_what_cannot_be_used_is_one_line(files, tmp_path, capsys, options, words):
    (tmp_path / "wrong.json").write_text('{"friction": [0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7]}')
    named = {"SPEC": str(files / "spec.json"), "WRONG": str(tmp_path / "wrong.json")}
    options = [named.get(option, option) for option in options]
    assert main(["rank", str(files / "grasps.npz"), "--output", "None", "--figure", "None", *options]) == 2
    err = capsys.readouterr().err
    assert words in err and len(err.strip().splitlines()) == 1
