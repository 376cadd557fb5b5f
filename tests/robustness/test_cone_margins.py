"""Cone margins d of (1) for a grasp, a contact and a row: in every program that has them, against other solvers."""

from __future__ import annotations

import sys
from dataclasses import replace
from functools import cache, partial
from pathlib import Path

import harness
import jax
import jax.numpy as jnp
import numpy as np
import oracles
import pytest

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))

import jaxgrasp as jg  # noqa: E402
from benchmarks.suite import chain  # noqa: E402
from jaxgrasp import kernels  # noqa: E402
from jaxgrasp.robustness import grasps as grasps_room  # noqa: E402
from jaxgrasp.robustness.auditing import setting  # noqa: E402

SAME = 1e-7
"""Of max(margin, Lambda), and of max(effort, 1e-3 f_max^2)."""

CLARABEL = 1e-6
"""Of max(margin, Lambda), with second-order cones: Clarabel's own tolerance, see `test_formulations`."""

GRADIENT = 1e-5
"""Of max(1, slope)."""

EDGES = 8
PYRAMIDS = ("13", "16", "per_direction", "per_direction_prestrained")
CONES = ("12", "12_fixed")


def contacts_of(batch: chain.Batch, dtype=jnp.float64) -> jg.Contacts:
    given = (jnp.asarray(x, dtype) for x in (batch.positions, batch.frames, batch.friction, batch.max_force))
    positions, frames, friction, max_force = given
    return jg.Contacts.from_frames(positions, frames, friction=friction, max_force=max_force)


@cache
def grasps(count: int = 24, n_c: int = 3) -> tuple[chain.Batch, np.ndarray]:
    """Grasps and a cone margin for every row, (count, n_c, n_e): nothing in some rows, up to 4 % of f_max in others."""
    batch, rng = chain.sample(5, count, n_c, 6), np.random.default_rng(9)
    shares = rng.uniform(0, 0.04, (count, n_c, EDGES)) * (rng.random((count, n_c, EDGES)) < 0.7)
    return batch, shares * batch.max_force[..., None]


def solve(program: str, batch: chain.Batch, d, margin=0.1, **options):
    """The answer of a program, by the number of its equation or the name of a formulation."""
    contacts, load = contacts_of(batch), jnp.asarray(batch.load)
    vertices = jg.DisturbanceSet.vertices(jnp.asarray(batch.wrenches))
    if program == "21":
        return jg.largest_disturbance(contacts, vertices, load, cone_margin=d, **options)
    if program == "22":
        return jg.least_effort(contacts, vertices, margin, load, cone_margin=d, **options)
    if program == "11":
        return jg.least_total_effort(contacts, vertices, margin, load, cone_margin=d, **options)
    if program in ("6", "9"):
        return jg.specified_disturbances(contacts, vertices, program, load, cone_margin=d, **options)
    return jg.formulation_margin(contacts, vertices, program, load, cone_margin=d, **options)


def of_numpy(batch: chain.Batch, d: np.ndarray) -> list[oracles.Grasp]:
    """The grasps as the oracles of (21) and (22) want them."""
    given = [
        (case.positions, case.frames, case.friction, case.max_force, case.wrenches, case.load)
        for case in map(batch.case, range(len(batch)))
    ]
    names = ("positions", "frames", "friction", "max_force", "vertices", "required_wrench")
    return [
        oracles.Grasp(**dict(zip(names, one, strict=True)), cone_margin=own) for one, own in zip(given, d, strict=True)
    ]


def largest_agrees(batch: chain.Batch, d: np.ndarray) -> None:
    ours = solve("21", batch, d)
    answers = oracles.largest_disturbances(of_numpy(batch, d))
    truth, unit = (np.array([getattr(a, name) for a in answers]) for name in ("margin", "scale"))
    solved = np.array([a.status == "SOLVED" for a in answers])
    assert 0.2 < np.mean(truth > 0) < 0.8
    np.testing.assert_array_equal(np.asarray(ours.status) == jg.Status.SOLVED, solved)
    np.testing.assert_array_equal(np.asarray(ours.status) == jg.Status.INFEASIBLE, ~solved)
    # Negative margins, which prove that b cannot be borne, may be NaN where some row is not loaded at all.
    known = solved | ~np.isnan(np.asarray(ours.margin)) & ~np.isnan(truth)
    error = np.abs(np.asarray(ours.margin) - truth) / np.maximum(np.abs(truth), unit)
    assert error[known].max() <= SAME, error[known].max()


