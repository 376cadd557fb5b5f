"""Soft fingertips: a moment about the normal that shares the friction, in (21), (22), S_1, S_2 and G*."""

from __future__ import annotations

import warnings
from dataclasses import replace
from functools import cache

import harness
import jax
import jax.numpy as jnp
import numpy as np
import oracles
import problems
import pytest

import jaxgrasp as jg
from jaxgrasp import kernels

BY_HAND = 1e-9
"""Of the margin: what opposed contacts bear, and hard ones as soft ones with coefficient 0."""

MARGIN_TOLERANCE, EFFORT_TOLERANCE, ROW_TOLERANCE = 1e-7, 1e-7, 1e-8
"""As in `test_accuracy`, of the same units."""

SAME_MARGIN = {"float64": 2e-8, "float32": 1e-4}
"""As in `test_kernels`, of max(margin, Lambda)."""

SINGLE_TOLERANCE = 1e-4
"""Of max(margin, Lambda), float32 against float64."""

STEP, GRADIENT_TOLERANCE = 1e-6, 1e-5
"""Of central differences, relative to the largest entry of an input; and the error, relative to the largest slope."""

SHARE = 0.75
QUICK, ALL = 40, 430
"""Grasps of each of the seven kinds; all together more than 3,000."""


def pair(count: int, seed: int) -> problems.Batch:
    """Two fingers, nearly opposite, under small wrenches of every kind."""
    rng = np.random.default_rng(seed)
    width = rng.uniform(0.02, 0.1, (count, 1))
    normals = np.array([[1.0, 0, 0], [-1.0, 0, 0]]) + 0.1 * rng.normal(size=(count, 2, 3))
    normals /= np.linalg.norm(normals, axis=-1, keepdims=True)
    positions = np.stack([width, -width], 1) * [1.0, 0, 0] + 0.05 * width[:, None] * rng.normal(size=(count, 2, 3))
    like = problems.group("3 contacts").batch[:count]
    wrenches = rng.normal(size=like.vertices.shape) * np.repeat([1, 0.02], 3)
    return replace(
        like,
        positions=positions,
        frames=problems.frames_from_normals(normals, rng.uniform(0, 6, (count, 2))),
        friction=rng.uniform(0.3, 1, (count, 2)),
        max_force=rng.uniform(2, 10, (count, 2)),
        vertices=wrenches,
        required_wrench=0 * like.required_wrench,
        active=np.ones((count, 2), bool),
        cone_margin=0 * like.cone_margin,
    )


KINDS = ("pairs", "3 contacts", "4 contacts", "5 contacts", "8 contacts", "absent", "mixed")


@cache
def batch(kind: str, count: int) -> tuple[problems.Batch, np.ndarray]:
    """Grasps and their torsional coefficients, of centimetres in proportion to their size; some 0 in "mixed"."""
    seed = KINDS.index(kind)
    rng = np.random.default_rng(seed)
    if kind == "pairs":
        grasps = pair(count, seed)
    else:
        group = problems.group(kind if kind in problems.GROUPS else "4 contacts")
        wanted = ["absent"] if kind == "absent" else [f for f in np.unique(group.family) if f != "frictionless"]
        chosen = np.flatnonzero(np.isin(group.family, wanted))
        grasps = group.batch[rng.choice(chosen, count, replace=count > len(chosen))]
    size = np.sqrt(np.mean(np.sum(grasps.positions**2, -1), -1, keepdims=True))
    torsional = size * np.exp(rng.uniform(np.log(0.02), np.log(0.5), grasps.friction.shape))
    if kind == "mixed":
        torsional *= rng.uniform(size=torsional.shape) < 0.5
    return grasps, torsional


def soft(grasps: problems.Batch, torsional, dtype=jnp.float64) -> tuple:
    contacts, *rest = harness.data_of(grasps, dtype)
    with warnings.catch_warnings():
        # Grasps of all sizes have fingertips of all sizes.
        warnings.simplefilter("ignore")
        return (
            jg.Contacts.from_frames(
                contacts.positions,
                contacts.frames,
                friction=contacts.friction,
                max_force=contacts.max_force,
                active=contacts.active,
                torsional_friction=jnp.asarray(torsional, dtype),
            ),
            *rest,
        )


