"""What must hold between answers: the paper's identities, invariances, and order."""

from __future__ import annotations

from dataclasses import replace

import harness
import jax.numpy as jnp
import numpy as np
import oracles
import problems
import pytest

import jaxgrasp as jg

SAME_MARGIN = 2e-8
"""Of max(|margin|, Lambda): two margins that are equal on paper, each certified to a gap of 1e-8."""

STATIONARITY = 1e-6
"""Of the terms that cancel in the gradient of the Lagrangian, which the method drives to zero with the gap."""

KAPPA = 1e-4
"""What s z is in a row of the smoothed program, in units of the margin."""


def solve(batch: problems.Batch, cone_edges: int = 8):
    return harness.as_numpy(harness.largest(*harness.data_of(batch), cone_edges=cone_edges))


def truths(batch: problems.Batch, cone_edges: int = 8, **changes) -> list[oracles.Answer]:
    grasps = [batch.grasp(lane, cone_edges) for lane in range(len(batch))]
    return oracles.largest_disturbances([replace(grasp, **changes) for grasp in grasps])


def unit_of(batch: problems.Batch, *margins: np.ndarray) -> np.ndarray:
    scale = np.array([oracles.program(batch.grasp(lane, 8)).scale for lane in range(len(batch))])
    return np.maximum(scale, np.max(np.abs(margins), axis=0, initial=0.0))


@pytest.fixture(scope="module")
def batch() -> problems.Batch:
    return problems.sample()


@pytest.fixture(scope="module")
def plain(batch):
    return solve(batch)


def assert_same(batch: problems.Batch, ours: np.ndarray, other: np.ndarray) -> None:
    assert np.all(np.abs(ours - other) <= SAME_MARGIN * unit_of(batch, ours, other))


def test_a_smoothed_margin_is_below_the_exact_one_by_kappa_a_row_at_most():
    contacts, forces = harness.data_of(problems.sample(families=("plain", "around")))[:2]
    exact = jg.largest_disturbance(contacts, forces)
    smooth = jg.largest_disturbance(contacts, forces, smoothing=KAPPA)
    assert (smooth.status == exact.status).all()
    held = np.asarray(exact.margin > 100 * KAPPA)
    short = np.asarray(exact.margin - smooth.margin)[held]
    rows = 9 * contacts.friction.shape[-1]
    assert held.sum() > 8
    assert (short > 0).all()
    assert (short < 1.01 * rows * KAPPA).all()


def test_force_limits_and_loads_scale_the_margin(batch, plain):
    factor = np.geomspace(1e-3, 1e3, len(batch))
    scaled = replace(
        batch,
        max_force=factor[:, None] * batch.max_force,
        required_wrench=factor[:, None] * batch.required_wrench,
        cone_margin=factor * batch.cone_margin,
    )
    assert_same(batch, solve(scaled).margin / factor, plain.margin)


def test_the_unit_of_length_does_not_matter(batch, plain):
    unit = np.geomspace(1e-3, 1e3, len(batch))[:, None]
    wrench_unit = np.repeat(np.hstack([np.ones_like(unit), unit]), 3, axis=-1)
    scaled = replace(
        batch,
        positions=unit[..., None] * batch.positions,
        vertices=wrench_unit[:, None] * batch.vertices,
        required_wrench=wrench_unit * batch.required_wrench,
    )
    assert_same(batch, solve(scaled).margin, plain.margin)


def test_turning_everything_changes_nothing(batch, plain):
    R = problems.rotations(np.random.default_rng(1), len(batch))
    turned = replace(
        batch,
        positions=np.einsum("lij,lcj->lci", R, batch.positions),
        frames=R[:, None] @ batch.frames,
        required_wrench=np.einsum("lij,lkj->lki", R, batch.required_wrench.reshape(-1, 2, 3)).reshape(-1, 6),
    )
    contacts, disturbances, load, cone_margin = harness.data_of(turned)
    ours = harness.largest(contacts, disturbances.rotated(jnp.asarray(R)), load, cone_margin)
    assert_same(batch, np.asarray(ours.margin), plain.margin)
    before = np.asarray(plain.forces_in_object_frame(harness.contacts_of(batch)))
    after = np.asarray(ours.forces_in_object_frame(contacts))
    assert after.shape == before.shape == batch.positions.shape
    np.testing.assert_allclose(after.sum(axis=1), turned.required_wrench[:, :3], atol=1e-7 * batch.max_force.max())