def efforts_agree(program: str, batch: chain.Batch, d: np.ndarray) -> None:
    """At seven tenths of the largest margin."""
    most = np.asarray(solve("21" if program == "22" else "13", batch, d).margin)
    held = most > 1e-3
    assert 0.2 < held.mean()
    asked = np.where(held, 0.7 * most, 0.1)
    ours = solve(program, batch, d, asked)
    np.testing.assert_array_equal(np.asarray(ours.status)[held], jg.Status.SOLVED)
    if program == "22":
        truth = [oracles.least_effort(g, m) for g, m in zip(of_numpy(batch, d), asked, strict=True)]
    else:
        cases = (batch.case(i, EDGES, d[i]) for i in range(len(batch)))
        truth = [chain.least_total_effort(case, m) for case, m in zip(cases, asked, strict=True)]
    error = np.abs(np.asarray(ours.effort) - truth) / np.maximum(truth, 1e-3 * batch.max_force.max(-1) ** 2)
    assert error[held].max() <= SAME, error[held].max()


def formulation_agrees(name: str, batch: chain.Batch, d: np.ndarray, tolerance: float) -> None:
    """d of every row, or (lanes, n_c) of every contact."""
    ours = solve(name, batch, d)
    cases = [batch.case(i, EDGES, d[i].reshape(len(d[i]), -1)) for i in range(len(batch))]
    truth, unit = np.array([chain.ORACLES[name](case) for case in cases]), np.array([case.scale for case in cases])
    known = ~np.isinf(truth)
    assert known.mean() > 0.99 and 0.2 < np.mean(truth > 0) < 0.8
    margin = np.asarray(ours.margin)
    np.testing.assert_array_equal(np.isnan(margin)[known], np.isnan(truth)[known])
    np.testing.assert_array_equal(np.asarray(ours.status) == jg.Status.INFEASIBLE, np.isnan(margin))
    error = np.abs(margin - truth) / np.maximum(truth, unit)
    assert np.nanmax(error[known]) <= tolerance, np.nanmax(error[known])


def test_a_row_in_the_largest_disturbance_and_the_least_effort() -> None:
    batch, d = grasps()
    largest_agrees(batch, d)
    efforts_agree("22", batch, d)


def test_a_row_in_a_formulation() -> None:
    formulation_agrees("13", *grasps(), SAME)


def test_one_value_a_grasp_a_contact_and_a_row_are_the_same_where_all_are_equal() -> None:
    batch, _ = grasps()
    d = 0.02 * batch.max_force.min(-1)
    for program in ("21", "16"):
        grasp, contact, row = (
            np.asarray(solve(program, batch, value).margin)
            for value in (d, np.tile(d[:, None], (1, 3)), np.tile(d[:, None, None], (1, 3, EDGES)))
        )
        assert np.mean(grasp > 0) > 0.2
        np.testing.assert_allclose(contact, grasp, rtol=1e-12, atol=1e-12)
        np.testing.assert_allclose(row, grasp, rtol=1e-12, atol=1e-12)


def one_more(values: np.ndarray, batch: tuple[int, ...]) -> jg.Contacts:
    """Some contacts, of whatever number and batch."""
    normals = np.broadcast_to(values, (*batch, *values.shape))
    return jg.Contacts.from_normals(normals, normals, friction=0.6, max_force=2.0)


