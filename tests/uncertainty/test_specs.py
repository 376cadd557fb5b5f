"""What cannot be a distribution, in Python and in files, is refused in one line."""

from __future__ import annotations

import json

import jax
import numpy as np
import pytest

import jaxgrasp as jg
from jaxgrasp.storage import FileError
from jaxgrasp.uncertainty import normal, read_uncertainty, samples, uniform

GRASP = jg.Contacts.from_normals(
    [[0.03, 0, 0], [-0.03, 0, 0]], [[1.0, 0, 0], [-1.0, 0, 0]], friction=0.5, max_force=1.0
)
PUSHES = jg.DisturbanceSet.forces(1.0)


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (lambda: jg.Uncertainty.of(), "nothing"),
        (lambda: jg.Uncertainty.of(frictoin=0.1), "'frictoin'"),
        (lambda: jg.Uncertainty.of(friction=-0.1), "std"),
        (lambda: jg.Uncertainty.of(normal=10.0), "radians"),
        (lambda: normal(np.nan), "std"),
        (lambda: normal(0.1, mean=np.inf), "mean"),
        (lambda: normal(0.1, lower=0.2, upper=0.1), "lower"),
        (lambda: normal(0.1, correlation=1.5), "correlation"),
        (lambda: normal(0.1, correlation=[[1.0, 0.5], [0.4, 1.0]]), "correlation"),
        (lambda: normal(0.1, correlation=[[1.0, 0.5], [0.5, 2.0]]), "correlation"),
        (lambda: normal(0.1, correlation=[[1.0, np.nan], [np.nan, 1.0]]), "correlation"),
        (lambda: normal(0.1, correlation=[[1, 0.9, -0.9], [0.9, 1, 0.9], [-0.9, 0.9, 1]]), "eigenvalue"),
        (lambda: normal(0.1, correlation=np.ones((2, 3))), "correlation"),
        (lambda: uniform(-1.0), "half_width"),
        (lambda: samples([]), "samples"),
        (lambda: samples([0.1, np.nan]), "samples"),
        (lambda: jg.Uncertainty.of(mass=normal(0.1, correlation=0.5)), "mass"),
        (lambda: jg.Uncertainty.of(friction=samples([0.1, 0.2]), mass=samples([0.1])), "2 of friction, 1 of mass"),
    ],
)
def test_what_can_be_no_distribution_is_refused(make, words):
    with pytest.raises(ValueError, match=r"got .*wanted ") as caught:
        make()
    assert words in str(caught.value) and "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("spec", "options", "words"),
    [
        ({"friction": [0.1, 0.2, 0.3]}, {}, "friction"),
        ({"position": normal(0.1, correlation=np.eye(5))}, {}, "position"),
        ({"friction": samples(np.zeros((4, 3)))}, {}, "friction"),
        ({"friction": samples(np.zeros(4))}, {"samples": 5}, "samples"),
        ({"friction": 0.1}, {"samples": 0}, "samples"),
        ({"friction": 0.1}, {"quantiles": (1.0,)}, "quantiles"),
        ({"friction": 0.1}, {"tail": 0.0}, "tail"),
        ({"friction": 0.1}, {"at_least": 1.0}, "at_least"),
        ({"friction": 0.1}, {"forces": np.zeros((3, 3))}, "forces"),
        ({"friction": 0.1}, {"forces": np.zeros((5, 2, 3))}, "forces"),
        ({"friction": 0.1}, {"margin": np.zeros((3, 2))}, "margin"),
    ],
)
def test_what_does_not_fit_the_grasps_is_refused(spec, options, words):
    batch = jax.tree.map(lambda x: x[None].repeat(4, 0), GRASP)
    with pytest.raises(ValueError, match=r"got .*wanted |cannot be broadcast") as caught:
        jg.margin_distribution(batch, PUSHES, jg.Uncertainty.of(**spec), **options)
    assert words in str(caught.value)