def oracle(grasps: problems.Batch, torsional: np.ndarray) -> list[oracles.Grasp]:
    lanes = range(len(grasps))
    return [replace(grasps.grasp(k, 8), torsional=torsional[k][grasps.active[k]]) for k in lanes]


def in_newtons(solution, contacts: jg.Contacts, lane: int) -> np.ndarray:
    """(n, 4), the forces of a lane and its moments as m mu / gamma; absent contacts dropped."""
    on = np.asarray(contacts.active[lane])
    arms = np.asarray(contacts.torsional_friction[lane] / contacts.friction[lane])[on]
    moments = np.asarray(solution.moments[lane])[on]
    assert not np.any(moments[arms == 0])
    moments = moments / np.where(arms > 0, arms, 1)
    return np.concatenate([np.asarray(solution.forces[lane])[on], moments[:, None]], 1)


def opposed(torsional_friction, friction=0.6, max_force=5.0) -> jg.Contacts:
    return jg.Contacts.from_normals(
        [[0.03, 0, 0], [-0.03, 0, 0]],
        [[1.0, 0, 0], [-1.0, 0, 0]],
        friction=friction,
        max_force=max_force,
        torsional_friction=torsional_friction,
    )


@pytest.mark.parametrize("jitted", [False, True])
def test_opposed_contacts_bear_what_they_bear_by_hand(jitted):
    moment = jg.DisturbanceSet.vertices(jnp.array([[0, 0, 0, 0.01, 0, 0], [0, 0, 0, -0.01, 0, 0]]))
    margin = lambda contacts: jg.largest_disturbance(contacts, moment).margin  # noqa: E731
    margin = jax.jit(margin) if jitted else margin
    for gamma, force in ((0.02, 5.0), (0.003, 1.0), (0.1, 50.0)):
        wanted = 2 * gamma * force / 0.01
        assert abs(margin(opposed(gamma, 0.6, force)) - wanted) <= BY_HAND * wanted
    assert margin(opposed(0.0)) == 0
    # One soft finger bears all of it.
    assert abs(margin(opposed([0.02, 0.0])) - 0.02 * 5 / 0.01) <= BY_HAND * 10


@pytest.mark.parametrize("coefficient", [0.0, 1e-12])
def test_without_torsion_soft_contacts_are_hard(coefficient):
    grasps = problems.sample(count=4)
    hard = harness.as_numpy(harness.largest(*harness.data_of(grasps)))
    ours = harness.as_numpy(harness.largest(*soft(grasps, np.full(grasps.friction.shape, coefficient))))
    assert np.array_equal(hard.status, ours.status)
    scale = np.array([a.scale for a in oracles.largest_disturbances([grasps.grasp(k, 8) for k in range(len(grasps))])])
    assert np.nanmax(np.abs(hard.margin - ours.margin) / np.fmax(np.abs(hard.margin), scale)) <= BY_HAND
    if not coefficient:
        assert not np.any(ours.moments)


def cases_of_highs() -> list:
    thorough = [pytest.param(kind, ALL, marks=pytest.mark.thorough) for kind in KINDS]
    return [("mixed", QUICK), ("pairs", QUICK), *thorough]


@pytest.mark.parametrize(("kind", "count"), cases_of_highs())
def test_margins_and_efforts_are_those_of_highs_and_clarabel(kind, count):
    grasps, torsional = batch(kind, count)
    data, cases = soft(grasps, torsional), oracle(grasps, torsional)
    ours = harness.as_numpy(harness.largest(*data))
    truth = oracles.largest_disturbances(cases)
    margin, scale = np.array([a.margin for a in truth]), np.array([a.scale for a in truth])
    unit = np.maximum(np.abs(margin), scale)
    near = np.abs(margin) <= MARGIN_TOLERANCE * scale
    solved = np.array([a.status == "SOLVED" for a in truth])
    assert np.all(near | (solved == (ours.status == jg.Status.SOLVED)))
    one_sided = np.array([a.one_sided for a in truth]) & (margin < 0) & np.isnan(ours.margin)
    error = np.abs(ours.margin - margin) / unit
    assert np.all((error <= MARGIN_TOLERANCE) | one_sided | np.isnan(margin) & np.isnan(ours.margin))
    asked = np.where(margin > 1e-6 * scale, SHARE * ours.margin, 0.0)
    least = harness.as_numpy(harness.least(*data, jnp.asarray(asked)))
    for lane in np.flatnonzero(asked):
        forces = in_newtons(ours, data[0], lane)
        assert oracles.row_violation(cases[lane], forces, ours.margin[lane]) <= ROW_TOLERANCE
        forces = in_newtons(least, data[0], lane)
        assert oracles.row_violation(cases[lane], forces, asked[lane]) <= ROW_TOLERANCE
        effort = oracles.least_effort(cases[lane], asked[lane])
        assert least.status[lane] == jg.Status.SOLVED
        assert abs(least.effort[lane] - effort) <= EFFORT_TOLERANCE * max(
            effort, 1e-3 * np.mean(cases[lane].max_force) ** 2
        )