def test_the_number_of_axes_decides_what_a_margin_is_for() -> None:
    """Three contacts, three edges and three grasps: lengths alone would fit everything."""
    angles = 2 * np.pi / 3 * np.arange(3)
    normals = np.stack([np.cos(angles), np.sin(angles), 0.1 * np.sin(5 * angles)], -1)
    forces, d = jg.DisturbanceSet.forces(1.0), np.random.default_rng(1).uniform(0, 0.05, (3, 3))

    def margin(batch: tuple[int, ...], d, load=None) -> jax.Array:
        return jg.largest_disturbance(one_more(normals, batch), forces, load, cone_edges=3, cone_margin=d).margin

    contact, row = margin((3,), d), margin((), d)
    assert contact.shape == (3,) and row.shape == ()
    assert abs(row - contact[0]) > 1e-4 and abs(contact[0] - contact[1]) > 1e-4
    # A contact's value in all of its rows; a mapped axis is none.
    np.testing.assert_allclose(margin((), np.tile(d[1:2].T, (1, 3))), contact[1], rtol=1e-9)
    np.testing.assert_allclose(jax.vmap(partial(margin, ()))(jnp.asarray(d)), contact, rtol=1e-9)
    # A length of one is shared, and other arguments may bring the batch.
    shape = lambda batch, *given: jax.eval_shape(partial(margin, batch), *given).shape  # noqa: E731
    assert shape((3,), d[:1]) == shape((3,), d[0]) == shape((3,), d[None]) == shape((), d, np.zeros((3, 6))) == (3,)
    assert shape((), d[0]) == shape((), d[0, 0]) == ()


def test_shapes_without_a_meaning_are_refused() -> None:
    contacts, forces = one_more(np.eye(3), (5,)), jg.DisturbanceSet.forces(1.0)
    calls = {
        "21": partial(jg.largest_disturbance, contacts, forces),
        "22": partial(jg.least_effort, contacts, forces, 0.1),
        "11": partial(jg.least_total_effort, contacts, forces),
        "9": partial(jg.specified_disturbances, contacts, forces, "9"),
        "13": partial(jg.formulation_margin, contacts, forces, "13"),
    }
    for call in calls.values():
        for shape in ((5, 4), (5, 8), (5, 3, 7), (5, 3, 8, 1), (1, 5, 3, 8)):
            with pytest.raises(ValueError, match=r"^cone_margin: got shape .*\(\*batch, 3, 8\) a row.* has 1 axes$"):
                call(cone_margin=np.zeros(shape))
    exact = {
        "12": partial(jg.formulation_margin, contacts, forces, "12"),
        "6": partial(jg.specified_disturbances, contacts, forces, "6"),
        "all": partial(jg.compare_formulations, contacts, forces),
    }
    for call in exact.values():
        with pytest.raises(ValueError, match=r"^cone_margin: .* no values for rows of exact cones"):
            call(cone_margin=np.zeros((5, 3, 8)))
    with pytest.raises(ValueError, match="cone_margin"):
        calls["21"](cone_margin=np.zeros(3))


@pytest.mark.parametrize("program", ["21", "16"])
def test_bad_values_mark_their_own_grasp_unless_the_contact_is_absent(program: str) -> None:
    batch, d = grasps()
    active = np.ones((len(batch), 3), bool)
    active[4, 1] = False
    contacts = jg.Contacts.from_frames(
        batch.positions, batch.frames, friction=batch.friction, max_force=batch.max_force, active=active
    )
    vertices = jg.DisturbanceSet.vertices(batch.wrenches)

    def found(d: np.ndarray):
        if program == "21":
            return harness.as_numpy(jg.largest_disturbance(contacts, vertices, batch.load, cone_margin=d))
        return harness.as_numpy(jg.formulation_margin(contacts, vertices, program, batch.load, cone_margin=d))

    clean, bad = found(d), d.copy()
    bad[1, 2, 3], bad[2, 0, 0], bad[3, 1, 7], bad[4, 1] = np.nan, -1e-3, np.inf, np.nan
    ours = found(bad)
    assert (ours.status[1:4] == jg.Status.INVALID_INPUT).all() and np.isnan(ours.margin[1:4]).all()
    others = np.r_[0, 4 : len(batch)]
    for name in ("margin", "status", "forces"):
        np.testing.assert_array_equal(getattr(ours, name)[others], getattr(clean, name)[others])


