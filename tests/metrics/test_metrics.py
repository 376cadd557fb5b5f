"""The field's other metrics against Qhull, HiGHS and NumPy, their invariances, derivatives and certificates."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.optimize import linprog
from scipy.spatial import ConvexHull, QhullError

import jaxgrasp as jg
from jaxgrasp import metrics
from jaxgrasp.candidates import sample_grasps
from jaxgrasp.metrics import METRICS, Setting, WrenchSpace

YCB = Path(__file__).resolve().parents[3] / "shared" / "data" / "ycb_allegro_grasps.npz"
COUNT, EDGES = 24, 4
MU = 0.6
# The linear programs are solved to 1e-9 in units of order one, HiGHS to 1e-7 and better.
PROGRAM_TOLERANCE = 1e-7
# Qhull and a bound that ends at the same facet.
FACET_TOLERANCE = 1e-9
SPACE = WrenchSpace(cone_edges=EDGES)
TASK = jg.DisturbanceSet.vertices(np.concatenate([np.eye(6)[:3], [[0, 0, 0, 0, 0, 0.02], [0, 0, 0, 0, 0, 0]]]))

# One program for a metric and shape: tests share them.
bound = jax.jit(metrics.ferrari_canny_bound, static_argnums=1)
closure = jax.jit(metrics.force_closure)
least = lambda c, s: closure(c, s).min_weight  # noqa: E731
task = jax.jit(metrics.task_wrench)
cheap = jax.jit(
    lambda c, s: (metrics.smallest_singular_value(c, s), metrics.isotropy(c, s), metrics.closure_residual(c, s))
)


def random_contacts(count: int = COUNT, friction: float = MU) -> jg.Contacts:
    found = sample_grasps(count, seed=3)
    return jg.Contacts.from_normals(found.positions, found.outward_normals, friction=friction, max_force=1.0)


def one(contacts: jg.Contacts, row: int) -> jg.Contacts:
    return jax.tree.map(lambda x: x[row], contacts)


def edges(contacts: jg.Contacts, n_e: int = EDGES) -> np.ndarray:
    """(batch, n_c, n_e, 6), from the definition: moments over the root-mean-square distance."""
    positions, frames = np.asarray(contacts.positions), np.asarray(contacts.frames)
    angle = 2 * np.pi * np.arange(n_e) / n_e
    mu = np.asarray(contacts.friction)[..., None, None]
    local = np.stack(np.broadcast_arrays(mu * np.cos(angle)[:, None], mu * np.sin(angle)[:, None], -1.0), -1)[..., 0, :]
    force = np.einsum("bcij,bcej->bcei", frames, local)
    length = np.sqrt((positions**2).sum(-1).mean(-1))[:, None, None, None]
    return np.concatenate([force, np.cross(positions[:, :, None], force) / length], -1)


def ball(points: np.ndarray) -> float:
    try:
        return max(0.0, (-ConvexHull(points).equations[:, -1]).min())
    except QhullError:
        return 0.0


def least_weight(W: np.ndarray) -> float:
    m = len(W)
    rows, sides = np.column_stack([-np.eye(m), np.ones(m)]), np.zeros(m)
    equal = np.vstack([np.column_stack([W.T, np.zeros(6)]), np.append(np.ones(m), 0)])
    found = linprog([0] * m + [-1], rows, sides, equal, [0] * 6 + [1], bounds=(None, None))
    return -found.fun if found.status == 0 else -np.inf


def largest_task(W: np.ndarray, wrench: np.ndarray) -> float:
    cost = np.append(np.zeros(len(W)), -1)
    equal = np.column_stack([W.T, -wrench])
    return -linprog(cost, [np.append(np.ones(len(W)), 0)], [1], equal, np.zeros(6)).fun


def test_edges_are_those_of_the_definition():
    contacts = random_contacts()
    np.testing.assert_allclose(metrics.edge_wrenches(contacts, SPACE), edges(contacts), atol=1e-14)
    of_norm_one = metrics.edge_wrenches(contacts, WrenchSpace(unit_edges=True, length=1.0, reference=(0.1, 0.0, 0.0)))
    np.testing.assert_allclose(np.linalg.norm(of_norm_one[..., :3], axis=-1), 1.0, atol=1e-14)
    arm = np.asarray(contacts.positions)[:, :, None] - [0.1, 0.0, 0.0]
    np.testing.assert_allclose(of_norm_one[..., 3:], np.cross(arm, of_norm_one[..., :3]), atol=1e-14)


def test_largest_balls_and_volumes_are_qhulls():
    contacts, W = random_contacts(), edges(random_contacts())
    radii = np.array([ball(w.reshape(-1, 6)) for w in W])
    assert 0.3 < np.mean(radii > 0) < 1
    ours = [metrics.ferrari_canny(one(contacts, row), "L1", SPACE) for row in range(COUNT)]
    np.testing.assert_allclose(ours, radii, atol=1e-12)
    for row in range(3):
        points = np.concatenate([np.zeros((1, 6)), W[row].reshape(-1, 6)])
        volume = metrics.wrench_space_volume(one(contacts, row), SPACE)
        np.testing.assert_allclose(volume, ConvexHull(points).volume, rtol=1e-9)


def test_a_bound_is_never_below_and_mostly_the_ball_itself():
    contacts, W = random_contacts(), edges(random_contacts())
    radii = np.array([ball(w.reshape(-1, 6)) for w in W])
    above = np.asarray(bound(contacts, "L1", SPACE))
    assert np.all(above >= radii * (1 - FACET_TOLERANCE))
    closed = radii > 0
    assert np.mean(above[closed] <= radii[closed] * (1 + FACET_TOLERANCE)) >= 0.9
    assert np.all(above[~closed] == 0)


@pytest.mark.thorough
def test_a_bound_where_each_force_is_bounded():
    contacts = jax.tree.map(lambda x: x[:6, :3], random_contacts(friction=1.0))
    above = np.asarray(bound(contacts, "Linf", SPACE))
    W = edges(contacts)
    for row in range(6):
        groups = [np.concatenate([np.zeros((1, 6)), w]) for w in W[row]]
        sums = (groups[0][:, None, None] + groups[1][:, None] + groups[2]).reshape(-1, 6)
        exact = metrics.ferrari_canny(one(contacts, row), "Linf", SPACE)
        np.testing.assert_allclose(exact, ball(sums), atol=1e-12)
        assert above[row] >= exact * (1 - FACET_TOLERANCE)
        assert above[row] <= exact * (1 + 1e-6)


def test_min_weights_are_those_of_highs():
    contacts, W = random_contacts(), edges(random_contacts())
    ours = np.asarray(least(contacts, SPACE))
    wanted = np.array([least_weight(w.reshape(-1, 6)) for w in W])
    assert (wanted < 0).any() and (wanted > 0).any()
    np.testing.assert_allclose(ours, wanted, atol=PROGRAM_TOLERANCE)


def test_force_closure_and_its_certificates():
    contacts, W = random_contacts(), edges(random_contacts())
    found = closure(contacts, SPACE)
    wanted = np.array([least_weight(w.reshape(-1, 6)) > PROGRAM_TOLERANCE for w in W])
    np.testing.assert_array_equal(found.closed, wanted)
    assert np.all(np.asarray(found.status) == jg.Status.SOLVED)
    forces = np.asarray(found.internal_forces)[wanted]
    G = np.asarray(jg.grasp_map(contacts))[wanted]
    np.testing.assert_allclose(G @ forces.reshape(len(G), -1, 1), 0, atol=1e-8)
    assert np.all(np.abs(forces[..., 0]) + np.abs(forces[..., 1]) < -MU * forces[..., 2])
    np.testing.assert_allclose(-forces[..., 2].sum(-1), 1, atol=1e-9)
    # No edge works against the twist: what the fingers do lies in a half-space.
    raw = np.asarray(metrics.edge_wrenches(contacts, WrenchSpace(cone_edges=EDGES, length=1.0)))[~wanted]
    twist = np.asarray(found.separating_twist)[~wanted]
    assert np.all(np.einsum("bcei,bi->bce", raw, twist) < 1e-9)
    assert np.isnan(np.asarray(found.separating_twist)[wanted]).all()


def test_singular_values_are_numpys():
    contacts = random_contacts()
    length = np.sqrt((np.asarray(contacts.positions) ** 2).sum(-1).mean(-1))
    G = np.asarray(jg.grasp_map(contacts)) / np.repeat(np.stack([np.ones(COUNT), length], -1), 3, -1)[..., None]
    singular = np.linalg.svd(G, compute_uv=False)
    smallest, share, residual = cheap(contacts, SPACE)
    np.testing.assert_allclose(smallest, singular[:, 5], atol=1e-9)
    np.testing.assert_allclose(share, singular[:, 5] / singular[:, 0], atol=1e-9)
    np.testing.assert_allclose(residual, np.linalg.norm(G[:, :, 2::3].sum(-1), axis=-1), atol=1e-12)


def soft_and_hard() -> tuple[jg.Contacts, np.ndarray]:
    """Grasps with some soft contacts, and their wrenches from the definition, (batch, n_c n_e + 2 n_c, 6)."""
    contacts = random_contacts()
    gamma = np.random.default_rng(0).uniform(0.005, 0.03, contacts.friction.shape)
    gamma[:, ::2] = 0
    contacts = replace(contacts, torsional_friction=jnp.asarray(gamma))
    positions, normals = np.asarray(contacts.positions), np.asarray(contacts.frames)[..., 2]
    length = np.sqrt((positions**2).sum(-1).mean(-1))[:, None, None]
    poles = []
    for sign in (1, -1):
        moment = np.cross(positions, -normals) + sign * gamma[..., None] * normals
        # Those of hard contacts do not count: zero.
        poles.append(np.concatenate([-normals, moment / length], -1) * (gamma > 0)[..., None])
    pyramid = edges(contacts)
    return contacts, np.concatenate([pyramid, np.stack(poles, 2)], 2).reshape(len(gamma), -1, 6)


def test_soft_contacts_have_edges_of_pure_torsion():
    contacts, W = soft_and_hard()
    ours = np.asarray(metrics.edge_wrenches(contacts, SPACE)).reshape(W.shape)
    np.testing.assert_allclose(ours, W, atol=1e-12)
    found = closure(contacts, SPACE)
    tasks = np.asarray(task(contacts, TASK, SPACE))
    length = np.sqrt((np.asarray(contacts.positions) ** 2).sum(-1).mean(-1))
    wanted = np.asarray(TASK.terms[0].wrenches)[:-1]
    for row, points in enumerate(W):
        counted = points[points.any(-1)]
        assert abs(metrics.ferrari_canny(one(contacts, row), "L1", SPACE) - ball(counted)) <= 1e-9
        if len(counted) >= 7 and np.linalg.matrix_rank(counted) == 6:
            assert abs(found.min_weight[row] - least_weight(counted)) <= PROGRAM_TOLERANCE
        by_highs = [largest_task(counted, w / np.repeat([1, length[row]], 3)) for w in wanted]
        assert abs(tasks[row] - min(by_highs)) <= PROGRAM_TOLERANCE * max(1, min(by_highs))
    assert found.closed.sum() >= 3 and found.internal_moments is not None
    held = np.asarray(found.closed)
    forces = np.einsum("bcij,bcj->bci", contacts.frames, found.internal_forces)
    moments = np.cross(contacts.positions, forces)
    moments = moments + np.asarray(found.internal_moments)[..., None] * np.asarray(contacts.frames)[..., 2]
    assert np.abs(forces.sum(1)[held]).max() <= 1e-9 and np.abs(moments.sum(1)[held]).max() <= 1e-9
    hard = replace(contacts, torsional_friction=None)
    alike = replace(contacts, torsional_friction=jnp.zeros_like(contacts.friction))
    both = [np.asarray(least(c, SPACE)) for c in (hard, alike)]
    np.testing.assert_allclose(*both, atol=1e-9)


def test_turning_the_object_changes_nothing():
    contacts = random_contacts()
    R = np.linalg.qr(np.random.default_rng(0).normal(size=(3, 3)))[0]
    R *= np.linalg.det(R)
    turned = replace(contacts, positions=contacts.positions @ R.T, frames=R @ contacts.frames)
    for mine, other in zip(cheap(contacts, SPACE), cheap(turned, SPACE), strict=True):
        np.testing.assert_allclose(mine, other, atol=1e-9)
    before, after = closure(contacts, SPACE), closure(turned, SPACE)
    np.testing.assert_array_equal(before.closed, after.closed)
    np.testing.assert_allclose(before.min_weight, after.min_weight, atol=PROGRAM_TOLERANCE)
    for row in range(4):
        exact = [metrics.ferrari_canny(one(c, row), "L1", SPACE) for c in (contacts, turned)]
        np.testing.assert_allclose(*exact, atol=1e-9)


def test_more_friction_never_hurts():
    contacts, more = random_contacts(), random_contacts(friction=MU + 0.1)
    assert not np.any(np.asarray(closure(contacts, SPACE).closed) & ~np.asarray(closure(more, SPACE).closed))
    for row in range(8):
        less, much = (metrics.ferrari_canny(one(c, row), "L1", SPACE) for c in (contacts, more))
        assert much >= less - 1e-12


def batched(contacts: jg.Contacts) -> dict[str, np.ndarray]:
    values = [least(contacts, SPACE), bound(contacts, "L1", SPACE)]
    names = ["min_weight", "bound", "singular", "isotropy", "residual"]
    return dict(zip(names, map(np.asarray, [*values, *cheap(contacts, SPACE)]), strict=True))


def test_a_bad_grasp_does_no_harm_to_others():
    contacts = random_contacts()
    bad = replace(
        contacts,
        positions=contacts.positions.at[3, 1].set(jnp.nan),
        frames=contacts.frames.at[5].set(0.0),
        friction=contacts.friction.at[7, 0].set(-1.0),
    )
    rows = [3, 5, 7]
    others = np.setdiff1d(np.arange(COUNT), rows)
    for (name, before), after in zip(batched(contacts).items(), batched(bad).values(), strict=True):
        assert np.isnan(after[rows]).all(), name
        np.testing.assert_array_equal(before[others], after[others], err_msg=name)
    found = closure(bad, SPACE)
    assert (
        np.all(np.asarray(found.status)[rows] == jg.Status.INVALID_INPUT) and not np.asarray(found.closed)[rows].any()
    )
    assert np.isnan(metrics.ferrari_canny(one(bad, 3), "L1", SPACE))
    assert np.isnan(metrics.wrench_space_volume(one(bad, 5), SPACE))


def test_absent_contacts_count_as_never_there():
    contacts = random_contacts()
    rubbish = jnp.full((COUNT, 1, 3), jnp.nan)
    padded = jg.Contacts(
        positions=jnp.concatenate([contacts.positions, rubbish], 1),
        frames=jnp.concatenate([contacts.frames, jnp.full((COUNT, 1, 3, 3), jnp.nan)], 1),
        friction=jnp.concatenate([contacts.friction, rubbish[..., 0]], 1),
        max_force=jnp.concatenate([contacts.max_force, rubbish[..., 0]], 1),
        active=jnp.concatenate([contacts.active, jnp.zeros((COUNT, 1), bool)], 1),
    )
    for mine, other in zip(cheap(contacts, SPACE), cheap(padded, SPACE), strict=True):
        np.testing.assert_allclose(mine, other, atol=1e-12)
    for row in range(2):
        exact = [metrics.ferrari_canny(one(c, row), "L1", SPACE) for c in (contacts, padded)]
        np.testing.assert_allclose(*exact, atol=1e-12)


def test_few_contacts_get_answers():
    """One contact; two opposite ones; in grasps that have room for four."""
    positions, normals = np.zeros((COUNT, 4, 3)), np.tile([1.0, 0.0, 0.0], (COUNT, 4, 1))
    positions[:, :2] = [[0.03, 0.0, 0.0], [-0.03, 0.0, 0.0]]
    normals[:, 1] *= -1
    active = np.tile([True, True, False, False], (COUNT, 1))
    active[0, 1], positions[0, 0, 1] = False, 0.01
    contacts = jg.Contacts.from_normals(positions, normals, friction=0.5, max_force=1.0, active=active)
    found = jax.tree.map(lambda x: np.asarray(x)[:2], closure(contacts, SPACE))
    assert not found.closed.any() and np.all(found.status == jg.Status.SOLVED)
    # Two opposite contacts cancel, but leave the rotation about their line: no closure.
    assert found.min_weight[0] < 0 and found.min_weight[1] == 0
    raw = metrics.edge_wrenches(contacts, WrenchSpace(cone_edges=EDGES, length=1.0))[:2]
    twist = found.separating_twist
    assert np.all(np.einsum("bcei,bi->bce", raw, twist) < 1e-9) and np.all(np.abs(twist).max(-1) > 0.1)
    smallest, isotropy, residual = map(np.asarray, cheap(contacts, SPACE))
    assert not smallest.any() and not isotropy.any() and residual[0] > 0 and not residual[1:].any()
    for row in range(2):
        assert metrics.ferrari_canny(one(contacts, row), "L1", SPACE) == 0
        assert metrics.wrench_space_volume(one(contacts, row), SPACE) == 0


DIFFERENTIABLE = {
    "bound": lambda c: bound(c, "L1", SPACE),
    "bound Linf": lambda c: bound(c, "Linf", SPACE),
    "singular": lambda c: cheap(c, SPACE)[0],
    "isotropy": lambda c: cheap(c, SPACE)[1],
    "residual": lambda c: cheap(c, SPACE)[2],
    "min_weight": lambda c: metrics.min_weight(c, SPACE),
    "task": lambda c: task(c, TASK, SPACE),
}


@pytest.mark.parametrize(
    "name",
    [
        "bound",
        "singular",
        "isotropy",
        "residual",
        pytest.param("min_weight", marks=pytest.mark.thorough),
        pytest.param("task", marks=pytest.mark.thorough),
        pytest.param("bound Linf", marks=pytest.mark.thorough),
    ],
)
def test_derivatives_are_central_differences(name):
    """With respect to positions and friction, each grasp along a random direction."""
    function, contacts, random, step = DIFFERENTIABLE[name], random_contacts(), np.random.default_rng(1), 1e-5
    dp, dmu = 0.01 * random.normal(size=contacts.positions.shape), random.normal(size=contacts.friction.shape)
    moved = lambda s: replace(contacts, positions=contacts.positions + s * dp, friction=contacts.friction + s * dmu)  # noqa: E731
    total = lambda p, mu: function(replace(contacts, positions=p, friction=mu)).sum()  # noqa: E731
    by_position, by_friction = jax.grad(total, argnums=(0, 1))(contacts.positions, contacts.friction)
    ours = np.sum(by_position * dp, (1, 2)) + np.sum(by_friction * dmu, 1)
    numeric = np.asarray(function(moved(step)) - function(moved(-step))) / (2 * step)
    error = np.abs(ours - numeric) / np.maximum(1e-2, np.abs(numeric))
    # A kink between the two points of the difference is no error: facets change.
    assert np.median(error) < 1e-6 and np.mean(error < 1e-4) >= 0.9
    assert np.abs(numeric).max() > 1e-3


def test_any_batch_axes():
    contacts = random_contacts()
    shaped = jax.tree.map(lambda x: x.reshape(4, 1, 6, *x.shape[1:]), contacts)
    whole = cheap(contacts, SPACE)[2]
    np.testing.assert_allclose(metrics.closure_residual(shaped, SPACE).ravel(), whole, atol=1e-12)
    np.testing.assert_allclose(jax.vmap(lambda c: metrics.closure_residual(c, SPACE))(contacts), whole, atol=1e-12)


def test_conventions_may_differ_over_a_batch():
    """One grasp about several points and in several units, of which one is none."""
    contacts, references = one(random_contacts(), 0), np.random.default_rng(0).normal(size=(3, 1, 3))
    lengths = np.array([0.5, 2.0, 0.0, np.nan])
    found = metrics.closure_residual(contacts, WrenchSpace(reference=references, length=lengths))
    assert found.shape == (3, 4) and np.isnan(found[:, 2:]).all()
    for row in range(3):
        for column in range(2):
            space = WrenchSpace(reference=references[row, 0], length=lengths[column])
            np.testing.assert_allclose(found[row, column], metrics.closure_residual(contacts, space), atol=1e-12)
    with pytest.raises(ValueError, match="do not broadcast"):
        metrics.closure_residual(random_contacts(), WrenchSpace(length=np.ones(5)))


@pytest.mark.thorough
def test_single_precision_stays_single():
    contacts = jax.tree.map(lambda x: x.astype(jnp.float32) if x.dtype != bool else x, random_contacts())
    for narrow, wide in zip(cheap(contacts, SPACE), cheap(random_contacts(), SPACE), strict=True):
        assert narrow.dtype == jnp.float32
        np.testing.assert_allclose(narrow, wide, atol=1e-3)
    above = bound(contacts, "L1", SPACE)
    assert above.dtype == jnp.float32
    np.testing.assert_allclose(above, bound(random_contacts(), "L1", SPACE), rtol=1e-2, atol=2e-3)


def test_what_cannot_be_asked_is_refused():
    contacts = random_contacts()
    with pytest.raises(ValueError, match="wanted one grasp"):
        metrics.wrench_space_volume(contacts)
    with pytest.raises(ValueError, match="wanted 'L1' or 'Linf'"):
        metrics.ferrari_canny(one(contacts, 0), "L2")
    with pytest.raises(ValueError, match="ferrari_canny_bound can be traced"):
        jax.jit(metrics.ferrari_canny)(contacts)
    with pytest.raises(ValueError, match="at least 3"):
        metrics.min_weight(contacts, WrenchSpace(cone_edges=2))
    with pytest.raises(ValueError, match="without vertices"):
        metrics.task_wrench(contacts, jg.DisturbanceSet.ball())
    with pytest.raises(ValueError, match=r"jaxgrasp\.Contacts"):
        metrics.isotropy(np.zeros(3))


def test_without_scipy_the_remedy_is_told(monkeypatch):
    monkeypatch.setitem(__import__("sys").modules, "scipy.spatial", None)
    with pytest.raises(ImportError, match="pip install scipy"):
        metrics.wrench_space_volume(one(random_contacts(), 0), SPACE)


def test_every_metric_is_in_the_table():
    assert {name for name, metric in METRICS.items() if metric.name != name} == set()
    setting = Setting(disturbances=TASK, cone_edges=EDGES, task={})
    contacts = one(random_contacts(), 0)
    for name in ("ferrari_canny", "volume", "closure_residual"):
        assert np.isfinite(METRICS[name].value(contacts, setting)), name
    assert [name for name, metric in METRICS.items() if not metric.larger_is_better] == ["closure_residual"]


@pytest.mark.skipif(not YCB.exists(), reason="the collection of real grasps is not here")
def test_stored_balls_of_real_grasps():
    given, contacts, space = frogger()
    stored = given["ferrari_canny"][::5]
    rows = range(0, len(contacts.positions), 5)
    radii = [
        metrics.ferrari_canny(one(contacts, row), "L1", replace(space, reference=space.reference[row])) for row in rows
    ]
    assert np.mean(np.abs(radii - stored) <= 0.01 * stored) >= 0.9


@pytest.mark.thorough
@pytest.mark.skipif(not YCB.exists(), reason="the collection of real grasps is not here")
def test_stored_min_weights_of_real_grasps():
    given, contacts, space = frogger()
    stored = given["min_weight"]
    weights = np.asarray(jax.jit(metrics.min_weight)(contacts, space))
    assert np.mean(np.abs(weights - stored) <= 0.01 * np.abs(stored)) >= 0.9


def frogger() -> tuple[dict[str, np.ndarray], jg.Contacts, WrenchSpace]:
    """The collection in its own conventions: the first tangent is (1.2, 2.3, 3.4) made orthogonal to the normal."""
    with np.load(YCB, allow_pickle=False) as data:
        given = {name: data[name] for name in data}
    n = given["outward_normals"]
    seed = np.array([1.2, 2.3, 3.4])
    t1 = seed - n * (n @ seed)[..., None]
    t1 /= np.linalg.norm(t1, axis=-1, keepdims=True)
    frames = np.stack([t1, np.cross(n, t1), n], -1)
    friction = np.repeat(given["friction"][:, None], n.shape[1], 1)
    contacts = jg.Contacts.from_frames(given["positions"], frames, friction=friction, max_force=1.0)
    space = WrenchSpace(cone_edges=4, unit_edges=True, length=1.0, reference=-given["center_of_mass"])
    return given, contacts, space


@pytest.mark.thorough
def test_absent_contacts_do_not_count_in_programs():
    contacts = jax.tree.map(lambda x: x[:, :3], random_contacts(friction=1.0))
    fourth = replace(random_contacts(friction=1.0), active=jnp.ones((COUNT, 4), bool).at[:, 3].set(False))
    for function in (DIFFERENTIABLE["min_weight"], DIFFERENTIABLE["task"]):
        np.testing.assert_allclose(function(contacts), function(fourth), atol=PROGRAM_TOLERANCE)
    exact = [metrics.ferrari_canny(one(fourth, row), "L1", SPACE) for row in range(COUNT)]
    np.testing.assert_allclose(bound(fourth, "L1", SPACE), exact, atol=1e-5)