def test_worst_cases_and_blocking_forces():
    grasps, torsional = batch("mixed", QUICK)
    contacts, disturbances, *_ = soft(grasps, torsional)
    S_1, S_2 = jg.worst_case(contacts, disturbances)
    answers = jg.blocking_forces(contacts, grasps.vertices)
    inverse = jg.weighted_pseudo_inverse(contacts)
    G = jg.grasp_map(contacts)
    assert S_1.shape[-1] == 16 and answers.shape[-1] == 4 and G.shape[-1] == inverse.shape[-2] == 16
    for lane, case in enumerate(oracle(grasps, torsional)):
        one, two = oracles.worst_case(case)
        on = grasps.active[lane]
        assert np.allclose(S_1[lane][on].reshape(-1), one, rtol=1e-9, atol=1e-9)
        assert np.allclose(S_2[lane][on], two, rtol=1e-9, atol=1e-9)
        turned = np.asarray(answers[lane]).reshape(12, -1).T
        assert np.allclose(-inverse[lane] @ grasps.vertices[lane].T, turned, rtol=1e-9, atol=1e-9)
        assert np.allclose(G[lane] @ turned, -grasps.vertices[lane].T, rtol=1e-7, atol=1e-8)


@pytest.mark.thorough
def test_compliances_and_weights_are_those_of_forces_and_moments():
    grasps, torsional = problems.sample(count=2), None
    rng = np.random.default_rng(5)
    torsional = rng.uniform(0.005, 0.02, grasps.friction.shape) * (rng.uniform(size=grasps.friction.shape) < 0.8)
    data = soft(grasps, torsional)
    arms = torsional / grasps.friction
    root = rng.normal(size=(*torsional.shape, 4, 4))
    Q = root @ np.swapaxes(root, -1, -2) + np.eye(4)
    there = np.concatenate([np.ones((*arms.shape, 3)), arms[..., None]], -1)
    turned = Q * there[..., None] * there[..., None, :]
    turned[..., 3, 3] += there[..., 3] == 0
    given, loads = (
        dict(zip(("contacts", "disturbances"), data, strict=False)),
        dict(required_wrench=data[2], cone_margin=data[3]),
    )
    blocks = jg.largest_disturbance(**given, **loads, compliance=jnp.asarray(Q))
    n = torsional.shape[1]
    full = np.zeros((len(Q), 4 * n, 4 * n))
    for i in range(n):
        full[:, 4 * i : 4 * i + 4, 4 * i : 4 * i + 4] = Q[:, i]
    whole = jg.largest_disturbance(**given, **loads, compliance=jnp.asarray(full))
    each = np.broadcast_to(full[:, None], (len(Q), 12, 4 * n, 4 * n))
    apart = jg.largest_disturbance(**given, **loads, compliance=jg.Compliance.per_direction(jnp.asarray(each)))
    asked = jnp.maximum(0.5 * blocks.margin, 0)
    weighed = jg.least_effort(**given, margin=asked, **loads, effort_weights=jnp.asarray(Q))
    for lane, case in enumerate(oracle(grasps, torsional)):
        on = grasps.active[lane]
        case = replace(case, compliance=turned[lane][on])
        truth = oracles.largest_disturbance(case)
        unit = max(abs(truth.margin), truth.scale)
        for ours in (blocks, whole, apart):
            assert abs(ours.margin[lane] - truth.margin) <= MARGIN_TOLERANCE * unit
    positive = np.flatnonzero(np.asarray(asked) > 1e-6)
    assert len(positive) >= 4
    for lane in positive:
        case = oracle(grasps, torsional)[lane]
        effort = oracles.least_effort(case, float(asked[lane]), turned[lane][grasps.active[lane]])
        if weighed.status[lane] == jg.Status.SOLVED:
            assert abs(weighed.effort[lane] - effort) <= EFFORT_TOLERANCE * max(effort, 1e-3)