def test_contacts_without_friction_keep_nothing_in_reserve() -> None:
    batch, _ = grasps()
    friction, unloaded = batch.friction.copy(), ~batch.load.any(-1)
    friction[:, 1] = 0
    batch = chain.Batch(batch.positions, batch.frames, friction, batch.max_force, batch.wrenches, batch.load)
    assert unloaded.sum() > 5
    for program in ("21", "16"):
        for d, status in ((0.0, jg.Status.SOLVED), (0.01, jg.Status.INFEASIBLE)):
            found = solve(program, batch, np.tile([0, d, 0], (len(batch), 1)))
            np.testing.assert_array_equal(np.asarray(found.status)[unloaded], status)


@pytest.mark.parametrize("program", ["21", "13"])
def test_the_audit_counts_every_row(program: str, monkeypatch) -> None:
    """Answers for no margin at all where one is asked for."""
    batch, d = grasps()
    run, instead = grasps_room._run, []

    def without(function, data, options):
        instead.append(run(function, replace(data, cone_margin=jnp.zeros_like(data.cone_margin)), options))
        return instead[-1]

    right = np.asarray(solve(program, batch, d).status)
    monkeypatch.setattr(grasps_room, "_run", without)
    monkeypatch.setattr(setting, "report", lambda failed, lanes: None)
    found = np.asarray(solve(program, batch, d).status)
    claimed = np.asarray((instead[0] if program == "21" else instead[0][program])[0].status)[: len(batch)]
    wrong = (right == jg.Status.INFEASIBLE) & (claimed == jg.Status.SOLVED)
    assert wrong.sum() >= 3
    np.testing.assert_array_equal(found[wrong], jg.Status.NOT_VERIFIED)


@pytest.mark.thorough
def test_the_chain_with_a_margin_of_every_contact() -> None:
    """21 = 16 <= 13 <= 12: with the same d the pyramids lie inside the cones."""
    batch, d = grasps(200, 4)
    vertices = jg.DisturbanceSet.vertices(batch.wrenches)
    found = jg.compare_formulations(contacts_of(batch), vertices, batch.load, cone_margin=d.max(-1))
    m = {name: np.asarray(v) for name, v in found.margins.items()}
    borne, unit = np.isfinite(m["16"]), np.maximum(1, m["12"]) * SAME
    assert borne.mean() > 0.2
    np.testing.assert_array_equal(borne, m["21"] >= 0)
    assert np.all(np.abs(m["21"] - m["16"])[borne] <= unit[borne])
    for less, more in (("16", "13"), ("13", "12"), ("16", "12_fixed"), ("12_fixed", "12")):
        assert np.all((m[less] <= m[more] + unit)[borne]), (less, more)


@pytest.mark.thorough
@pytest.mark.parametrize("program", ["21", "22", "11", "16", "12"])
def test_the_strict_audit_confirms_rows_and_kernels_are_xla(program: str) -> None:
    batch, d = grasps(200, 4)
    d = d.max(-1) if program == "12" else d
    jax.clear_caches()
    with jg.audit("strict"):
        ours = harness.as_numpy(solve(program, batch, d))
        jax.clear_caches()
        with kernels.without():
            theirs = harness.as_numpy(solve(program, batch, d))
    jax.clear_caches()
    assert not np.any(ours.status == jg.Status.NOT_VERIFIED)
    np.testing.assert_array_equal(ours.status, theirs.status)
    name = "effort" if program in ("22", "11") else "margin"
    np.testing.assert_allclose(getattr(ours, name), getattr(theirs, name), rtol=SAME, atol=SAME)


@pytest.mark.thorough
def test_single_precision() -> None:
    batch, d = grasps(200, 4)
    vertices = jg.DisturbanceSet.vertices(jnp.asarray(batch.wrenches, jnp.float32))
    given = contacts_of(batch, jnp.float32), vertices
    load, single = jnp.asarray(batch.load, jnp.float32), jnp.asarray(d, jnp.float32)
    for program in ("21", "16"):
        exact = np.asarray(solve(program, batch, d).margin)
        if program == "21":
            ours = jg.largest_disturbance(*given, load, cone_margin=single)
        else:
            ours = jg.formulation_margin(*given, program, load, cone_margin=single)
        assert ours.margin.dtype == jnp.float32
        solved = (np.asarray(ours.status) == jg.Status.SOLVED) & (exact >= 0)
        unit = np.maximum(exact, [batch.case(i).scale for i in range(len(batch))])
        assert solved.sum() > 0.8 * np.sum(exact >= 0)
        assert np.max(np.abs(np.asarray(ours.margin) - exact)[solved] / unit[solved]) <= 1e-4


