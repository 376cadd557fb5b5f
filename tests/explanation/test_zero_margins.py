"""The summary of a ranking says why margins are zero, prints no minus zero and counts the metrics' time."""

from __future__ import annotations

import re
import time

import jax
import numpy as np
import pytest

import jaxgrasp as jg
import jaxgrasp.explanation
import jaxgrasp.ranking
from jaxgrasp.candidates import sample_grasps
from jaxgrasp.cli import main
from jaxgrasp.cli.report import Clock
from jaxgrasp.explanation import why_zero
from jaxgrasp.solvers.status import Status

FORCES, BOX = jg.DisturbanceSet.forces(1.0), jg.DisturbanceSet.box(np.array([1, 1, 1, 0.02, 0.02, 0.02]))
X = np.array([1.0, 0.0, 0.0])
# Four contacts each: around a cube; two fingers; three beside each other on one face; one finger; a line along x.
CUBE = np.array([X, -X, [0, 1, 0], [0, -1, 0]])
ABOVE = np.array([[0.02, 0, 0.03], [-0.02, 0.01, 0.03], [0, -0.02, 0.03], [0.01, 0.01, 0.03]])
GRASPS = {
    "around": (0.03 * CUBE, CUBE, 0.6, [1, 1, 1, 1]),
    "slippery": (0.03 * CUBE, CUBE, [0.6, 0.0, 0.0, 0.0], [1, 1, 1, 1]),
    "one of four slippery": (0.03 * CUBE, CUBE, [0.6, 0.6, 0.6, 0.0], [1, 1, 1, 1]),
    "smooth": (0.03 * CUBE, CUBE, 0.0, [1, 1, 1, 1]),
    "two": (0.03 * CUBE, CUBE, 0.6, [1, 1, 0, 0]),
    "one": (0.03 * CUBE, CUBE, 0.6, [1, 0, 0, 0]),
    "none": (0.03 * CUBE, CUBE, 0.6, [0, 0, 0, 0]),
    "above": (ABOVE, np.tile([0, 0, 1.0], (4, 1)), 0.6, [1, 1, 1, 1]),
    "two that slip": (0.03 * CUBE, np.array([X, X, X, X]), 0.6, [1, 1, 0, 0]),
}


@pytest.mark.parametrize(
    ("disturbances", "name", "reason"),
    [
        (BOX, "none", "without contacts"),
        (BOX, "one", "on one line"),
        (BOX, "two", "on one line"),
        (FORCES, "two that slip", "without force closure"),
        (BOX, "above", "without force closure"),
        (BOX, "smooth", "without friction"),
        (BOX, "slippery", "with contacts without friction"),
        # Whoever says that this one has no margin has a load or actuators.
        (BOX, "around", "leave no force to spare"),
        (BOX, "one of four slippery", "leave no force to spare"),
        (FORCES, "two", "leave no force to spare"),
    ],
)
def test_reasons_of_zeros(disturbances, name, reason):
    contacts = stacked([name] * 3 + ["around"])
    (line,) = why_zero(some(contacts), np.array([True, True, True, False]), disturbances)
    assert line.startswith("3 ") and reason in line


def stacked(names: list[str]) -> jg.Contacts:
    positions, normals, friction, active = zip(*(GRASPS[name] for name in names), strict=True)
    friction = [np.broadcast_to(mu, 4) for mu in friction]
    return jg.Contacts.from_normals(
        np.array(positions), np.array(normals), friction=np.array(friction), max_force=5.0, active=np.array(active) > 0
    )


def some(contacts: jg.Contacts):
    return lambda rows: jax.tree.map(lambda leaf: leaf[rows], contacts)


def test_margins_are_zero_for_the_reasons_told():
    names = ["two", "one", "above", "smooth", "around", "slippery", "one of four slippery"]
    contacts = stacked(names)
    found = jg.largest_disturbance(contacts, BOX)
    zero = jaxgrasp.explanation.is_zero(np.asarray(found.margin), np.asarray(found.status))
    np.testing.assert_array_equal(zero, [True, True, True, True, False, True, False])
    lines = why_zero(some(contacts), zero, BOX)
    assert [line.split()[0] for line in lines] == ["2", "1", "1", "1"] and "on one line" in lines[0]
    assert why_zero(some(contacts), np.zeros(7, bool), BOX) == []


def test_of_many_zeros_a_part_is_looked_at():
    asked = []

    def contacts_of(rows: np.ndarray) -> jg.Contacts:
        asked.append(len(rows))
        return stacked(["above"] * len(rows))

    (line,) = why_zero(contacts_of, np.ones(2500, bool), BOX)
    assert "834 of 834 looked at" in line and asked == [1024]


def two_fingers(path, count: int = 24) -> None:
    normals = sample_grasps(count, seed=1).normals[:, :1]
    normals = np.concatenate([normals, -normals], 1)
    np.savez(path, positions=0.03 * normals, outward_normals=normals, friction=0.6, max_force=5.0)


def test_the_summary_says_why_and_counts_the_metrics(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    two_fingers("two.npz")
    score = jaxgrasp.ranking.score

    def slowly(*given, **options):
        time.sleep(1.5)
        return score(*given, **options)

    monkeypatch.setattr(jaxgrasp.ranking, "score", slowly)
    metrics = "smallest_singular_value,isotropy,closure_residual"
    options = ["--disturbances", "box", "--metric", metrics, "--output", "t.csv", "--figure", "None"]
    assert main(["rank", "two.npz", *options]) == 0
    printed = capsys.readouterr().out
    assert f"24 {Status.SOLVED.name} (0 with a margin above zero)" in printed
    assert "a margin of zero: 24 with contacts on one line" in printed
    assert "smallest_singular_value: 0 for all" in printed
    assert re.search(r"(?<![\w.])-0(?![.\d])", printed + (tmp_path / "t.csv").read_text()) is None
    whole, part = map(float, re.findall(r"([\d.]+) s", printed))
    assert part >= 4.5 and whole >= part and "for metrics" in printed


def test_a_clock_counts_all_its_laps():
    clock = Clock()
    time.sleep(0.02)
    clock.lap()
    clock.lap("metrics")
    clock.tick(5)
    time.sleep(0.1)
    clock.lap()
    assert clock.end - clock.start >= 0.12 and 0 <= clock.parts["metrics"] < 0.1
    assert str(clock).startswith("5 candidates in 0.") and "a second once" not in str(clock)


def test_the_command_line_takes_the_edges_of_the_largest_ball(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    normals = np.random.default_rng(4).normal(size=(3, 5, 3))
    normals /= np.linalg.norm(normals, axis=-1, keepdims=True)
    fields = {"positions": 0.03 * normals, "outward_normals": normals, "friction": 0.8, "max_force": 5.0}
    np.savez("three.npz", **fields, active=np.arange(5) < np.full((3, 1), 3))
    options = ["--metric", "ferrari_canny_linf", "--top", "0", "--output", "t.npz", "--figure", "None"]
    found = {}
    for edges in (3, 4):
        assert main(["rank", "three.npz", *options, "--cone-edges", str(edges)]) == 0
        with np.load("t.npz") as table:
            found[edges] = table["ferrari_canny_linf"][np.argsort(table["index"])]
        space = jg.metrics.WrenchSpace(cone_edges=edges)
        for row in range(3):
            one = jg.Contacts.from_normals(0.03 * normals[row, :3], normals[row, :3], friction=0.8, max_force=5.0)
            assert found[edges][row] == pytest.approx(float(jg.metrics.ferrari_canny(one, "Linf", space)), rel=1e-9)
    assert not np.allclose(found[3], found[4])