def test_the_order_of_contacts_and_vertices_does_not_matter(batch, plain):
    rng = np.random.default_rng(2)
    contact, vertex = rng.permutation(batch.positions.shape[1]), rng.permutation(batch.vertices.shape[1])
    names = ("positions", "frames", "friction", "max_force", "active")
    shuffled = replace(
        batch, vertices=batch.vertices[:, vertex], **{name: getattr(batch, name)[:, contact] for name in names}
    )
    assert_same(batch, solve(shuffled).margin, plain.margin)


def test_absent_contacts_are_as_if_they_had_never_been_there(batch):
    keep = np.ones(batch.positions.shape[:2], bool)
    keep[np.arange(len(batch)), np.arange(len(batch)) % 4] = False
    nonsense = np.where(keep, 1.0, np.nan)
    ragged = replace(
        batch,
        active=keep,
        positions=batch.positions * nonsense[..., None],
        frames=batch.frames * nonsense[..., None, None],
        friction=batch.friction * nonsense,
        max_force=np.where(keep, batch.max_force, -1.0),
    )
    smaller = {
        name: np.stack([values[on] for values, on in zip(getattr(batch, name), keep, strict=True)])
        for name in ("positions", "frames", "friction", "max_force", "active")
    }
    ours, without = solve(ragged), solve(replace(batch, **smaller))
    assert_same(batch, ours.margin, without.margin)
    np.testing.assert_array_equal(ours.status, without.status)
    np.testing.assert_array_equal(ours.rank, without.rank)
    assert not ours.forces[~keep].any()


def test_without_force_closure_the_margin_is_zero():
    # All normals within 30 degrees of one axis and all forces within 17 degrees of a normal: nothing pushes back.
    rng = np.random.default_rng(3)
    batch = problems.sample()
    tilt, turn = rng.uniform(0, np.pi / 6, batch.friction.shape), rng.uniform(0, 2 * np.pi, batch.friction.shape)
    normals = np.stack([np.sin(tilt) * np.cos(turn), np.sin(tilt) * np.sin(turn), np.cos(tilt)], axis=-1)
    hand = replace(
        batch,
        frames=problems.frames_from_normals(normals, turn),
        friction=np.full_like(batch.friction, 0.3),
        required_wrench=np.zeros_like(batch.required_wrench),
    )
    ours = solve(hand)
    assert np.all(ours.status == jg.Status.SOLVED)
    assert np.all(np.abs(ours.margin) <= SAME_MARGIN * unit_of(hand))


@pytest.mark.parametrize("name", ["friction", "max_force"])
def test_more_friction_or_force_never_hurts(batch, plain, name):
    more = solve(replace(batch, **{name: 1.3 * getattr(batch, name)})).margin
    held = plain.margin >= 0
    assert held.sum() > len(batch) / 2
    assert np.all((more >= plain.margin - SAME_MARGIN * unit_of(batch, more, plain.margin))[held])


def test_a_larger_set_never_helps(batch, plain):
    rng = np.random.default_rng(4)
    extra = np.where(batch.vertices.any(axis=-1, keepdims=True), 0.0, rng.normal(size=batch.vertices.shape))
    scale = np.repeat([1.0, 0.05], 3)
    more = solve(replace(batch, vertices=batch.vertices + scale * extra)).margin
    held = plain.margin >= 0
    assert np.all((more <= plain.margin + SAME_MARGIN * unit_of(batch, more, plain.margin))[held])
    assert np.any(more < 0.9 * plain.margin)