@pytest.mark.thorough
@pytest.mark.parametrize("n_c", [3, 5])
def test_a_row_in_21_and_22_at_full_size(n_c: int) -> None:
    batch, d = grasps(200, n_c)
    largest_agrees(batch, d)
    efforts_agree("22", batch, d)


@pytest.mark.thorough
def test_a_row_in_11_at_full_size() -> None:
    efforts_agree("11", *grasps(200, 4))


@pytest.mark.thorough
@pytest.mark.parametrize("name", PYRAMIDS)
def test_a_row_in_formulations_at_full_size(name: str) -> None:
    formulation_agrees(name, *grasps(200, 4), SAME)


@pytest.mark.thorough
@pytest.mark.parametrize("name", CONES)
def test_a_contact_in_exact_cones_at_full_size(name: str) -> None:
    batch, d = grasps(200, 4)
    formulation_agrees(name, batch, d.max(-1), CLARABEL)


@pytest.mark.thorough
def test_a_row_in_9_and_10() -> None:
    batch, d = grasps(200, 4)
    batch = chain.Batch(
        batch.positions, batch.frames, batch.friction, batch.max_force, 0.3 * batch.wrenches, batch.load
    )
    ours = solve("9", batch, d)
    truth = np.array([chain.unreduced(batch.case(i, EDGES, d[i])) for i in range(len(batch))])
    holds = np.asarray(ours.status) == jg.Status.SOLVED
    np.testing.assert_array_equal(holds, truth >= 1 - SAME)
    assert 0.1 < holds.mean() < 0.9
    forces = np.asarray(ours.forces)[holds, None]
    forces = np.concatenate([forces, forces + np.asarray(ours.changes)[holds]], 1)
    facets = np.stack([[oracles.facet_rows(mu, EDGES) for mu in each] for each in batch.friction[holds]])
    cone = np.einsum("bcea,bjca->bjce", facets, forces)
    assert np.max((cone + d[holds, None]) / batch.max_force[holds, None, :, None]) <= SAME
    # Without d some of these forces would do that do not with it.
    assert np.mean(np.asarray(solve("9", batch, None).status) == jg.Status.SOLVED) > holds.mean()


def slopes_agree(program: str, ends: list[np.ndarray], step: float, ours: np.ndarray, counted: np.ndarray) -> None:
    """Slopes along a direction against differences of values at -step, 0 and step, where there is no kink between."""
    central = (ends[2] - ends[0]) / (2 * step)
    size = np.maximum(1, np.abs(central))
    bend = np.abs(ends[0] - 2 * ends[1] + ends[2]) / step
    smooth = counted & (bend <= 1e-2 * size)
    assert smooth.sum() >= 0.8 * counted.sum() > 10
    error = np.abs(ours - central)[smooth] / size[smooth]
    assert np.abs(central[smooth]).max() > 0.1
    assert np.quantile(error, 0.9) <= GRADIENT, (program, np.quantile(error, 0.9), error.max())


