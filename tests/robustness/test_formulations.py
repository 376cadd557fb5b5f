"""The paper's chain of formulations: against HiGHS and Clarabel on whole programs, and against each other."""

from __future__ import annotations

import sys
from dataclasses import replace
from functools import lru_cache, partial
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))

import jaxgrasp as jg  # noqa: E402
from benchmarks.suite import chain  # noqa: E402

MARGIN_TOLERANCE = 1e-6
"""Of max(margin, Lambda)."""

SAME = 1e-7
"""Of max(margin, Lambda): formulations that are one and the same, and the order of the others."""

EFFORT_TOLERANCE = 1e-6
"""Of max(effort, 1e-3 f_max^2)."""

GRADIENT_TOLERANCE = 1e-5
"""Of max(1, slope), on nine grasps of ten: steps are as short as margins to 1e-9 allow, and some cross a kink."""

SOFT_STALLED = 0.025
"""Of soft contacts with exact cones one grasp in some hundred stalls near the tolerance; one of 48 is 2 %."""

SHAPES = ((2, 6, 250), (4, 6, 800), (5, 24, 250), (8, 64, 110))
"""n_c, n_d, grasps; the recorded ones, twice 295, come on top."""

PYRAMIDS = ("13", "16", "per_direction", "per_direction_prestrained")


def contacts_of(batch: chain.Batch, bound: float | np.ndarray = 1.0) -> jg.Contacts:
    return jg.Contacts.from_frames(
        batch.positions,
        batch.frames,
        friction=batch.friction,
        max_force=batch.max_force * bound,
        torsional_friction=batch.torsional,
    )


def margins_of(batch: chain.Batch, name: str, **options) -> jg.FormulationSolution:
    vertices = jg.DisturbanceSet.vertices(batch.wrenches)
    return jg.formulation_margin(contacts_of(batch), vertices, name, batch.load, **options)


def of_full_rank(batch: chain.Batch) -> np.ndarray:
    """Others' margins jump when contacts move, since G then has another rank."""
    return (chain.projections(batch.positions, batch.frames) == np.eye(6)).all((1, 2))


def agree(batch: chain.Batch, name: str, stalled: float = 0.0, **options) -> None:
    """Every margin is the oracle's; a share of the grasps may be stalled, and say so."""
    ours = margins_of(batch, name, **options)
    going = np.asarray(ours.status) != jg.Status.MAX_ITERATIONS
    assert np.mean(~going) <= stalled
    batch = batch[going]
    ours = jax.tree.map(lambda x: x[going], ours)
    margin, status = np.asarray(ours.margin), np.asarray(ours.status)
    oracle = partial(chain.ORACLES[name], **({"norm_bound": True} if options else {}))
    truth = np.array([oracle(batch.case(i)) for i in range(len(batch))])
    known = ~np.isinf(truth)
    assert known.mean() > 0.99
    np.testing.assert_array_equal(np.isnan(margin)[known], np.isnan(truth)[known])
    np.testing.assert_array_equal(status == jg.Status.INFEASIBLE, np.isnan(margin))
    error = np.abs(margin - truth) / np.maximum(truth, [batch.case(i).scale for i in range(len(batch))])
    assert np.nanmax(np.where(known, error, 0), initial=0) <= MARGIN_TOLERANCE
    assert np.all((np.asarray(ours.upper_bound) >= margin) | np.isnan(margin))


@lru_cache
def small() -> chain.Batch:
    return chain.sample(3, 48, 3, 6)


@lru_cache
def small_margins(name: str) -> np.ndarray:
    return np.asarray(margins_of(small(), name).margin)


def test_margins_are_those_of_whole_programs() -> None:
    agree(small(), "13")
    agree(small(), "12", force_bound="norm")


@pytest.mark.thorough
@pytest.mark.parametrize("name", list(chain.ORACLES))
@pytest.mark.parametrize("shape", SHAPES)
def test_margins_are_those_of_whole_programs_at_full_size(shape: tuple, name: str) -> None:
    n_c, n_d, count = shape
    agree(chain.sample(100 * n_c + n_d, count, n_c, n_d), name)


