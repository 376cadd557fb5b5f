"""What derivatives do at the edges: grasps without an answer, kinks, nesting, second order, single precision."""

from __future__ import annotations

import itertools

import jax
import jax.numpy as jnp
import numpy as np
import problems
import pytest

import jaxgrasp as jg

QUICK = {"xla_backend_optimization_level": 0}
"""For programs that run once."""
FORCES = jg.DisturbanceSet.forces(1.0)


def ball_grasps(lanes: int, contacts: int = 4, seed: int = 3) -> np.ndarray:
    return 0.04 * problems.unit_vectors(np.random.default_rng(seed), lanes, contacts)


def contacts_on_ball(positions, friction=0.8) -> jg.Contacts:
    return jg.Contacts.from_normals(positions, positions, friction=friction, max_force=5.0)


def reserved_margin(positions) -> jax.Array:
    return jg.largest_disturbance(contacts_on_ball(positions), FORCES, cone_margin=0.05).margin


@pytest.fixture(scope="module")
def gradient():
    return jax.jit(jax.grad(lambda positions: jnp.sum(jnp.nan_to_num(reserved_margin(positions), posinf=0.0))))


def test_grasps_without_an_answer_have_no_gradient_and_harm_no_neighbour(gradient):
    positions = ball_grasps(8)
    broken = positions.copy()
    broken[0, 0] = np.nan
    broken[2, 1] = 0.0  # no normal
    broken[4, :, 2] = np.inf
    clean, spoilt = np.asarray(gradient(positions)), np.asarray(gradient(broken))
    assert np.all(spoilt[[0, 2, 4]] == 0)
    assert np.array_equal(spoilt[[1, 3, 5, 6, 7]], clean[[1, 3, 5, 6, 7]])
    assert np.all(np.abs(clean).max((1, 2)) > 0)