def test_another_kind_of_uncertainty_is_refused():
    with pytest.raises(ValueError, match=r"^uncertainty: got dict, wanted jaxgrasp.Uncertainty$"):
        jg.margin_distribution(GRASP, PUSHES, {"friction": 0.1})


def same(a: jg.Uncertainty, b: jg.Uncertainty) -> None:
    assert jax.tree.structure(a) == jax.tree.structure(b)
    for x, y in zip(jax.tree.leaves(a), jax.tree.leaves(b), strict=True):
        np.testing.assert_allclose(x, y)


def test_files_of_both_kinds_say_the_same(tmp_path):
    written = {
        "friction": 0.1,
        "position": {"std": [0.001, 0.001, 0.002], "mean": [0, 0, 0.001], "correlation": 0.5},
        "max_force": {"half_width": 0.2},
        "mass": {"std": 0.3, "lower": -0.5, "upper": 0.5},
        "load": {"samples": [[0, 0, 1, 0, 0, 0], [0, 0, 2, 0, 0, 0]]},
    }
    (tmp_path / "a.json").write_text(json.dumps(written))
    arrays = {"friction.std": 0.1, "position.std": [0.001, 0.001, 0.002], "position.mean": [0, 0, 0.001]}
    arrays |= {"position.correlation": 0.5, "max_force.half_width": 0.2, "load": written["load"]["samples"]}
    arrays |= {"mass.std": 0.3, "mass.lower": -0.5, "mass.upper": 0.5}
    np.savez(tmp_path / "a.npz", **arrays)
    wanted = jg.Uncertainty.of(
        friction=0.1,
        position=normal([0.001, 0.001, 0.002], mean=[0, 0, 0.001], correlation=0.5),
        max_force=uniform(0.2),
        mass=normal(0.3, lower=-0.5, upper=0.5),
        load=samples(np.array(written["load"]["samples"], float)),
    )
    same(read_uncertainty(tmp_path / "a.json"), wanted)
    same(read_uncertainty(tmp_path / "a.npz"), wanted)


@pytest.mark.parametrize(
    ("content", "words"),
    [
        ("{", "no JSON"),
        ("[" * 100_000, "no JSON"),
        ("[1]", "list"),
        ("{}", "no quantity"),
        ('{"frictoin": 0.1}', "frictoin"),
        ('{"friction": {"sdt": 0.1}}', "friction.sdt"),
        ('{"friction": {"mean": 0.1}}', "exactly one of std"),
        ('{"friction": {"std": 0.1, "half_width": 0.1}}', "exactly one of std"),
        ('{"friction": {"half_width": 0.1, "upper": 1}}', "friction.upper"),
        ('{"friction": "0.1"}', "friction.std"),
        ('{"friction": [0.1, [0.2]]}', "friction.std"),
        ('{"friction": true}', "friction.std"),
        ('{"friction": null}', "friction.std"),
        ('{"friction": NaN}', "friction.std"),
        ('{"friction": -1}', "friction.std"),
        ('{"friction": {"std": 0.1, "correlation": 2}}', "friction.correlation"),
        ('{"mass": {"std": 0.1, "correlation": 0.5}}', "mass"),
        ('{"friction": {"samples": [0.1]}, "mass": {"samples": [0.1, 0.2]}}', "1 of friction, 2 of mass"),
    ],
)
def test_files_that_cannot_be_used_are_refused_in_a_line(tmp_path, content, words):
    path = tmp_path / "spec.json"
    path.write_text(content)
    with pytest.raises(FileError, match="got .*wanted ") as caught:
        read_uncertainty(path)
    assert words in str(caught.value) and str(path) in str(caught.value) and "\n" not in str(caught.value)


def test_archives_with_objects_are_refused(tmp_path):
    np.savez(tmp_path / "spec.npz", friction=np.array([{}], dtype=object))
    with pytest.raises(FileError, match="friction"):
        read_uncertainty(tmp_path / "spec.npz")
    with pytest.raises(FileError, match="absent"):
        read_uncertainty(tmp_path / "absent.json")
