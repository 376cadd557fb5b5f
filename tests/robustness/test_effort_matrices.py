"""Q and Q_0 of every kind in (11) and (22), and gradients with respect to them: against Clarabel and differences."""

from __future__ import annotations

import sys
from dataclasses import replace
from functools import partial
from pathlib import Path

import harness
import jax
import jax.numpy as jnp
import numpy as np
import oracles
import problems
import pytest

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))

import jaxgrasp as jg  # noqa: E402
from benchmarks.suite import chain  # noqa: E402

EFFORT = 1e-7
"""Of max(effort, 1e-3 of the largest entry of Q_0 times the largest f_max^2)."""

SINGLE = 1e-4
"""The same in float32."""

SLOPE = 1e-5
"""Of the slope or, where that is larger, of the median effort over the size of the input."""

CONTACTS, DIRECTIONS = 4, 6
SMALL = (3, 6)
"""Contacts and directions of quick tests, whose programs compile sooner."""

SHAPES = {
    "blocks": lambda n_c, n_d: (n_c, 3),
    "full": lambda n_c, n_d: (3 * n_c,),
    "blocks, one a direction": lambda n_c, n_d: (n_d, n_c, 3),
    "full, one a direction": lambda n_c, n_d: (n_d, 3 * n_c),
}
PAIRS = [("blocks", "full"), ("full", "blocks"), ("blocks, one a direction", "full"), ("full, one a direction", "full")]
"""Q and Q_0 of (11)."""


def matrices(rng: np.random.Generator, lanes: int, kind: str, n_c: int = CONTACTS, n_d: int = DIRECTIONS) -> np.ndarray:
    shape = SHAPES[kind](n_c, n_d)
    root = rng.normal(size=(lanes, *shape, shape[-1]))
    return root @ np.swapaxes(root, -1, -2) / shape[-1] + 0.3 * np.eye(shape[-1])


def torque_weights(rng: np.random.Generator, lanes: int) -> np.ndarray:
    """Of hands with nine joints, fewer than there are components of forces."""
    jacobian = 0.05 * rng.normal(size=(lanes, CONTACTS, 3, 9))
    limits = np.ones(9)
    return np.asarray(jg.Actuation.from_jacobian(jacobian, np.eye(9), -limits, limits).joint_torque_weights())


def compliance(Q: np.ndarray, kind: str) -> jax.Array | jg.Compliance:
    return jg.Compliance.per_direction(Q) if "direction" in kind else jnp.asarray(Q)


def least_effort_errors(batch: problems.Batch, weights: np.ndarray, dtype=jnp.float64) -> np.ndarray:
    """Errors of the efforts of (22) at half of the margin, NaN where the lane is not solved."""
    contacts, disturbances, load, reserve = harness.data_of(batch, dtype)
    margins = jg.largest_disturbance(contacts, disturbances, load, cone_margin=reserve).margin
    asked = 0.5 * np.where(margins > 0, margins, 0)
    solve = partial(jg.least_effort, required_wrench=load, cone_margin=reserve)
    ours = solve(contacts, disturbances, jnp.asarray(asked, dtype), effort_weights=jnp.asarray(weights, dtype))
    errors = np.full(len(batch), np.nan)
    status = np.asarray(ours.status)
    assert np.all((status == jg.Status.SOLVED) | ~(np.asarray(margins) > 0) | (dtype == jnp.float32))
    for lane in np.flatnonzero(status == jg.Status.SOLVED):
        there = np.asarray(batch.active[lane])
        own = weights[lane]
        own = own[there] if own.ndim == 3 else own[np.repeat(there, 3)][:, np.repeat(there, 3)]
        truth = oracles.least_effort(batch.grasp(lane, 8), asked[lane], own)
        unit = 1e-3 * np.abs(own).max() * batch.max_force[lane][there].max() ** 2
        errors[lane] = abs(float(ours.effort[lane]) - truth) / max(truth, unit)
    return errors


FAMILIES = ("around", "light load", "heavy load", "absent", "uneven", "rough", "off centre")