@pytest.mark.thorough
@pytest.mark.parametrize("precision", ["float64", "float32"])
def test_kernels_and_xla_agree(precision):
    grasps, torsional = batch("absent", QUICK)
    data = soft(grasps, torsional, jnp.dtype(precision))
    ours = harness.as_numpy(harness.largest(*data))
    jax.clear_caches()
    with kernels.without():
        theirs = harness.as_numpy(harness.largest(*data))
    jax.clear_caches()
    exact = harness.as_numpy(harness.largest(*soft(grasps, torsional)))
    scale = np.array([a.scale for a in oracles.largest_disturbances(oracle(grasps, torsional))])
    unit = np.maximum(np.abs(np.fmax(exact.margin, 0)), scale)
    both = np.isfinite(ours.margin) & np.isfinite(theirs.margin)
    assert np.mean(ours.status == theirs.status) >= (1 if precision == "float64" else 0.95)
    assert np.all((np.abs(ours.margin - theirs.margin) <= SAME_MARGIN[precision] * unit)[both])
    if precision == "float32":
        solved = (ours.status == jg.Status.SOLVED) & np.isfinite(exact.margin)
        assert solved.sum() >= 0.9 * (exact.status == jg.Status.SOLVED).sum()
        assert np.all((np.abs(ours.margin - exact.margin) <= SINGLE_TOLERANCE * unit)[solved])


def test_the_strict_audit_confirms_every_answer():
    grasps, torsional = batch("mixed", QUICK)
    data = soft(grasps, torsional)
    with jg.audit("strict"), warnings.catch_warnings():
        warnings.simplefilter("error")
        found = harness.as_numpy(harness.largest(*data))
        least = harness.as_numpy(harness.least(*data, jnp.asarray(np.fmax(0.5 * found.margin, 0))))
    assert not np.any(found.status == jg.Status.NOT_VERIFIED) and not np.any(least.status == jg.Status.NOT_VERIFIED)
    assert np.sum(found.status == jg.Status.SOLVED) >= QUICK // 2


@pytest.mark.parametrize("wrong", [-0.01, np.nan, np.inf])
def test_bad_coefficients_are_invalid_for_their_lane_alone(wrong):
    grasps, torsional = problems.sample(count=2), np.full((12, 4), 0.01)
    right = harness.largest(*soft(grasps, torsional))
    bad = torsional.copy()
    bad[3, 1] = wrong
    found = harness.largest(*soft(grasps, bad))
    assert found.status[3] == jg.Status.INVALID_INPUT and np.isnan(found.margin[3]) and np.isnan(found.moments[3]).all()
    others = np.arange(12) != 3
    assert np.array_equal(np.asarray(found.margin)[others], np.asarray(right.margin)[others], equal_nan=True)


def test_ratios_are_doubted():
    with pytest.warns(UserWarning, match="torsional_friction: got 0.6, wanted metres"):
        opposed([0.6, 0.02])
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        opposed(0.5)
    with pytest.raises(ValueError, match="torsional_friction"):
        opposed([0.1, 0.1, 0.1])


def test_the_moment_of_a_hard_compliance_is_missed():
    moment = jg.DisturbanceSet.vertices(jnp.array([[0, 0, 0, 0.01, 0, 0]]))
    with pytest.raises(ValueError, match=r"compliance: got shape \(2, 3, 3\), wanted \(\*batch, 2, 4, 4\)"):
        jg.largest_disturbance(opposed(0.02), moment, compliance=np.tile(np.eye(3), (2, 1, 1)))