@pytest.mark.thorough
@pytest.mark.parametrize("name", list(chain.ORACLES))
def test_margins_of_recorded_grasps(name: str) -> None:
    batch = chain.recorded()
    if batch is None:
        pytest.skip("the recorded grasps are not here")
    agree(batch, name)


@pytest.mark.thorough
@pytest.mark.parametrize("name", ["12", "12_fixed"])
def test_margins_with_a_bound_on_the_norm(name: str) -> None:
    agree(chain.sample(8, 200, 4, 6), name, force_bound="norm")


def test_some_are_infeasible_some_rank_deficient_and_most_not() -> None:
    margin = small_margins("13")
    assert 0.1 < np.isnan(margin).mean() < 0.6
    assert (margin == 0).any() and (margin > 0.1).mean() > 0.2


def test_bad_data_of_one_grasp_stay_with_it() -> None:
    batch = small()
    contacts = contacts_of(batch)
    broken = jg.Contacts.from_frames(
        contacts.positions.at[1].set(jnp.nan), batch.frames, friction=batch.friction, max_force=batch.max_force
    )
    found = jg.formulation_margin(broken, jg.DisturbanceSet.vertices(batch.wrenches), "13", batch.load)
    assert found.status[1] == jg.Status.INVALID_INPUT and np.isnan(found.margin[1])
    np.testing.assert_array_equal(np.delete(found.margin, 1), np.delete(small_margins("13"), 1))


def test_forces_hold_and_answer() -> None:
    batch = small()
    found = margins_of(batch, "12", force_bound="norm")
    n, disturbed = len(batch), np.asarray(found.disturbed_forces)
    held = np.isfinite(np.asarray(found.margin))
    G = np.asarray(jg.grasp_map(contacts_of(batch)))
    wanted = batch.load[:, None] - np.asarray(found.margin)[:, None, None] * batch.wrenches
    np.testing.assert_allclose(np.einsum("brc,bdc->bdr", G, disturbed.reshape(n, 6, -1))[held], wanted[held], atol=1e-6)
    for forces in (disturbed, np.asarray(found.forces)[:, None]):
        slip = np.linalg.norm(forces[..., :2], axis=-1) + batch.friction[:, None] * forces[..., 2]
        size = np.linalg.norm(forces, axis=-1) - batch.max_force[:, None]
        assert slip[held].max() <= 1e-6 and size[held].max() <= 1e-6


@pytest.mark.parametrize("name", ["13", "16"])
def test_what_binds_has_no_slack(name: str) -> None:
    batch = small()
    found = jax.tree.map(np.asarray, margins_of(batch, name))
    some = np.flatnonzero(np.isfinite(found.margin) & (found.margin > 1e-3))
    direction, contact, row = found.direction[some], found.contact[some], found.row[some]
    assert len(some) > 10 and len(set(direction)) > 3 and (direction >= 0).all()
    force = found.disturbed_forces[some, direction, contact]
    mu, bound = batch.friction[some, contact], batch.max_force[some, contact]
    angle = np.pi * (2 * row + 1) / 8
    slip = np.cos(angle) * force[:, 0] + np.sin(angle) * force[:, 1] + mu * np.cos(np.pi / 8) * force[:, 2]
    assert len(set(row)) > 3
    assert np.abs(np.where(row < 8, slip, -force[:, 2] - bound)).max() <= 1e-6


