"""Comparisons of metrics against SciPy's statistics, `jaxgrasp rank --metric` and `jaxgrasp compare`."""

from __future__ import annotations

import csv
from pathlib import Path

import numpy as np
import pyarrow.parquet
import pytest
from scipy.stats import mannwhitneyu, spearmanr

from jaxgrasp.candidates import sample_grasps
from jaxgrasp.cli import main
from jaxgrasp.metrics import METRICS
from jaxgrasp.ranking import compare_metrics

# Metrics whose programs are compiled within a second.
CHEAP = "isotropy,closure_residual"


@pytest.fixture
def here(tmp_path, monkeypatch) -> Path:
    monkeypatch.chdir(tmp_path)
    grasps = sample_grasps(24)
    np.savez(
        "grasps.npz",
        positions=grasps.positions,
        outward_normals=grasps.normals,
        friction=grasps.friction,
        max_force=grasps.max_force,
        mass=grasps.mass,
        held_success=np.arange(24) % 3 > 0,
        quality=np.arange(24.0),
        shelf=np.repeat(["a", "b"], 12),
    )
    return tmp_path


def refused(capsys, *arguments: str) -> str:
    before = set(Path.cwd().iterdir())
    assert main(list(arguments)) == 2
    captured = capsys.readouterr()
    assert captured.out == "" and captured.err.count("\n") == 1
    assert set(Path.cwd().iterdir()) == before
    return captured.err


def scores(count: int = 60) -> tuple[dict[str, np.ndarray], np.ndarray]:
    random = np.random.default_rng(0)
    truth = random.normal(size=count)
    values = {
        "near": truth + 0.3 * random.normal(size=count),
        "coarse": np.round(truth),
        "other way": -truth + random.normal(size=count),
        "nothing": random.normal(size=count),
    }
    return values, truth + 0.5 * random.normal(size=count) > 0


def test_correlations_and_areas_are_scipys():
    values, success = scores()
    found = compare_metrics(values, success, smaller_is_better=frozenset(["other way"]), resamples=50)
    turned = {name: -v if name == "other way" else v for name, v in values.items()}
    np.testing.assert_allclose(found.correlation, spearmanr(np.array(list(turned.values())).T).statistic, atol=1e-12)
    for area, curve, value in zip(found.prediction.auc, found.prediction.curves, turned.values(), strict=True):
        wanted = mannwhitneyu(value[success], value[~success]).statistic / success.sum() / (~success).sum()
        np.testing.assert_allclose(area, wanted, atol=1e-12)
        np.testing.assert_allclose(np.trapezoid(curve[:, 1], curve[:, 0]), wanted, atol=1e-12)


def test_areas_within_labels_count_pairs_with_the_same_label():
    values, success = scores()
    labels = np.arange(60) % 3
    found = compare_metrics(values, success, within=labels, resamples=50)
    for area, value in zip(found.prediction.auc, values.values(), strict=True):
        won = pairs = 0.0
        for i in np.flatnonzero(success):
            for j in np.flatnonzero(~success & (labels == labels[i])):
                won, pairs = won + (value[i] > value[j]) + 0.5 * (value[i] == value[j]), pairs + 1
        np.testing.assert_allclose(area, won / pairs, atol=1e-12)


def test_intervals_cover_and_shrink():
    values, success = scores(60)
    many, outcome = scores(2000)
    few, more = (compare_metrics(v, s, resamples=400).prediction for v, s in ((values, success), (many, outcome)))
    for found in (few, more):
        assert np.all((found.interval[:, 0] <= found.auc) & (found.auc <= found.interval[:, 1]))
        np.testing.assert_allclose(found.lead[0], 0, atol=1e-12)
    width = lambda found: np.diff(found.interval, axis=1)  # noqa: E731
    assert np.all(width(more) < 0.5 * width(few))
    # Of an area A from n pairs of classes the standard error is about that of Hanley and McNeil (1982).
    area, good, bad = more.auc[0], outcome.sum(), (~outcome).sum()
    first, second = area / (2 - area), 2 * area**2 / (1 + area)
    variance = area * (1 - area) + (good - 1) * (first - area**2) + (bad - 1) * (second - area**2)
    assert 0.7 < width(more)[0, 0] / (2 * 1.96 * np.sqrt(variance / good / bad)) < 1.3