def grasps(
    count: int, families: tuple[str, ...] = FAMILIES, n_c: int = CONTACTS, n_d: int = 2 * DIRECTIONS
) -> problems.Batch:
    made = [problems.make_family(300 + k, count, n_c, problems.SETTINGS[f], n_d) for k, f in enumerate(families)]
    return problems.concatenate(made)


def weights_of(kind: str, lanes: int) -> np.ndarray:
    rng = np.random.default_rng(5)
    return torque_weights(rng, lanes) if kind == "torques" else matrices(rng, lanes, kind)


def small() -> tuple[problems.Batch, np.ndarray]:
    """Eight grasps with weights."""
    batch = grasps(2, ("around", "light load", "absent", "rough"), SMALL[0], 12)
    return batch, matrices(np.random.default_rng(5), 8, "full", *SMALL)


def test_full_weights_of_22_in_short():
    errors = least_effort_errors(*small())
    assert np.isfinite(errors).sum() >= 6 and np.nanmax(errors) <= EFFORT


@pytest.mark.thorough
@pytest.mark.parametrize("kind", ["blocks", "full", "torques"])
def test_22_is_clarabels(kind):
    batch = grasps(90)
    errors = least_effort_errors(batch, weights_of(kind, len(batch)))
    assert np.isfinite(errors).sum() >= 480 and np.nanmax(errors) <= EFFORT


@pytest.mark.thorough
@pytest.mark.parametrize("kind", ["full", "torques"])
def test_22_is_clarabels_in_single_precision(kind):
    batch = grasps(90)
    errors = least_effort_errors(batch, weights_of(kind, len(batch)), jnp.float32)
    assert np.isfinite(errors).sum() >= 470 and np.nanmax(errors) <= SINGLE


def total_effort(batch: chain.Batch, kind: str, Q, weights, margin, dtype=jnp.float64) -> jg.TotalEffortSolution:
    given = (batch.positions, batch.frames, batch.friction, batch.max_force, batch.wrenches, batch.load, Q, weights)
    positions, frames, friction, max_force, wrenches, load, Q, weights = (jnp.asarray(x, dtype) for x in given)
    contacts = jg.Contacts.from_frames(positions, frames, friction=friction, max_force=max_force)
    vertices = jg.DisturbanceSet.vertices(wrenches)
    return jg.least_total_effort(
        contacts, vertices, jnp.asarray(margin, dtype), load, compliance=compliance(Q, kind), effort_weights=weights
    )


def check_total_effort(count: int, kinds: tuple[str, str], dtype=jnp.float64, most: float = EFFORT) -> None:
    """Asked for some share of (13)'s margin, a tenth of the grasps for more than that."""
    batch, rng = chain.sample(704, count, CONTACTS, DIRECTIONS), np.random.default_rng(1)
    contacts = jg.Contacts.from_frames(
        batch.positions, batch.frames, friction=batch.friction, max_force=batch.max_force
    )
    largest = np.asarray(
        jg.formulation_margin(contacts, jg.DisturbanceSet.vertices(batch.wrenches), "13", batch.load).margin
    )
    margin = np.where(np.isfinite(largest), largest * rng.uniform(0.1, 1.1, count), 1.0)
    Q, weights = (matrices(rng, count, kind) for kind in kinds)
    found = total_effort(batch, kinds[0], Q, weights, margin, dtype)
    truth = np.array([chain.least_total_effort(batch.case(i), margin[i], weights[i], Q[i]) for i in range(count)])
    # At the edge of what can be had either answer will do.
    clear = ~np.isnan(truth) & ~((np.abs(margin - largest) <= 1e-3 * np.maximum(1, largest)) & (margin > 0))
    assert clear.mean() > 0.95
    status = np.asarray(found.status)
    if dtype == jnp.float64:
        np.testing.assert_array_equal((status == jg.Status.SOLVED)[clear], np.isfinite(truth)[clear])
        np.testing.assert_array_equal((status == jg.Status.INFEASIBLE)[clear], np.isinf(truth)[clear])
    solved = clear & (status == jg.Status.SOLVED) & np.isfinite(truth)
    assert solved.sum() > 0.9 * np.isfinite(truth)[clear].sum()
    agree(found, truth, weights, batch, solved, most)