@pytest.mark.thorough
@pytest.mark.parametrize("program", ["21", "22", "11", *PYRAMIDS, *CONES])
def test_slopes_are_those_of_differences(program: str) -> None:
    """Of linear programs against HiGHS, which has their vertices to rounding; of others against our own values."""
    batch, d = grasps(64, 4)
    d = d.max(-1) if program in CONES else d
    along = np.random.default_rng(2).normal(size=d.shape) * (d > 0)
    largest = np.asarray(solve("21" if program == "22" else "13" if program == "11" else program, batch, d).margin)
    counted = np.isfinite(largest) & (largest > 1e-2)
    asked = jnp.asarray(np.where(counted, 0.7 * largest, 0.1))
    field = "effort" if program in ("11", "22") else "margin"

    @partial(jax.jit, static_argnames="exact")
    def value(d, exact=True):
        # Newton's method finds central points to rounding, next to which (22)'s bounds are loose.
        options = {} if exact or program != "22" else {"smoothing": 1e-8 * batch.max_force.max(-1) ** 2}
        return jnp.where(counted, getattr(solve(program, batch, d, asked, **options), field), 0)

    ours = np.asarray(jax.grad(lambda d: value(d).sum())(jnp.asarray(d)))
    ours = np.sum((ours * along).reshape(len(batch), -1), -1)
    if program == "21":
        by_highs = lambda d: np.array([a.margin for a in oracles.largest_disturbances(of_numpy(batch, d))])  # noqa: E731
    else:
        by_highs = lambda d: np.array(  # noqa: E731
            [chain.ORACLES[program](batch.case(i, EDGES, d[i])) for i in range(len(batch))]
        )
    linear = program in ("21", *PYRAMIDS)
    # Exact margins are known to some 1e-9, which differences over less would multiply.
    step = 1e-5 if linear else 1e-4
    ends = [
        by_highs(d + sign * step * along) if linear else np.asarray(value(jnp.asarray(d + sign * step * along), False))
        for sign in (-1, 0, 1)
    ]
    slopes_agree(program, ends, step, ours, counted)


@pytest.mark.thorough
def test_slopes_of_forces_and_of_every_shape() -> None:
    """Of smoothed answers, forces included; with respect to one value a grasp, a contact and a row."""
    batch, rows = grasps(64, 4)
    kappa = 1e-3 * np.ones(len(batch))
    weights = jnp.asarray(np.random.default_rng(4).normal(size=(len(batch), 4, 3)))

    @jax.jit
    def value(d):
        found = solve("21", batch, d, smoothing=kappa)
        usable = found.status == jg.Status.SOLVED
        return jnp.where(usable, found.margin + (weights * found.forces).sum((-1, -2)), 0)

    for d in (rows.mean((-1, -2)), rows.mean(-1), rows + 1e-3):
        along = np.random.default_rng(3).normal(size=d.shape)
        ours = np.asarray(jax.grad(lambda d: value(d).sum())(jnp.asarray(d)))
        ends = [np.asarray(value(jnp.asarray(d + sign * 1e-6 * along))) for sign in (-1, 0, 1)]
        counted = (ends[0] != 0) & (ends[1] != 0) & (ends[2] != 0)
        slopes_agree("21", ends, 1e-6, np.sum((ours * along).reshape(len(batch), -1), -1), counted)


@pytest.mark.thorough
def test_margins_of_contacts_where_directions_are_refined() -> None:
    """12 >= 12_fixed, 13 >= 16 = 21 for a ball, and a grasp alone is as in a batch."""
    normals = np.array([[1, 0, 0.1], [-1, 0.1, 0], [0, 1, 0.1], [0.1, -1, -0.1], [0, 0.1, 1.0]])
    alone = jg.Contacts.from_normals(0.05 * normals, normals, friction=0.8, max_force=5.0)
    two = jg.Contacts.from_normals(
        *[np.stack([0.05 * normals] * 2), np.stack([normals] * 2)], friction=0.8, max_force=5
    )
    ball, d = jg.DisturbanceSet.ball(1.0, 0.02), np.array([0, 0.05, 0.1, 0.15, 0.2])
    m = {}
    for name in ("12", "12_fixed", "13", "16"):
        m[name] = float(jg.formulation_margin(alone, ball, name, cone_margin=d).margin)
        both = jg.formulation_margin(two, ball, name, cone_margin=np.stack([d, 0 * d])).margin
        np.testing.assert_allclose(both[0], m[name], rtol=2e-4)
        assert both[1] > 1.01 * both[0]
    row = jg.formulation_margin(alone, ball, "13", cone_margin=np.tile(d[:, None], (1, EDGES))).margin
    np.testing.assert_allclose(row, m["13"], rtol=2e-4)
    np.testing.assert_allclose(jg.largest_disturbance(alone, ball, cone_margin=d).margin, m["16"], rtol=1e-6)
    assert m["12"] > m["12_fixed"] > m["16"] and m["12"] > m["13"] > m["16"]