@pytest.mark.thorough
def test_the_chain() -> None:
    """21 = 16 <= 13 <= 12, and per direction as trap 3 has it, with equal bounds."""
    random = chain.sample(11, 300, 4, 12)
    roots = np.eye(3) + 0.3 * np.random.default_rng(0).normal(size=(300, 4, 3, 3))
    for batch, Q in ((random, None), (random, roots @ np.swapaxes(roots, -1, -2)), (chain.recorded(), None)):
        if batch is None:
            continue
        vertices = jg.DisturbanceSet.vertices(batch.wrenches)
        found = jg.compare_formulations(contacts_of(batch), vertices, batch.load, Q)
        m = {name: np.asarray(v) for name, v in found.margins.items()}
        unit = np.maximum(1, m["12"]) * SAME
        borne = np.isfinite(m["16"])
        assert borne.mean() > 0.4
        np.testing.assert_array_equal(borne, m["21"] >= 0)
        assert np.all(np.abs(m["21"] - m["16"])[borne] <= unit[borne])
        for less, more in (("16", "13"), ("13", "12"), ("16", "12_fixed"), ("12_fixed", "12")):
            assert np.all((m[less] <= m[more] + unit)[borne]), (less, more)
        for less, more in (("16", "per_direction_prestrained"), ("per_direction_prestrained", "per_direction")):
            assert np.all((m[less] <= m[more] + unit)[borne]), (less, more)
        # An f_0 exists, so nothing else is asked of the directions.
        np.testing.assert_allclose(m["13"][borne], m["per_direction"][borne], rtol=SAME, atol=SAME)
        for name in m:
            binding = found.bindings[name]
            decided = np.isfinite(m[name]) & (m[name] > 1e-3)
            assert np.all(np.asarray(binding.contact)[decided] >= 0) and np.all(np.asarray(binding.row)[decided] >= 0)
        assert all(np.nanmin(gap) >= -1e-6 for gap in found.gaps.values())


@pytest.mark.thorough
def test_without_any_f_0_a_direction_may_still_be_withstood() -> None:
    """Trap 3: what the disturbance itself takes off the load needs no tightening forces."""
    batch = small()
    with_f_0, without = small_margins("13"), np.asarray(margins_of(batch, "per_direction").margin)
    both = np.isfinite(with_f_0)
    np.testing.assert_array_equal(with_f_0[both], without[both])
    normals = np.array([[0.0, 0, -1], [0.1, 0, -1]])
    contacts = jg.Contacts.from_normals(0.01 * normals, normals, friction=0.5, max_force=5.0)
    push, load = jg.DisturbanceSet.vertices([[0.0, 0, -2.0, 0, 0, 0]]), [0.0, 0, -1.0, 0, 0, 0]
    # Fingers from below cannot pull; a lift of half the disturbance takes the load, and more pushes onto them.
    shared = jg.formulation_margin(contacts, push, "13", load)
    assert shared.status == jg.Status.INFEASIBLE
    alone = jg.formulation_margin(contacts, push, "per_direction", load)
    assert alone.status == jg.Status.SOLVED and alone.margin > 0.5


def test_nine_implies_six_with_the_bound_that_trap_4_asks_for() -> None:
    batch = small()
    vertices = jg.DisturbanceSet.vertices(0.1 * batch.wrenches)
    smaller = jg.Contacts.from_frames(
        batch.positions,
        batch.frames,
        friction=batch.friction,
        max_force=batch.max_force / np.sqrt(1 + batch.friction**2),
    )
    nine = jg.specified_disturbances(smaller, vertices, "9", batch.load)
    six = jg.specified_disturbances(contacts_of(batch), vertices, "6", batch.load)
    held = np.asarray(nine.status) == jg.Status.SOLVED
    assert held.mean() > 0.15 and np.all(np.asarray(six.status)[held] == jg.Status.SOLVED)
    # And the forces of (9) are forces of (6).
    forces = np.concatenate([np.asarray(nine.forces)[:, None], nine.forces[:, None] + nine.changes], 1)[held]
    assert np.all(np.linalg.norm(forces, axis=-1) <= batch.max_force[held][:, None] + 1e-7)
    G = np.asarray(jg.grasp_map(contacts_of(batch)))[held]
    np.testing.assert_allclose(
        np.einsum("brc,bdc->bdr", G, np.asarray(nine.changes)[held].reshape(len(G), 6, -1)),
        -0.1 * batch.wrenches[held],
        atol=1e-6,
    )
    six_forces = np.asarray(six.forces)[np.asarray(six.status) == jg.Status.SOLVED]
    assert np.isfinite(six_forces).all()


