"""Rankings: the order, the tiles, what becomes of bad candidates, and the table in its three formats."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pyarrow.csv
import pyarrow.parquet
import pytest

import jaxgrasp as jg
from jaxgrasp.candidates import Candidates, concatenate, sample_grasps
from jaxgrasp.cli.report import _counts
from jaxgrasp.ranking import RankingInterrupted, rank, ranking_table, write_table
from jaxgrasp.ranking.rank import _Scores

GRAVITY = 9.81
# Every shape costs a compilation: tiles and tops of eight are shared by nearly all tests.
COUNT, TILE, TOP = 24, 8, 8
# The solver stops at a gap of 1e-8 of the margin's scale; tiles of other sizes may stop at other last digits.
CLOSE = {"rtol": 1e-7, "atol": 1e-7}


@pytest.fixture(scope="module")
def grasps() -> Candidates:
    return sample_grasps(COUNT)


@pytest.fixture(scope="module")
def ranking(grasps):
    return rank(grasps, gravity=GRAVITY, top=TOP, tile=TILE)


@pytest.fixture(scope="module")
def direct(grasps):
    contacts = jg.Contacts.from_normals(
        grasps.positions, grasps.outward_normals, friction=grasps.friction, max_force=grasps.max_force
    )
    load = jg.required_wrench(jnp.asarray(grasps.mass), gravity=jnp.array([0.0, 0.0, -GRAVITY]))
    return contacts, load, jg.largest_disturbance(contacts, jg.DisturbanceSet.forces(1.0), required_wrench=load)


def test_same_as_the_functions_without_tiles(ranking, direct):
    contacts, load, solution = direct
    np.testing.assert_array_equal(ranking.status, solution.status)
    np.testing.assert_allclose(ranking.margin, solution.margin, **CLOSE)
    np.testing.assert_allclose(ranking.upper_bound, solution.upper_bound, **CLOSE)
    best = jax.tree.map(lambda leaf: leaf[ranking.order[:TOP]], contacts)
    wanted = 0.75 * ranking.margin[ranking.order[:TOP]]
    assert (wanted > 0.0).all()
    tightened = jg.least_effort(best, jg.DisturbanceSet.forces(1.0), wanted, required_wrench=load[ranking.order[:TOP]])
    np.testing.assert_allclose(ranking.forces, tightened.forces, atol=1e-5)
    np.testing.assert_allclose(ranking.effort, tightened.effort, rtol=1e-6)
    np.testing.assert_allclose(ranking.object_forces, tightened.forces_in_object_frame(best), atol=1e-5)


def test_forces_bear_the_load(ranking, grasps):
    total = ranking.object_forces.sum(axis=1)
    wanted = np.outer(grasps.mass[ranking.order[:TOP]], [0.0, 0.0, GRAVITY])
    np.testing.assert_allclose(total, wanted, atol=1e-7)


def test_order_is_by_falling_margin(ranking):
    solved = ranking.status[ranking.order] == jg.Status.SOLVED
    assert solved.sum() > TOP
    assert (np.diff(ranking.margin[ranking.order][solved]) <= 0.0).all()
    assert not np.diff(solved.astype(int)).max() > 0
    np.testing.assert_array_equal(ranking.rank[ranking.order], np.arange(1, COUNT + 1))


def test_one_large_tile_gives_the_same(grasps, ranking):
    other = rank(grasps, gravity=GRAVITY, top=0)
    np.testing.assert_array_equal(other.status, ranking.status)
    np.testing.assert_allclose(other.margin, ranking.margin, **CLOSE)


def test_one_compilation_for_all_tiles_and_calls(grasps, ranking, compilations):
    before = len(compilations)
    rank(grasps.take(slice(0, 20)), gravity=5.0, top=TOP, tile=TILE)  # 20 = 8 + 8 + 4
    assert len(compilations) == before


def test_bad_candidates_come_last_and_harm_no_other(grasps, ranking):
    positions, normals = grasps.positions.copy(), np.array(grasps.normals)
    friction, max_force, mass = grasps.friction.copy(), grasps.max_force.copy(), grasps.mass.copy()
    positions[1, 0, 2] = np.nan
    positions[3, 1, 0] = np.inf
    normals[5, 2] = 0.0
    friction[7, 0] = -0.1
    max_force[9, 3] = 0.0
    max_force[11, 0] = np.nan
    mass[13] = -1.0
    mass[15] = np.nan
    mass[17] = 1e3
    bad = [1, 3, 5, 7, 9, 11, 13, 15]
    spoilt = replace(
        grasps, positions=positions, outward_normals=normals, friction=friction, max_force=max_force, mass=mass
    )
    other = rank(spoilt, gravity=GRAVITY, top=COUNT, tile=TILE)
    np.testing.assert_array_equal(np.flatnonzero(other.status == jg.Status.INVALID_INPUT), bad)
    np.testing.assert_array_equal(other.order[-len(bad) :], bad)
    assert other.status[17] == jg.Status.INFEASIBLE
    good = [row for row in range(COUNT) if row not in [*bad, 17]]
    np.testing.assert_array_equal(other.status[good], ranking.status[good])
    np.testing.assert_allclose(other.margin[good], ranking.margin[good], **CLOSE)
    answered = np.isin(other.status[other.order], [jg.Status.SOLVED])
    assert np.isfinite(other.forces[answered]).all()
    assert np.isnan(other.forces[~answered]).all()


def test_equals_stay_in_order(grasps):
    same = concatenate([grasps.take(slice(0, 4))] * 6)
    ranking = rank(same, gravity=GRAVITY, top=0, tile=TILE)
    for row in range(4):
        copies = ranking.rank[row::4]
        assert (np.diff(copies) > 0).all()


def test_absent_contacts_change_nothing(grasps, ranking):
    def wider(column, padding):
        return np.concatenate([column, np.broadcast_to(padding, (COUNT, 2, *column.shape[2:]))], axis=1)

    ragged = replace(
        grasps,
        positions=wider(grasps.positions, np.nan),
        outward_normals=wider(grasps.normals, 0.0),
        friction=wider(grasps.friction, -1.0),
        max_force=wider(grasps.max_force, 0.0),
        active=wider(grasps.active, False),
    )
    other = rank(ragged, gravity=GRAVITY, top=0, tile=TILE)
    np.testing.assert_array_equal(other.status, ranking.status)
    np.testing.assert_allclose(other.margin, ranking.margin, **CLOSE)


def test_frames_are_taken_as_they_are(grasps, ranking, direct):
    framed = replace(grasps, outward_normals=None, frames=np.asarray(direct[0].frames))
    other = rank(framed, gravity=GRAVITY, top=0, tile=TILE)
    np.testing.assert_allclose(other.margin, ranking.margin, **CLOSE)


@pytest.mark.thorough
def test_nothing_disturbs(grasps):
    ranking = rank(grasps, jg.DisturbanceSet.vertices(jnp.zeros((1, 6))), gravity=GRAVITY, top=TOP, tile=TILE)
    unbounded = ranking.status == jg.Status.UNBOUNDED
    assert unbounded.sum() > TOP
    assert (ranking.status[ranking.order[: unbounded.sum()]] == jg.Status.UNBOUNDED).all()
    assert np.isfinite(ranking.forces).all()


@pytest.mark.parametrize(("error", "stops"), [(KeyboardInterrupt(), 8), (RuntimeError("the device is gone"), 16)])
def test_what_was_ranked_before_is_kept(grasps, ranking, error, stops, tmp_path):
    def stop(done):
        if done == stops:
            raise error

    with pytest.raises(RankingInterrupted) as caught:
        rank(grasps, gravity=GRAVITY, top=TOP, tile=TILE, progress=stop)
    kept = caught.value.ranking
    assert caught.value.__cause__ is error
    assert len(kept.margin) == len(kept.candidates) == len(kept.order) == stops
    np.testing.assert_array_equal(kept.margin, ranking.margin[:stops])
    write_table(kept, tmp_path / "kept.parquet")
    assert pyarrow.parquet.read_table(tmp_path / "kept.parquet").num_rows == stops


@pytest.mark.parametrize("options", [{"share": 0.0}, {"share": 1.5}, {"share": np.nan}, {"top": -1}])
def test_bad_options(grasps, options):
    with pytest.raises(ValueError, match=next(iter(options))):
        rank(grasps, **options)


@pytest.fixture(scope="module")
def tabled(ranking):
    columns = {
        "label": np.array([f"grasp, {row}" for row in range(COUNT)]),
        "joints": np.arange(2.0 * COUNT).reshape(COUNT, 2),
        "picked": np.arange(COUNT) % 2 == 0,
        "margin": np.full(COUNT, -1.0),
        "file": np.arange(COUNT),
    }
    return replace(ranking, candidates=replace(ranking.candidates, columns=columns))


def test_table(tabled):
    table = ranking_table(tabled)
    np.testing.assert_array_equal(table["rank"], np.arange(1, COUNT + 1))
    np.testing.assert_array_equal(table["index"], tabled.order)
    np.testing.assert_array_equal(table["margin"], tabled.margin[tabled.order])
    np.testing.assert_array_equal(table["input_margin"], -1.0)
    np.testing.assert_array_equal(table["joints"], tabled.candidates.columns["joints"][tabled.order])
    assert np.isfinite(table["forces"][:TOP]).all() and np.isnan(table["forces"][TOP:]).all()


def test_parquet(tabled, tmp_path):
    write_table(tabled, tmp_path / "table.parquet")
    read = pyarrow.parquet.read_table(tmp_path / "table.parquet")
    table = ranking_table(tabled)
    assert read.column_names == list(table)
    assert read["forces"].null_count == read["effort"].null_count == COUNT - TOP
    assert str(read.schema.field("forces").type).startswith("fixed_size_list<")
    np.testing.assert_array_equal(np.array(read["forces"].to_pylist()[:TOP]), table["forces"][:TOP])
    np.testing.assert_array_equal(np.array(read["joints"].to_pylist()), table["joints"])
    assert read["status"].to_pylist() == table["status"].tolist()
    assert read["label"].to_pylist() == table["label"].tolist()


def test_csv(tabled, tmp_path):
    write_table(tabled, tmp_path / "table.csv")
    read = pyarrow.csv.read_csv(tmp_path / "table.csv")
    table = ranking_table(tabled)
    assert read.num_rows == COUNT
    np.testing.assert_array_equal(read["forces_3_z"].to_numpy()[:TOP], table["forces"][:TOP, 3, 2])
    assert read["forces_0_x"].null_count == COUNT - TOP
    np.testing.assert_array_equal(read["joints_1"].to_numpy(), table["joints"][:, 1])
    assert read["label"].to_pylist() == table["label"].tolist()


def test_npz(tabled, tmp_path):
    write_table(tabled, tmp_path / "table.npz")
    table = ranking_table(tabled)
    with np.load(tmp_path / "table.npz", allow_pickle=False) as read:
        assert set(read.files) == set(table)
        for name, column in table.items():
            np.testing.assert_array_equal(read[name], column)


def test_an_older_table_stays_where_a_new_one_fails(ranking, tmp_path, monkeypatch):
    path = tmp_path / "table.csv"
    path.write_text("old")

    def fail(*_):
        raise OSError("no space left on device")

    monkeypatch.setattr(pyarrow.csv, "CSVWriter", fail)
    with pytest.raises(OSError, match="no space"):
        write_table(ranking, path)
    assert path.read_text() == "old"
    assert list(tmp_path.iterdir()) == [path]
    with pytest.raises(ValueError, match=".xlsx"):
        write_table(ranking, tmp_path / "table.xlsx")


def test_what_is_undecided_ranks_by_its_lower_bound():
    status = [jg.Status.SOLVED, jg.Status.MAX_ITERATIONS, jg.Status.SOLVED, jg.Status.MAX_ITERATIONS]
    status += [jg.Status.ILL_CONDITIONED, jg.Status.UNBOUNDED]
    margin = np.array([0.3, 0.25, 0.2, np.nan, 0.9, np.inf])
    scores = _Scores.none(len(margin), {})
    scores.fill(slice(len(margin)), margin, margin, np.array(status))
    np.testing.assert_array_equal(scores.order(), [5, 0, 1, 2, 4, 3])
    assert scores.least_of_best(3) == 0.25
    np.testing.assert_array_equal(scores.bearable(np.arange(6)), [0.3, 0.25, 0.2, np.nan, np.nan, 0])


def test_the_summary_says_how_many_are_undecided(grasps, ranking):
    status = np.where(np.arange(COUNT) < 2, jg.Status.MAX_ITERATIONS, ranking.status)
    told = _counts(replace(ranking, status=status))
    assert "2 MAX_ITERATIONS (undecided, their margins are lower bounds)" in told