def test_mapped_gradients_are_those_of_the_batch(gradient):
    positions = jnp.asarray(ball_grasps(8))
    one = jax.grad(reserved_margin)
    nested = jax.jit(jax.vmap(jax.vmap(one)))(positions.reshape(2, 4, 4, 3))
    np.testing.assert_allclose(nested.reshape(8, 4, 3), gradient(positions), rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("name", ["13", "16", "per_direction", "total effort"])
def test_formulations_vary_forwards_as_backwards(name):
    positions, along = jnp.asarray(ball_grasps(5)), jnp.asarray(ball_grasps(5, seed=4))

    def value(positions):
        contacts = contacts_on_ball(positions)
        if name == "total effort":
            return jg.least_total_effort(contacts, FORCES, 0.5, cone_edges=4).effort
        return jg.formulation_margin(contacts, FORCES, name, cone_edges=4).margin

    forwards = jax.jit(lambda p: jax.jvp(value, (p,), (along,))[1], compiler_options=QUICK)(positions)
    backwards = jax.jit(jax.grad(lambda p: jnp.nansum(value(p))), compiler_options=QUICK)(positions)
    assert np.count_nonzero(forwards) >= 3
    np.testing.assert_allclose(forwards, jnp.sum(backwards * along, (1, 2)), rtol=1e-9)


def test_kinks_have_valid_subgradients(gradient):
    corners = np.array([[1, 1, 1], [1, -1, -1], [-1, 1, -1], [-1, -1, 1]]) / np.sqrt(3)
    rng = np.random.default_rng(8)
    signs = np.array(list(itertools.product([1, -1], repeat=3)))
    positions = 0.04 * corners * signs[:, None]
    value = jax.jit(reserved_margin)
    found, step = np.asarray(gradient(positions)), 1e-7
    kinks = 0
    for _ in range(20):
        direction = rng.normal(size=positions.shape)
        right = np.asarray(value(positions + step * direction) - value(positions)) / step
        left = np.asarray(value(positions) - value(positions - step * direction)) / step
        slope, slack = np.sum(found * direction, (1, 2)), 1e-2 * (np.abs(left) + np.abs(right) + 1)
        assert np.all(slope >= np.minimum(left, right) - slack)
        assert np.all(slope <= np.maximum(left, right) + slack)
        kinks += np.sum(np.abs(left - right) > slack)
    assert kinks > 20


@pytest.mark.thorough
def test_hessians_are_symmetric_and_right():
    positions = jnp.asarray(ball_grasps(1, 3, seed=5)[0])

    def smooth(positions):
        wide = jg.DisturbanceSet.ball(1.0)
        solution = jg.largest_disturbance(contacts_on_ball(positions), wide, cone_margin=0.05, smoothing=0.01)
        return solution.margin + 0.1 * solution.effort

    first = jax.grad(smooth)
    hessian = np.asarray(jax.jit(jax.jacfwd(first), compiler_options=QUICK)(positions)).reshape(9, 9)
    size = np.abs(hessian).max()
    assert np.abs(hessian - hessian.T).max() <= 1e-8 * size
    slope = jax.jit(first, compiler_options=QUICK)
    for i in range(9):
        change = 1e-7 * jnp.eye(9)[i].reshape(3, 3)
        difference = np.asarray(slope(positions + change) - slope(positions - change)).ravel() / 2e-7
        assert np.abs(difference - hessian[i]).max() <= 1e-5 * size


def test_blocking_forces_and_worst_case():
    rng = np.random.default_rng(4)
    positions, normals = ball_grasps(8), problems.unit_vectors(rng, 8, 4)
    wrenches, friction = rng.normal(size=(8, 3, 6)), rng.uniform(0.3, 1.0, (8, 4))
    root = rng.normal(size=(8, 3, 4, 3, 3))
    compliance = root @ np.swapaxes(root, -1, -2) + np.eye(3)
    x = tuple(map(jnp.asarray, (positions, normals, wrenches, friction, compliance)))

    @jax.jit
    def answers(positions, normals, wrenches, friction, compliance):
        grasps = jg.Contacts.from_normals(positions, normals, friction=friction, max_force=5.0)
        every = jg.Compliance.per_direction(compliance)
        cone, bound = jg.worst_case(grasps, jg.DisturbanceSet.vertices(wrenches), every)
        return jg.blocking_forces(grasps, wrenches, every), cone, bound

    weights = tuple(jnp.asarray(rng.normal(size=a.shape)) for a in answers(*x))
    total = lambda *x: sum(jnp.sum(a * w) for a, w in zip(answers(*x), weights, strict=True))  # noqa: E731
    found = jax.jit(jax.grad(total, argnums=range(5)))(*x)
    for i, entry in enumerate(x):
        direction = rng.normal(size=entry.shape)
        direction = direction + np.swapaxes(direction, -1, -2) if i == 4 else direction
        step = 1e-6 * float(jnp.abs(entry).max())
        sides = [total(*x[:i], entry + sign * step * direction, *x[i + 1 :]) for sign in (1, -1)]
        difference = (sides[0] - sides[1]) / (2 * step)
        assert abs(np.sum(found[i] * direction) - difference) <= 1e-5 * abs(difference)


@pytest.mark.thorough
def test_smoothed_sets_bound_the_sets():
    rng = np.random.default_rng(2)
    directions = rng.normal(size=(50, 6))
    vertices = np.concatenate([rng.normal(size=(20, 6)), np.zeros((5, 6))])
    sets = {
        np.log(21): jg.DisturbanceSet.vertices(vertices),
        6.0: jg.DisturbanceSet.box(rng.uniform(0.1, 1, 6)),
        1.0: jg.DisturbanceSet.ellipsoid(rng.normal(size=(6, 6))),
        2.0: jg.DisturbanceSet.ball(1.0, 0.5),
    }
    for most, exact in sets.items():
        over = np.asarray(exact.smoothed(0.1).support(directions) - exact.support(directions))
        assert over.min() >= -1e-12 and over.max() <= 0.1 * most * (1 + 1e-12)
        # Far from edges nothing is left of it.
        assert np.median(np.asarray(exact.smoothed(1e-4).support(directions) - exact.support(directions))) < 1e-6
    ours = jg.largest_disturbance(contacts_on_ball(ball_grasps(4)), FORCES).margin
    softer = jg.largest_disturbance(contacts_on_ball(ball_grasps(4)), FORCES.smoothed(0.01)).margin
    assert np.all(softer <= ours + 1e-9)


def test_one_compliance_a_direction_needs_a_sharp_set():
    every = jg.Compliance.per_direction(np.broadcast_to(np.eye(3), (6, 4, 3, 3)))
    with pytest.raises(ValueError, match="compliance: .*smoothed"):
        jg.largest_disturbance(contacts_on_ball(ball_grasps(2)), FORCES.smoothed(0.1), compliance=every)


@pytest.mark.thorough
def test_single_precision_gradients_are_finite():
    rng = np.random.default_rng(6)
    directions, axes = problems.unit_vectors(rng, 100_000, 4), rng.uniform(0.02, 0.06, (100_000, 1, 3))
    friction = rng.uniform(0.1, 1.2, (100_000, 4))

    @jax.jit
    def run(positions, normals, friction):
        def total(positions, normals, friction):
            grasps = jg.Contacts.from_normals(positions, normals, friction=friction, max_force=5.0)
            solution = jg.largest_disturbance(grasps, FORCES, cone_margin=0.02)
            return jnp.sum(jnp.nan_to_num(solution.margin)), solution.status

        gradients, status = jax.grad(total, argnums=(0, 1, 2), has_aux=True)(positions, normals, friction)
        finite = [jnp.isfinite(g).reshape(len(g), -1).all(-1) for g in gradients]
        return finite[0] & finite[1] & finite[2], status, gradients[2]

    arrays = (jnp.asarray(a, jnp.float32) for a in (directions * axes, directions / axes * 0.03, friction))
    finite, status, by_friction = run(*arrays)
    assert by_friction.dtype == jnp.float32
    assert np.sum(np.asarray(status) == jg.Status.SOLVED) > 30_000
    assert np.all(np.asarray(finite))
