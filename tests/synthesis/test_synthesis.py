"""Synthesis on ellipsoids, one of them a sphere, where the best grasp is known, and the command that does it."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxgrasp as jg
from jaxgrasp.candidates import read_candidates
from jaxgrasp.cli import main
from jaxgrasp.geometry import Ellipsoid
from jaxgrasp.synthesis import synthesize

# All of them are the same program with other numbers, as compiling it takes long.
SPHERE = Ellipsoid.from_semi_axes((1.0, 1.0, 1.0))
LONG = Ellipsoid.from_semi_axes((0.6, 0.5, 1.5))
STARTS, STEPS, EDGES = 32, 100, 16
# The regular tetrahedron's margin for friction 0.8 and the ball of forces and moments (1 N, 1 N m), in units of f_max.
TETRAHEDRON = 0.8827


def grasps(shape=SPHERE, **changes):
    options = {
        "disturbances": jg.DisturbanceSet.ball(1.0, 1.0),
        "friction": 0.8,
        "max_force": 1.0,
        "starts": STARTS,
        "steps": STEPS,
        "cone_edges": EDGES,
    }
    return synthesize(shape, 4, jax.random.key(3), **(options | changes))


@pytest.fixture(scope="module")
def found():
    return grasps()


def distances(positions):
    return np.linalg.norm(positions[:, :, None] - positions[:, None], axis=-1)


def test_the_best_on_a_sphere_is_the_tetrahedron(found):
    assert 0.99 * TETRAHEDRON <= found.margin[0] <= 1.002 * TETRAHEDRON
    edges = distances(found.positions)[0][np.triu_indices(4, 1)]
    np.testing.assert_allclose(edges, np.sqrt(8 / 3), rtol=0.03)
    assert (found.status == jg.Status.SOLVED).all()
    assert (np.diff(found.margin) <= 0).all() and (found.margin <= found.upper_bound + 1e-9).all()


def test_from_random_starts_to_good_grasps(found):
    assert (found.first_margin > 1e-4).mean() < 1
    assert (found.margin > 1e-4).mean() >= 0.9
    assert np.median(found.margin) >= 0.8 * found.margin[0]
    assert np.median(found.margin) > 3 * np.median(found.first_margin)


def test_contacts_are_on_the_surface(found):
    np.testing.assert_allclose(np.linalg.norm(found.positions + found.center_of_mass, axis=-1), 1, atol=1e-9)
    np.testing.assert_allclose(found.outward_normals, found.positions + found.center_of_mass, atol=1e-9)
    np.testing.assert_allclose(found.center_of_mass, 0, atol=1e-6)


def test_forces_hold_the_object(found):
    moments = np.cross(found.positions, found.forces)
    np.testing.assert_allclose(found.forces.sum(1), 0, atol=1e-6)
    np.testing.assert_allclose(moments.sum(1), 0, atol=1e-6)
    normal = np.einsum("gci,gci->gc", found.forces, found.outward_normals)
    tangential = np.linalg.norm(found.forces - normal[..., None] * found.outward_normals, axis=-1)
    assert (normal >= -1 - 1e-6).all() and (tangential <= -0.8 * normal + 1e-6).all()


def test_the_record_is_of_the_best_so_far(found):
    record = found.record
    for row in (record.lowest_tenth, record.median, record.best):
        assert row.shape == (STEPS,) and (row[1:] >= row[:-1]).all()
    assert (record.lowest_tenth <= record.median).all() and (record.median <= record.best).all()
    assert record.positive[-1] >= 0.9 and record.best[-1] == pytest.approx(found.margin[0], rel=0.05)


def test_spacing_and_span_hold_and_nothing_compiles_anew(found, compilations):
    told = []
    before = len(compilations)
    far = grasps(LONG)
    near = grasps(LONG, spacing=0.5, span=1.4, progress=lambda done, record: told.append((done, len(record.best))))
    assert len(compilations) == before
    assert told == [(done, done) for done in range(10, STEPS + 1, 10)]
    good = near.shortfall <= 2e-3 * np.linalg.norm(LONG.semi_axes)
    assert good.mean() > 0.9 and (near.margin[good] > 1e-4).mean() > 0.9
    apart = distances(near.positions[good])
    assert apart.max() <= 1.41
    beside = np.einsum("gai,gbi->gab", near.outward_normals[good], near.outward_normals[good]) > 0.01
    assert apart[beside & ~np.eye(4, dtype=bool)].min() >= 0.49
    # Without the limits the fingers go farther apart, and gain by it.
    assert distances(far.positions[:1]).max() > 1.5 and far.margin[0] > near.margin[good].max()


def test_the_same_key_gives_the_same(found):
    np.testing.assert_array_equal(grasps().positions, found.positions)


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"starts": 0}, "starts: got 0"),
        ({"steps": 0}, "steps: got 0"),
        ({"friction": 0.0}, "friction: got 0.0"),
        ({"max_force": float("inf")}, "max_force: got inf"),
        ({"spacing": -1.0}, "spacing: got -1.0"),
        ({"spacing": 2.0, "span": 1.0}, "span: got 1.0"),
        ({"cone_edges": 2}, "cone_edges: got 2"),
        ({"disturbances": jg.DisturbanceSet.ball(jnp.ones(3))}, r"disturbances: got \(3,\)"),
        ({"center_of_mass": (0.0, 0.0)}, "center_of_mass: got shape"),
    ],
)
def test_bad_arguments(changes, words):
    with pytest.raises(ValueError, match=words):
        grasps(**changes)


@pytest.fixture
def here(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    return tmp_path


def test_the_command_writes_what_rank_reads(here, capsys, compilations):
    options = ["--object", "ellipsoid", "--starts", str(STARTS), "--steps", "20", "--cone-edges", str(EDGES)]
    assert main(["synthesize", *options, "--disturbances", "ball", "--max-force", "3", "--size", "0.08"]) == 0
    printed = capsys.readouterr().out
    assert "32 grasps of ellipsoid with 4 contacts" in printed and "written: grasps.npz, synthesis.png" in printed
    assert (here / "synthesis.png").read_bytes().startswith(b"\x89PNG")
    candidates = read_candidates([here / "grasps.npz"])
    assert len(candidates) == STARTS and (candidates.max_force == 3).all() and (candidates.friction == 0.6).all()
    ellipsoid = Ellipsoid.from_semi_axes((0.024, 0.018, 0.04))
    np.testing.assert_allclose(ellipsoid.distance(jnp.asarray(candidates.positions)), 0, atol=1e-9)
    assert (candidates.columns["object_name"] == "ellipsoid").all()
    assert (np.diff(candidates.columns["synthesis_margin"]) <= 0).all()


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (["--object", "cube"], "--object: got 'cube'; wanted sphere"),
        (["--object", "none.stl"], "none.stl: got no such file"),
        (["--object", "mesh.step"], "'.step'"),
        (["--contacts", "1"], "--contacts: got 1"),
        (["--friction", "0"], "--friction: got 0"),
        (["--max-force", "nan"], "--max-force: got nan"),
        (["--span", "0.001"], "--span: got 0.001"),
        (["--seed", "-1"], "--seed: got -1"),
        (["--output", "grasps.csv"], "--output grasps.csv"),
        (["--figure", "none/figure.png"], "no such file or directory"),
        (["--disturbances", "bull"], "bull"),
    ],
)
def test_the_command_refuses_in_one_line(here, capsys, options, words):
    assert main(["synthesize", *options]) == 2
    captured = capsys.readouterr()
    assert captured.out == "" and captured.err.count("\n") == 1
    assert captured.err.startswith("jaxgrasp: ") and words in captured.err
    assert list(here.iterdir()) == []