@pytest.mark.thorough
def test_pyramids_tend_to_cones_with_the_square_of_their_edges() -> None:
    batch = chain.sample(21, 120, 4, 6)
    limit = np.asarray(margins_of(batch, "12").margin)
    some = np.isfinite(limit) & (limit > 0.1)
    worst = []
    for edges in (8, 16, 32):
        margin = np.asarray(margins_of(batch, "13", cone_edges=edges).margin)
        assert np.all(margin[some] <= limit[some] + SAME)
        worst.append(np.median(1 - margin[some] / limit[some]))
    assert 3 < worst[0] / worst[1] < 5.5 and 3 < worst[1] / worst[2] < 5.5


def soft(batch: chain.Batch) -> chain.Batch:
    """The same grasps with fingertips of millimetres and centimetres, some of them hard."""
    rng = np.random.default_rng(8)
    gamma = np.exp(rng.uniform(np.log(0.001), np.log(0.02), batch.friction.shape))
    return replace(batch, torsional=gamma * (rng.uniform(size=gamma.shape) < 0.8))


@pytest.mark.parametrize(
    ("name", "norm"),
    [("12", False), *[pytest.param(n, False, marks=pytest.mark.thorough) for n in chain.ORACLES if n != "12"]]
    + [
        pytest.param("12", True, marks=pytest.mark.thorough),
        pytest.param("12_fixed", True, marks=pytest.mark.thorough),
    ],
)
def test_margins_of_soft_contacts(name: str, norm: bool) -> None:
    agree(soft(small()), name, SOFT_STALLED, **({"force_bound": "norm"} if norm else {}))


@pytest.mark.thorough
@pytest.mark.parametrize("shape", SHAPES[:3])
def test_margins_of_soft_contacts_at_full_size(shape: tuple) -> None:
    n_c, n_d, count = shape
    for name in ("12", "12_fixed"):
        agree(soft(chain.sample(100 + n_c, count, n_c, n_d)), name, SOFT_STALLED)


@pytest.mark.thorough
def test_the_chain_of_soft_contacts() -> None:
    batch = soft(small())
    found = jg.compare_formulations(contacts_of(batch), jg.DisturbanceSet.vertices(batch.wrenches), batch.load)
    for more, less in (("12", "13"), ("12_fixed", "16"), ("13", "16"), ("12", "12_fixed")):
        upper, lower = np.asarray(found.margins[more]), np.asarray(found.margins[less])
        both = np.isfinite(upper) & np.isfinite(lower)
        assert np.all((lower <= upper + SAME * np.maximum(1, upper))[both])
    held = np.asarray(found.margins["16"]) > 0
    error = np.abs(np.asarray(found.margins["21"]) - np.asarray(found.margins["16"]))[held]
    assert held.sum() > 10 and np.all(error <= SAME * np.maximum(1, np.asarray(found.margins["16"])[held]))
    # Moments come with their forces, and cones hold for both.
    solution = margins_of(batch, "12")
    assert solution.moments is not None and solution.disturbed_moments is not None
    moved = np.asarray(solution.disturbed_forces)
    reached = np.hypot(np.hypot(moved[..., 0], moved[..., 1]) / batch.friction[:, None], 0)
    turned = np.asarray(solution.disturbed_moments) / np.where(batch.torsional > 0, batch.torsional, 1)[:, None]
    solved = np.asarray(solution.status) == jg.Status.SOLVED
    assert np.all((np.hypot(reached, turned) <= -moved[..., 2] + 1e-6)[solved])
    assert not np.any(np.asarray(solution.moments)[solved] * (batch.torsional[solved] == 0))


@pytest.mark.thorough
def test_least_total_effort_of_soft_contacts() -> None:
    batch = soft(small())
    efforts_agree(batch, np.asarray(margins_of(batch, "13").margin))