def agree(found: jg.TotalEffortSolution, truth, weights, batch: chain.Batch, lanes, most: float) -> None:
    count = len(batch)
    unit = 1e-3 * np.abs(weights).reshape(count, -1).max(-1) * batch.max_force.max(-1) ** 2
    assert np.max(np.abs(np.asarray(found.effort) - truth)[lanes] / np.maximum(truth, unit)[lanes]) <= most


def small_sample() -> tuple[chain.Batch, np.ndarray, np.ndarray]:
    rng = np.random.default_rng(3)
    Q, weights = (matrices(rng, 8, kind, *SMALL) for kind in PAIRS[-1])
    return chain.sample(706, 8, *SMALL), Q, weights


def test_full_matrices_of_11_in_short():
    batch, Q, weights = small_sample()
    found = total_effort(batch, PAIRS[-1][0], Q, weights, np.full(8, 0.02))
    truth = np.array([chain.least_total_effort(batch.case(i), 0.02, weights[i], Q[i]) for i in range(8)])
    solved = np.asarray(found.status) == jg.Status.SOLVED
    assert solved.sum() >= 4
    np.testing.assert_array_equal(solved, np.isfinite(truth))
    agree(found, truth, weights, batch, solved, EFFORT)


@pytest.mark.thorough
@pytest.mark.parametrize("kinds", PAIRS)
def test_11_is_clarabels(kinds):
    check_total_effort(500, kinds)


@pytest.mark.thorough
@pytest.mark.parametrize("kinds", PAIRS)
def test_11_is_clarabels_in_single_precision(kinds):
    check_total_effort(500, kinds, jnp.float32, 1e-3)


@pytest.mark.thorough
def test_blocks_are_full_matrices():
    """Blocks, the same as full matrices and the same for every direction are one program."""
    batch, rng = chain.sample(705, 8, CONTACTS, DIRECTIONS), np.random.default_rng(2)
    Q, weights = (matrices(rng, 8, "blocks") for _ in range(2))

    def whole(blocks):
        return np.einsum("liab,ij->liajb", blocks, np.eye(CONTACTS)).reshape(8, 3 * CONTACTS, 3 * CONTACTS)

    each = np.repeat(whole(Q)[:, None], DIRECTIONS, 1)
    one = total_effort(batch, "blocks", Q, weights, 0.05)
    other = total_effort(batch, "full, one a direction", each, whole(weights), 0.05)
    np.testing.assert_array_equal(one.status, other.status)
    np.testing.assert_allclose(one.effort, other.effort, rtol=1e-7)


def spoilt(Q: np.ndarray) -> np.ndarray:
    """Not symmetric, not positive definite, not a number: lanes 1, 2 and 3."""
    Q = Q.copy()
    Q[1, ..., 0, 1] += 1.0
    Q[2, ..., 0, 0] = -1.0
    Q[3, ..., 2, 2] = np.nan
    return Q


def test_bad_matrices_are_one_grasps_own_affair():
    spoils = [False, True, True, True, False, False, False, False]
    batch, weights = small()
    contacts, disturbances, load, reserve = harness.data_of(batch)
    solve = partial(jg.least_effort, contacts, disturbances, np.full(8, 0.01), load, cone_margin=reserve)
    good, bad = (solve(effort_weights=w) for w in (weights, spoilt(weights)))
    np.testing.assert_array_equal(bad.status == jg.Status.INVALID_INPUT, spoils)
    assert np.isnan(bad.effort[1:4]).all()
    np.testing.assert_array_equal(np.delete(good.forces, [1, 2, 3], 0), np.delete(bad.forces, [1, 2, 3], 0))

    (sample, Q, weights), asked = small_sample(), np.full(8, 0.02)
    good, bad = (total_effort(sample, PAIRS[-1][0], q, weights, asked) for q in (Q, spoilt(Q)))
    np.testing.assert_array_equal(bad.status == jg.Status.INVALID_INPUT, spoils)
    np.testing.assert_array_equal(np.delete(good.effort, [1, 2, 3]), np.delete(bad.effort, [1, 2, 3]))
    weights[4] *= -1
    assert total_effort(sample, PAIRS[-1][0], Q, weights, asked).status[4] == jg.Status.INVALID_INPUT