def test_a_grasp_without_an_answer_counts_as_the_worst():
    success = np.array([True, False, True, False])
    with_nan = compare_metrics({"m": np.array([3.0, 1.0, np.nan, 2.0])}, success, resamples=4)
    with_least = compare_metrics({"m": np.array([3.0, 1.0, 0.0, 2.0])}, success, resamples=4)
    assert with_nan.prediction.auc == with_least.prediction.auc == 0.5
    assert with_nan.answered == 3


def test_without_failures_there_is_nothing_to_predict():
    with pytest.raises(ValueError, match="no pair"):
        compare_metrics({"m": np.arange(4.0)}, np.ones(4, bool))


def test_rank_by_a_metric(here, capsys):
    options = ["--metric", "closure_residual,isotropy", "--metric", "ferrari_canny", "--top", "0", "--figure", "None"]
    assert main(["rank", "grasps.npz", *options]) == 0
    table = pyarrow.parquet.read_table("ranking.parquet").to_pydict()
    assert np.all(np.diff(table["closure_residual"]) >= 0)
    assert not np.all(np.diff(table["margin"]) <= 0)
    assert min(table["ferrari_canny"]) == 0 and max(table["isotropy"]) <= 1


def test_without_metrics_the_margin_ranks_as_ever(here, capsys):
    assert main(["rank", "grasps.npz", "--top", "0", "--figure", "None"]) == 0
    table = pyarrow.parquet.read_table("ranking.parquet")
    assert np.all(np.diff(table["margin"]) <= 0) and not set(METRICS) - {"margin"} & set(table.column_names)


@pytest.mark.parametrize("command", ["rank", "compare"])
def test_an_unknown_metric_is_answered_with_all_names(here, capsys, command):
    complaint = refused(capsys, command, "grasps.npz", "--metric", "isotropy,quality")
    assert "'quality'" in complaint and all(name in complaint for name in METRICS)


def test_a_metric_that_cannot_take_the_disturbances(here, capsys):
    complaint = refused(capsys, "compare", "grasps.npz", "--metric", "task_wrench", "--disturbances", "ball")
    assert "--metric task_wrench" in complaint and "DisturbanceSet.vertices" in complaint


def test_compare_writes_and_prints(here, capsys):
    options = ["--metric", CHEAP, "--columns", "quality", "--within", "shelf", "--resamples", "50"]
    assert main(["compare", "grasps.npz", *options]) == 0
    printed = capsys.readouterr().out
    assert "AUC of held_success" in printed and "written: comparison.csv, comparison.png" in printed
    assert (here / "comparison.png").read_bytes().startswith(b"\x89PNG")
    with (here / "comparison.csv").open() as stream:
        rows = list(csv.DictReader(stream))
    assert [row["metric"] for row in rows] == ["isotropy", "closure_residual", "quality"]
    for row in rows:
        assert float(row["auc_low"]) <= float(row["auc"]) <= float(row["auc_high"])
        assert float(row[row["metric"]]) == pytest.approx(1)


def test_compare_without_an_outcome(here, capsys):
    with np.load("grasps.npz") as data:
        np.savez("bare.npz", **{name: data[name] for name in data if name != "held_success"})
    assert main(["compare", "bare.npz", "--metric", CHEAP]) == 0
    assert "no ROC curves" in capsys.readouterr().out
    assert (here / "comparison.csv").read_text().startswith("metric,answered,isotropy,closure_residual")


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (["--success", "shelf"], "--success shelf"),
        (["--success", "quality"], "0 and 1"),
        (["--columns", "none"], "quality"),
        (["--within", "none"], "shelf"),
        (["--output", "table.xlsx"], "--output table.xlsx"),
        (["--resamples", "0"], "--resamples: got 0"),
        (["--friction", "-1"], "--friction: got -1.0"),
    ],
)
def test_bad_options(here, capsys, options, words):
    assert words in refused(capsys, "compare", "grasps.npz", "--metric", CHEAP, *options)


def test_compare_without_files(here, capsys):
    assert "at least one file" in refused(capsys, "compare")


@pytest.mark.parametrize("kind", ["ball", "box"])
def test_compare_takes_the_sets_that_rank_takes(here, capsys, kind):
    names = "margin,margin_13"
    options = ["--disturbances", kind, "--cone-edges", "4", "--gravity", "9.81", "--figure", "None"]
    assert main(["compare", "grasps.npz", "--metric", names, *options]) == 0
    with (here / "comparison.csv").open() as stream:
        margin, free = csv.DictReader(stream)
    assert float(free["answered"]) > 8 and float(margin["margin_13"]) > 0.8