def effort(margin, batch: chain.Batch) -> jg.TotalEffortSolution:
    vertices = jg.DisturbanceSet.vertices(batch.wrenches)
    return jg.least_total_effort(contacts_of(batch), vertices, margin, batch.load)


def efforts_agree(batch: chain.Batch, most: np.ndarray) -> None:
    """Asked for some share of (13)'s margin, a tenth of the grasps for more than that."""
    margin = np.where(np.isfinite(most), most * np.random.default_rng(0).uniform(0.1, 1.1, len(batch)), 1.0)
    found = effort(margin, batch)
    truth = np.array([chain.least_total_effort(batch.case(i), margin[i]) for i in range(len(batch))])
    # At the edge of what can be had either answer will do; nothing is always to be had.
    edge = (np.abs(margin - most) <= 1e-4 * np.maximum(1, most)) & (margin > 0)
    status = np.asarray(found.status)
    clear = ~np.isnan(truth) & ~edge
    assert clear.mean() > 0.9
    # Grasps with hardly any margin leave no room inside the rows.
    clear &= status != jg.Status.MAX_ITERATIONS
    assert clear.mean() > 0.9 and np.mean(status == jg.Status.MAX_ITERATIONS) <= 0.005
    np.testing.assert_array_equal(status[clear] == jg.Status.INFEASIBLE, np.isinf(truth[clear]))
    np.testing.assert_array_equal(status[clear] == jg.Status.SOLVED, np.isfinite(truth[clear]))
    error = np.abs(np.asarray(found.effort) - truth) / np.maximum(truth, 1e-3 * batch.max_force.max(-1) ** 2)
    assert np.max(error[clear & np.isfinite(truth)]) <= EFFORT_TOLERANCE


@pytest.mark.thorough
@pytest.mark.parametrize("shape", SHAPES)
def test_least_total_effort_is_clarabels(shape: tuple) -> None:
    n_c, n_d, count = shape
    batch = chain.sample(100 * n_c + n_d, count, n_c, n_d)
    efforts_agree(batch, np.asarray(margins_of(batch, "13").margin))


@pytest.mark.thorough
def test_least_total_effort_of_recorded_grasps() -> None:
    batch = chain.recorded()
    if batch is None:
        pytest.skip("the recorded grasps are not here")
    efforts_agree(batch, np.asarray(margins_of(batch, "13").margin))


@pytest.mark.thorough
@pytest.mark.parametrize("name", ["12", "13", "16", "12_fixed", "per_direction_prestrained"])
def test_gradients_are_central_differences(name: str) -> None:
    batch = chain.sample(31, 64, 4, 6)
    data = tuple(map(jnp.asarray, (batch.positions, batch.friction, batch.max_force, batch.wrenches, batch.load)))

    @jax.jit
    def margin(positions, friction, max_force, wrenches, load):
        contacts = jg.Contacts.from_frames(positions, batch.frames, friction=friction, max_force=max_force)
        return jg.formulation_margin(contacts, jg.DisturbanceSet.vertices(wrenches), name, load).margin

    at = np.asarray(margin(*data))
    some = jnp.asarray(np.isfinite(at) & (at > 1e-2) & of_full_rank(batch))
    assert np.asarray(some).mean() > 0.3
    total = lambda *data: jnp.where(some, margin(*data), 0).sum()  # noqa: E731
    gradients = jax.grad(total, argnums=tuple(range(5)))(*data)
    rng = np.random.default_rng(0)
    step = 1e-6
    for k in range(len(data)):
        along = jnp.asarray(rng.normal(size=data[k].shape))
        ends = [margin(*data[:k], data[k] + sign * step * along, *data[k + 1 :]) for sign in (1, 0, -1)]
        central = np.asarray(ends[0] - ends[2]) / (2 * step)
        # Where both sides of the step have the same slope there is no kink in between.
        bend = np.abs(np.asarray(ends[0] - 2 * ends[1] + ends[2])) / step
        ours = np.asarray(jnp.sum((gradients[k] * along).reshape(len(batch), -1), -1))
        size = np.maximum(1, np.abs(central))
        smooth = np.asarray(some) & (bend <= 1e-2 * size)
        assert smooth.sum() >= 0.8 * np.asarray(some).sum()
        assert np.quantile(np.abs(ours - central)[smooth] / size[smooth], 0.9) <= GRADIENT_TOLERANCE