@pytest.mark.thorough
@pytest.mark.parametrize("smooth", [False, True])
def test_gradients_are_central_differences(smooth):
    rng = np.random.default_rng(3)
    count, n = 24, 3
    directions, axes = problems.unit_vectors(rng, count, n), rng.uniform(0.02, 0.06, (count, 1, 3))
    x = {
        "positions": directions * axes,
        "normals": directions / axes * 0.03,
        "friction": rng.uniform(0.6, 1.0, (count, n)),
        "torsional": rng.uniform(0.005, 0.02, (count, n)),
        "max_force": rng.uniform(2.0, 6.0, (count, n)),
    }
    x = {name: jnp.asarray(value) for name, value in x.items()}
    set_ = jg.DisturbanceSet.ball(0.3, 0.02)
    load = jnp.asarray(0.05 * rng.normal(size=(count, 6)) * np.repeat([1, 0.03], 3))
    kappa = 1e-6 if not smooth else 1e-3

    def outputs(x: dict, smoothing) -> dict:
        contacts = jg.Contacts.from_normals(
            x["positions"],
            x["normals"],
            friction=x["friction"],
            max_force=x["max_force"],
            torsional_friction=x["torsional"],
        )
        largest = jg.largest_disturbance(contacts, set_, required_wrench=load, smoothing=smoothing)
        least = jg.least_effort(contacts, set_, asked, required_wrench=load, smoothing=smoothing)
        return {"margin": largest.margin, "effort": least.effort, "moments": least.moments.sum(-1)}

    asked = jnp.zeros(count)
    first = jax.jit(lambda x: outputs(x, None))(x)
    asked = jnp.maximum(0.6 * first["margin"], 0)
    usable = np.asarray(first["margin"]) > 0.05
    assert usable.sum() >= count // 3
    central = jax.jit(lambda x: outputs(x, kappa))
    names = ("margin", "effort", "moments") if smooth else ("margin", "effort")
    for name in names:
        if smooth:
            gradient = jax.jit(jax.grad(lambda x, name=name: outputs(x, kappa)[name].sum()))(x)
        else:
            gradient = jax.jit(jax.grad(lambda x, name=name: jnp.where(usable, outputs(x, None)[name], 0).sum()))(x)
        for key in x:
            change = jnp.asarray(rng.normal(size=x[key].shape))
            step = STEP * float(jnp.abs(x[key]).max())
            moved = [central({**x, key: x[key] + sign * step * change})[name] for sign in (1, -1)]
            slope = np.asarray((moved[0] - moved[1]) / (2 * step))
            ours = np.asarray((gradient[key] * change).reshape(count, -1).sum(-1))
            size = np.abs(np.asarray(gradient[key] * change)).reshape(count, -1).sum(-1)
            # Where no force is at its bound the effort hardly depends on it: then by the size of what is compared.
            scale = np.maximum(size, np.abs(np.asarray(first[name])) / float(jnp.abs(x[key]).max()))
            scale = np.maximum(scale, np.median(scale[usable]))
            error = (np.abs(ours - slope) / scale)[usable]
            assert error.max() <= GRADIENT_TOLERANCE, (name, key, error)


def test_batches_of_any_shape_and_shared_contacts():
    contacts = opposed(0.02)
    wrenches = jg.DisturbanceSet.vertices(jnp.array([[0, 0, 0, 0.01, 0, 0], [0, 1.0, 0, 0, 0, 0]]))
    one = jg.largest_disturbance(contacts, wrenches)
    loads = jnp.zeros((3, 1, 2, 6))
    many = jg.largest_disturbance(contacts, wrenches, required_wrench=loads)
    assert many.moments.shape == (3, 1, 2, 2) and many.forces.shape == (3, 1, 2, 2, 3)
    assert np.allclose(many.margin, one.margin, rtol=1e-9)
    stacked = jax.tree.map(lambda x: jnp.stack([x] * 5), contacts)
    mapped = jax.vmap(lambda c: jg.largest_disturbance(c, wrenches).moments)(stacked)
    assert mapped.shape == (5, 2)


def test_sets_without_vertices_are_refused_where_all_members_share_f0():
    ball = jg.DisturbanceSet.ball(1.0, 0.01)
    with pytest.raises(ValueError, match="a set without vertices for '16' and soft contacts, wanted vertices or a box"):
        jg.formulation_margin(opposed(0.02), ball, "16")


@pytest.mark.thorough
def test_free_answers_to_a_ball():
    contacts = opposed(0.02)
    # The ball's moments about the line, and its forces, are what two opposed fingers bear least.
    found = jg.formulation_margin(contacts, jg.DisturbanceSet.ball(1.0, 0.05), "13")
    assert found.status == jg.Status.SOLVED and found.moments.shape == (2,)
    ends = np.concatenate([np.eye(6), -np.eye(6)]) * np.repeat([1, 0.05], 3)
    assert found.margin <= jg.formulation_margin(contacts, jg.DisturbanceSet.vertices(ends), "13").margin * (1 + 1e-6)