def test_weights_of_joint_torques():
    rng = np.random.default_rng(4)
    jacobian, forces = 0.05 * rng.normal(size=(5, CONTACTS, 3, 9)), rng.normal(size=(5, CONTACTS, 3))
    actuation = jg.Actuation.from_jacobian(jacobian, np.eye(9), -np.ones(9), np.ones(9))
    squares = np.sum(np.asarray(actuation.joint_torques(forces)) ** 2, -1)
    flat = forces.reshape(5, -1)
    for lever in (np.full(5, 1e-3), np.linspace(1e-4, 1e-2, 5)):
        weights = np.asarray(actuation.joint_torque_weights(lever))
        assert weights.shape == (5, 12, 12) and np.linalg.eigvalsh(weights).min() > 0
        total = squares + np.asarray(lever) ** 2 * np.sum(flat**2, -1)
        np.testing.assert_allclose(np.einsum("lp,lpq,lq->l", flat, weights, flat), total, rtol=1e-12)
    with pytest.raises(ValueError, match="lever"):
        actuation.joint_torque_weights(np.ones(3))


# Gradients.


def check_gradients(values, xs: list[dict], step: float, kinks: float, counted: float) -> None:
    """Gradients of outputs `values(x)`, (lanes, k), against central differences along random directions of the inputs.

    An output is measured in its own size.
    """

    @jax.jit
    def pulled(x, known, size, chosen):
        total = lambda x: jnp.sum(jnp.where(known, values(x) / size, 0) * chosen)  # noqa: E731
        return jax.grad(total)(x)

    for x in xs:
        here = np.asarray(values(x))
        known, sizes, rng = np.isfinite(here), np.nan_to_num(np.abs(here)), np.random.default_rng(6)
        sizes = np.maximum(sizes, 0.1 * np.median(sizes[known]))
        found = [pulled(x, known, sizes, np.eye(here.shape[1])[k]) for k in range(here.shape[1])]
        for name in ("positions", "normals", "friction", "Q", "weights"):
            start = x[name]
            along = rng.normal(size=start.shape)
            if name in ("Q", "weights"):
                along = along + np.swapaxes(along, -1, -2)
            size = float(jnp.abs(start).max())
            # Central differences of three steps; two of them without the error of second order.
            ends = lambda h: (values({**x, name: start + sign * h * size * along}) for sign in (1, -1))  # noqa: B023, E731
            half, one, two = (
                np.subtract(*map(np.asarray, ends(h))) / (2 * h * sizes) for h in step * 2.0 ** np.arange(-1, 2)
            )
            slope, finer = (4 * one - two) / 3, (4 * half - one) / 3
            unit = np.maximum(np.abs(slope), 1)
            # Where they do not agree there is a kink between.
            smooth = known & (np.abs(slope - finer) <= kinks * unit)
            assert smooth.sum() >= counted * known.sum(), (name, smooth.sum(), known.sum())
            ours = [np.sum(np.asarray(part[name] * along).reshape(len(here), -1), -1) * size for part in found]
            errors = (np.abs(np.stack(ours, -1) - slope) / unit)[smooth]
            print(f"{name}: {np.max(errors):.1e} at most on {smooth.sum()} of {known.sum()}")
            assert np.max(errors) <= SLOPE, (name, np.max(errors), np.quantile(errors, [0.5, 0.9, 0.99]))


def inputs(batch: problems.Batch, **more: np.ndarray) -> dict[str, jax.Array]:
    normals = np.asarray(batch.frames)[..., 2]
    given = {"positions": batch.positions, "normals": normals, "friction": batch.friction, **more}
    return {name: jnp.asarray(value) for name, value in given.items()}