@pytest.mark.thorough
def test_gradient_of_the_total_effort() -> None:
    batch = chain.sample(41, 64, 3, 6)
    most = np.asarray(margins_of(batch, "13").margin)
    some = jnp.asarray(np.isfinite(most) & (most > 1e-2) & of_full_rank(batch))
    wanted = jnp.where(some, 0.7 * most, 0)
    data = tuple(map(jnp.asarray, (batch.positions, batch.friction, wanted, batch.load)))

    @jax.jit
    def least(positions, friction, margin, load):
        contacts = jg.Contacts.from_frames(positions, batch.frames, friction=friction, max_force=batch.max_force)
        vertices = jg.DisturbanceSet.vertices(batch.wrenches)
        return jnp.where(some, jg.least_total_effort(contacts, vertices, margin, load).effort, 0)

    gradients = jax.grad(lambda *data: least(*data).sum(), argnums=(0, 1, 2, 3))(*data)
    rng = np.random.default_rng(0)
    step = 1e-6
    for k in range(len(data)):
        along = jnp.asarray(rng.normal(size=data[k].shape))
        ends = [least(*data[:k], data[k] + sign * step * along, *data[k + 1 :]) for sign in (1, -1)]
        central = np.asarray(ends[0] - ends[1]) / (2 * step)
        ours = np.asarray(jnp.sum((gradients[k] * along).reshape(len(batch), -1), -1))
        error = np.abs(ours - central)[np.asarray(some)] / np.maximum(1, np.abs(central)[np.asarray(some)])
        assert np.quantile(error, 0.9) <= GRADIENT_TOLERANCE


def test_wrong_arguments_are_named() -> None:
    contacts = contacts_of(small())
    forces = jg.DisturbanceSet.forces(1.0)
    with pytest.raises(ValueError, match="formulation: got '14'"):
        jg.formulation_margin(contacts, forces, "14")
    with pytest.raises(ValueError, match="force_bound"):
        jg.formulation_margin(contacts, forces, "13", force_bound="norm")
    with pytest.raises(ValueError, match="not given by vertices"):
        jg.least_total_effort(contacts, forces + forces)
    with pytest.raises(ValueError, match="equation"):
        jg.specified_disturbances(contacts, forces, "10")
    with pytest.raises(ValueError, match="compliance"):
        jg.least_total_effort(contacts, forces, compliance=jnp.eye(8))
    with pytest.raises(ValueError, match="effort_weights: got shape"):
        jg.least_total_effort(contacts, forces, effort_weights=jnp.eye(8))


@pytest.mark.thorough
def test_batches_of_any_shape() -> None:
    batch = small()
    vertices = jg.DisturbanceSet.forces(1.0)
    contacts = contacts_of(batch)
    flat = jg.formulation_margin(contacts, vertices, "16", batch.load)
    shaped = jax.tree.map(lambda x: x.reshape(2, 3, 8, *x.shape[1:]), contacts)
    found = jg.formulation_margin(shaped, vertices, "16", batch.load.reshape(2, 3, 8, 6))
    assert found.disturbed_forces.shape == (2, 3, 8, 6, 3, 3)
    np.testing.assert_allclose(found.margin.reshape(-1), flat.margin, rtol=1e-9)
    mapped = jax.vmap(lambda c, b: jg.formulation_margin(c, vertices, "16", b).margin)(
        contacts, jnp.asarray(batch.load)
    )
    np.testing.assert_allclose(mapped, flat.margin, rtol=1e-9)
    one = jg.formulation_margin(jax.tree.map(lambda x: x[4], contacts), vertices, "16", batch.load[4])
    np.testing.assert_allclose(one.margin, flat.margin[4], rtol=1e-9)