def test_a_reserve_in_the_cones_never_helps(batch, plain):
    reserve = 0.02 * batch.max_force.min(axis=-1)
    less = solve(replace(batch, cone_margin=reserve))
    assert np.all(less.margin <= plain.margin + SAME_MARGIN * unit_of(batch, plain.margin))
    truth = np.array([a.margin for a in truths(replace(batch, cone_margin=reserve))])
    assert_same(batch, less.margin, truth)


@pytest.mark.parametrize("cone_edges", [3, 5, 16])
def test_other_numbers_of_edges(cone_edges):
    batch = problems.sample(count=2)
    truth = np.array([a.margin for a in truths(batch, cone_edges)])
    assert_same(batch, solve(batch, cone_edges).margin, truth)


def compliances(rng, lanes: int, n_c: int, n_d: int, kind: str) -> np.ndarray:
    shape = {"blocks": (lanes, n_c, 3), "full": (lanes, 3 * n_c), "per direction": (lanes, n_d, 3 * n_c)}[kind]
    root = rng.normal(size=(*shape, shape[-1]))
    return root @ np.swapaxes(root, -1, -2) / shape[-1] + 0.3 * np.eye(shape[-1])


@pytest.mark.parametrize("kind", ["blocks", "full", "per direction"])
def test_compliances(kind):
    batch = problems.sample(families=("around", "light load"), count=6)
    Q = compliances(np.random.default_rng(5), len(batch), 4, 12, kind)
    contacts, disturbances, load, _ = harness.data_of(batch)
    ours = jg.largest_disturbance(
        contacts,
        disturbances,
        required_wrench=load,
        compliance=jg.Compliance.per_direction(jnp.asarray(Q)) if kind == "per direction" else jnp.asarray(Q),
    )
    grasps = []
    for lane, given in enumerate(Q):
        grasp = replace(batch.grasp(lane, 8), vertices=batch.vertices[lane])
        grasps.append(replace(grasp, compliance=given))
    truth = np.array([a.margin for a in oracles.largest_disturbances(grasps)])
    scale = np.array([oracles.program(grasp).scale for grasp in grasps])
    assert np.all(np.abs(np.asarray(ours.margin) - truth) <= SAME_MARGIN * np.maximum(scale, np.abs(truth)))


@pytest.mark.parametrize("kind", [None, "blocks", "full", "per direction"])
def test_blocking_forces_balance_the_disturbance_with_least_norm(kind):
    batch = problems.sample(families=("around", "light load"), count=6)
    wrenches = np.random.default_rng(6).normal(size=(len(batch), 12, 6)) * np.repeat([1.0, 0.05], 3)
    Q = None if kind is None else compliances(np.random.default_rng(7), len(batch), 4, 12, kind)
    given = None if Q is None else jnp.asarray(Q)
    if kind == "per direction":
        given = jg.Compliance.per_direction(given)
    ours = np.asarray(jg.blocking_forces(harness.contacts_of(batch), jnp.asarray(wrenches), compliance=given))
    assert ours.shape == (len(batch), 12, 4, 3)
    for lane in range(len(batch)):
        grasp = replace(batch.grasp(lane, 8), vertices=wrenches[lane], compliance=None if Q is None else Q[lane])
        delta = ours[lane].reshape(12, -1)
        balance = (delta @ grasp.grasp_map.T + wrenches[lane]) * grasp.row_scale
        assert np.abs(balance).max() <= 1e-10 * np.abs(delta).max()
        np.testing.assert_allclose(delta, -grasp.force_changes[:-1], atol=1e-9 * np.abs(delta).max())