@pytest.mark.thorough
def test_bad_matrices_have_no_gradient_and_harm_no_neighbour():
    batch, weights = small()
    contacts, disturbances, load, reserve = harness.data_of(batch)
    sample, Q, others = small_sample()

    def least(x):
        moved = replace(contacts, friction=x["friction"])
        given = {"effort_weights": x["weights"], "cone_margin": reserve}
        return jg.least_effort(moved, disturbances, np.full(8, 0.01), load, **given).effort

    def total(x):
        moved = replace(sample, friction=x["friction"])
        return total_effort(moved, PAIRS[-1][0], x["Q"], x["weights"], np.full(8, 0.02)).effort

    cases = [(least, {"friction": contacts.friction, "weights": weights})]
    cases += [(total, {"friction": sample.friction, "weights": others, "Q": Q})]
    for value, x in cases:
        slope = jax.grad(lambda x, value=value: jnp.nansum(value(x)))
        good = slope(jax.tree.map(jnp.asarray, x))
        for name in x.keys() - {"friction"}:
            bad = slope(jax.tree.map(jnp.asarray, {**x, name: spoilt(np.asarray(x[name]))}))
            for part in x:
                assert not np.any(bad[part][1:4]), (name, part)
                np.testing.assert_array_equal(np.delete(bad[part], [1, 2, 3], 0), np.delete(good[part], [1, 2, 3], 0))


@pytest.mark.thorough
def test_gradients_of_22():
    count = 60
    batch = problems.make_family(330, count, CONTACTS, problems.SETTINGS["light load"], 12)
    rng = np.random.default_rng(7)
    contacts, disturbances, load, _ = harness.data_of(batch)
    Q = matrices(rng, count, "full")
    asked = jg.largest_disturbance(contacts, disturbances, load, compliance=Q).margin
    asked = 0.5 * jnp.where(asked > 0, asked, 0)
    cotangent = rng.normal(size=(count, CONTACTS, 3))

    @jax.jit
    def values(x):
        moved = jg.Contacts.from_normals(
            x["positions"], x["normals"], friction=x["friction"], max_force=batch.max_force, active=batch.active
        )
        options = {"compliance": x["Q"], "effort_weights": x["weights"], "smoothing": x["smoothing"]}
        found = jg.least_effort(moved, disturbances, asked, load, **options)
        return jnp.stack([found.effort, jnp.sum(found.forces * cotangent, (1, 2))], -1)

    # Smoothed: central points are found to rounding, exact efforts to 1e-8.
    xs = []
    for weights in (weights_of(kind, count) for kind in ("full", "torques")):
        smoothing = 1e-4 * np.abs(weights).max((1, 2)) * batch.max_force.max(-1) ** 2
        xs.append(inputs(batch, Q=Q, weights=weights, smoothing=smoothing))
    check_gradients(values, xs, 1e-6, 1e-4, 0.9)


@pytest.mark.thorough
@pytest.mark.parametrize("kinds", PAIRS)
def test_gradients_of_11(kinds):
    count = 60
    batch, rng = chain.sample(731, count, CONTACTS, DIRECTIONS), np.random.default_rng(8)
    contacts = jg.Contacts.from_frames(
        batch.positions, batch.frames, friction=batch.friction, max_force=batch.max_force
    )
    vertices = jg.DisturbanceSet.vertices(batch.wrenches)
    largest = np.asarray(jg.formulation_margin(contacts, vertices, "13", batch.load).margin)
    # Others' efforts jump when contacts move, since G then has another rank.
    some = np.isfinite(largest) & (largest > 1e-2)
    some &= (chain.projections(batch.positions, batch.frames) == np.eye(6)).all((1, 2))
    asked = jnp.where(some, 0.5 * largest, 0)
    Q, weights = (matrices(rng, count, kind) for kind in kinds)

    @jax.jit
    def values(x):
        moved = jg.Contacts.from_normals(
            x["positions"], x["normals"], friction=x["friction"], max_force=batch.max_force
        )
        options = {"compliance": compliance(x["Q"], kinds[0]), "effort_weights": x["weights"]}
        found = jg.least_total_effort(moved, vertices, asked, batch.load, **options)
        return jnp.where(some, found.effort, jnp.nan)[:, None]

    check_gradients(values, [inputs(batch, Q=Q, weights=weights)], 1e-4, 2e-6, 0.8)