def test_blocking_forces_of_two_contacts_balance_what_they_can():
    rng = np.random.default_rng(8)
    positions = np.array([[0.04, 0.0, 0.01], [-0.04, 0.0, 0.01]])
    frames = problems.frames_from_normals(np.array([[1.0, 0.0, 0.0], [-1.0, 0.0, 0.0]]), np.array([0.3, 0.8]))
    contacts = jg.Contacts.from_frames(jnp.asarray(positions), jnp.asarray(frames), friction=0.5, max_force=2.0)
    grasp = oracles.Grasp(
        positions=positions,
        frames=frames,
        friction=np.full(2, 0.5),
        max_force=np.full(2, 2.0),
        vertices=rng.normal(size=(5, 6)),
        required_wrench=np.zeros(6),
    )
    basis = grasp.range_basis
    assert basis.shape == (6, 5)
    inside = (grasp.vertices * grasp.row_scale) @ basis @ basis.T / grasp.row_scale
    delta = np.asarray(jg.blocking_forces(contacts, jnp.asarray(inside))).reshape(5, 6)
    np.testing.assert_allclose(delta @ grasp.grasp_map.T, -inside, atol=1e-12)


def test_the_multipliers_prove_the_margin(batch, plain):
    for lane in range(len(batch)):
        grasp = batch.grasp(lane, 8)
        S_1, S_2 = oracles.worst_case(grasp)
        z_1, z_2 = plain.cone_multipliers[lane].reshape(-1), plain.bound_multipliers[lane]
        y = plain.wrench_multipliers[lane]
        assert z_1.min() >= 0 and z_2.min() >= 0
        gradient = z_1 @ grasp.cone_matrix - z_2 @ grasp.normal_matrix + y @ grasp.grasp_map
        assert np.abs(gradient).max() <= STATIONARITY * max(z_1.max(), z_2.max())
        assert abs(1 + z_1 @ S_1 - z_2 @ S_2) <= STATIONARITY
        value = z_2 @ grasp.max_force + y @ grasp.required_wrench - grasp.cone_margin * z_1.sum()
        assert abs(value - plain.margin[lane]) <= STATIONARITY * max(abs(value), oracles.program(grasp).scale)


def test_the_required_wrench_is_that_of_a_rigid_body():
    rng = np.random.default_rng(9)
    root = rng.normal(size=(3, 3))
    mass, inertia = 0.7, 1e-3 * (root @ root.T + np.eye(3))
    gravity, twist, acceleration = np.array([0.3, -9.0, 2.0]), rng.normal(size=6), rng.normal(size=6)
    ours = jg.required_wrench(mass, gravity=gravity, inertia=inertia, twist=twist, acceleration=acceleration)
    truth = oracles.required_wrench(mass, gravity, inertia, twist, acceleration)
    np.testing.assert_allclose(ours, truth, rtol=1e-13)
    np.testing.assert_allclose(jg.required_wrench(2.0), [0, 0, 19.62, 0, 0, 0], rtol=1e-13)
    many = jg.required_wrench(jnp.full((3, 1), mass), gravity=jnp.asarray(rng.normal(size=(2, 3))))
    assert many.shape == (3, 2, 6)


def test_effort_weights():
    batch = problems.sample(families=("around", "light load"), count=6)
    margins = solve(batch).margin
    weights = compliances(np.random.default_rng(10), len(batch), 4, 0, "blocks")
    margin = 0.5 * np.maximum(margins, 0)
    contacts, disturbances, load, _ = harness.data_of(batch)
    ours = jg.least_effort(
        contacts,
        disturbances,
        jnp.asarray(margin),
        required_wrench=load,
        effort_weights=jnp.asarray(weights),
    )
    held = np.flatnonzero(margins > 1e-6 * unit_of(batch))
    assert len(held) > len(batch) / 2
    for lane in held:
        truth = oracles.least_effort(batch.grasp(lane, 8), margin[lane], weights[lane])
        assert abs(float(ours.effort[lane]) - truth) <= 1e-7 * max(truth, 1e-3 * batch.max_force[lane].mean() ** 2)
        f = np.asarray(ours.forces[lane])
        np.testing.assert_allclose(0.5 * np.einsum("ci,cij,cj", f, weights[lane], f), ours.effort[lane], rtol=1e-12)
