"""The chain's formulations for boxes, balls, ellipsoids and sums: against their vertices, and dense samplings."""

from __future__ import annotations

import itertools
import sys
from dataclasses import replace
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial import ConvexHull

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))

import jaxgrasp as jg  # noqa: E402
from benchmarks.suite import chain  # noqa: E402
from jaxgrasp.robustness.chain.programs import FORMULATIONS  # noqa: E402

TOLERANCE = 1e-4
"""How far bounds may be apart, of the upper one: what is promised."""

SAME = 1e-6
"""Of max(margin, Lambda): what a formulation and its oracle may differ by for the same vertices."""

UNITS = np.repeat([1.0, 0.05], 3)
HALF = np.array([1.0, 0.3, 0.5, 0.02, 0.0, 0.01])


def contacts_of(batch: chain.Batch) -> jg.Contacts:
    return jg.Contacts.from_frames(batch.positions, batch.frames, friction=batch.friction, max_force=batch.max_force)


def ellipsoid(rank: int) -> np.ndarray:
    return (np.random.default_rng(rank).normal(size=(6, rank)) * UNITS[:, None]) @ np.eye(rank, 6) * 0.4


def sphere(count: int, rank: int) -> tuple[np.ndarray, float]:
    """Points of a sphere in 2 or 3 dimensions, and the factor by which their hull has to grow to hold all of it."""
    if rank == 2:
        angle = 2 * np.pi * np.arange(count) / count
        return np.stack([np.cos(angle), np.sin(angle)], -1), 1 / np.cos(np.pi / count)
    k = np.arange(count) + 0.5
    z, angle = 1 - 2 * k / count, np.pi * (1 + 5**0.5) * k
    points = np.stack([np.sqrt(1 - z**2) * np.cos(angle), np.sqrt(1 - z**2) * np.sin(angle), z], -1)
    return points, float(1 / np.abs(ConvexHull(points).equations[:, -1]).min())


def sampled(rank: int, count: int) -> tuple[jg.DisturbanceSet, np.ndarray, float]:
    """A set, members of it all around, and the factor by which their hull has to grow to hold it."""
    points, growth = sphere(count, rank)
    if rank == 2:
        return jg.DisturbanceSet.ellipsoid(jnp.asarray(ellipsoid(2))), points @ ellipsoid(2)[:, :2].T, growth
    return jg.DisturbanceSet.ball(1.0), points @ np.eye(3, 6), growth


def oracle(case: chain.Case, name: str) -> float:
    # A single program of hundreds of directions is slow where they are tied by nothing but an f_0 that there is.
    return chain.ORACLES["per_direction" if name == "13" else name](case)


def solved(found: jg.FormulationSolution) -> np.ndarray:
    return np.asarray(found.status) == jg.Status.SOLVED


@pytest.mark.parametrize("name", ["13"])
def test_a_box_is_its_corners(name: str) -> None:
    batch = chain.sample(3, 32, 3, 6)
    turn = np.linalg.qr(np.random.default_rng(0).normal(size=(3, 3)))[0]
    turn *= np.sign(np.linalg.det(turn))
    corners = np.array(list(itertools.product((-1.0, 1.0), repeat=6))) * HALF
    corners = np.concatenate([corners[:, :3] @ turn.T, corners[:, 3:] @ turn.T], 1)
    box = jg.DisturbanceSet.box(HALF).rotated(turn)
    ours = jg.formulation_margin(contacts_of(batch), box, name, batch.load)
    truth = jg.formulation_margin(contacts_of(batch), jg.DisturbanceSet.vertices(corners), name, batch.load)
    np.testing.assert_allclose(ours.margin, truth.margin, rtol=1e-9, atol=1e-9)
    np.testing.assert_array_equal(ours.status, truth.status)
    assert np.sum(np.asarray(ours.margin) > 0.01) > 1 and ours.worst_wrench is None


@pytest.mark.thorough
@pytest.mark.parametrize("name", FORMULATIONS)
def test_a_box_is_its_corners_in_every_formulation(name: str) -> None:
    test_a_box_is_its_corners(name)


def test_a_ball_by_its_dense_sampling() -> None:
    agree(chain.sample(3, 24, 3, 6), "13", 2, 60)


@pytest.mark.thorough
@pytest.mark.parametrize("rank", [2, 3])
@pytest.mark.parametrize("name", FORMULATIONS)
def test_low_dimensions_by_dense_samplings(name: str, rank: int) -> None:
    agree(chain.sample(50 + rank, 200, 4, 6), name, rank, {2: 360, 3: 400}[rank])


def agree(batch: chain.Batch, name: str, rank: int, count: int) -> None:
    """The bounds against those that a dense sampling gives: its own margin, and that shrunk until it holds the set."""
    disturbances, members, growth = sampled(rank, count)
    found = jg.formulation_margin(contacts_of(batch), disturbances, name, batch.load)
    margin, upper, status = (np.asarray(x) for x in (found.margin, found.upper_bound, found.status))
    cases = [replace(batch.case(i), wrenches=members) for i in range(len(batch))]
    truth = np.array([oracle(case, name) for case in cases])
    unit = SAME * np.maximum(np.where(np.isfinite(truth), truth, 0), [case.scale for case in cases])
    known, has_margin = ~np.isinf(truth), np.isfinite(margin)
    assert known.mean() > 0.98 and solved(found).mean() > 0.3
    undecided = status == jg.Status.MAX_ITERATIONS
    print(f"{name} in {rank} dimensions: {has_margin.sum()} margins, {undecided.sum()} undecided")
    assert undecided.mean() <= 0.01
    np.testing.assert_array_equal(np.isnan(truth)[known & ~undecided], np.isnan(margin)[known & ~undecided])
    both = known & has_margin & np.isfinite(truth)
    assert np.all((margin <= truth + unit)[both]) and np.all((growth * upper >= truth - unit)[both])
    gap = 1 - margin / np.where(upper > 0, upper, 1)
    positive = solved(found) & (margin > 0)
    assert np.all(gap[positive] <= TOLERANCE) and positive.mean() > 0.2
    if len(batch) > 100:
        off = np.maximum(margin - truth, truth / growth - upper)[both & positive] / truth[both & positive]
        print(f"largest gap {gap[positive].max():.1e}, most beyond the sampling's bounds {off.max():.1e}")


SETS = {
    "ball": lambda: jg.DisturbanceSet.ball(1.0, 0.03),
    "ellipsoid": lambda: jg.DisturbanceSet.ellipsoid(jnp.asarray(ellipsoid(6))),
    "sum": lambda: jg.DisturbanceSet.box(0.3 * HALF) + jg.DisturbanceSet.ball(0.4),
    "one-sided sum": lambda: (
        jg.DisturbanceSet.vertices(np.array([[0, 0, -1.0, 0, 0, 0], [0.2, 0, -0.8, 0, 0.01, 0]]))
        + jg.DisturbanceSet.ball(0.2, 0.005)
    ),
}


def members_of(disturbances: jg.DisturbanceSet, count: int) -> np.ndarray:
    """Random members of a set's boundary: gradients of its support function."""
    directions = jnp.asarray(np.random.default_rng(1).normal(size=(count, 6)) / UNITS)
    gradient = jax.grad(lambda a: disturbances.support(a).sum())
    return np.asarray(gradient(directions))


@pytest.mark.thorough
@pytest.mark.parametrize("kind", SETS)
@pytest.mark.parametrize("name", FORMULATIONS)
def test_six_dimensions_by_members(name: str, kind: str) -> None:
    """The upper bound is the margin of a member, by HiGHS and Clarabel, and no other member has less than the lower."""
    batch, disturbances = chain.sample(60, 200, 4, 6), SETS[kind]()
    found = jg.formulation_margin(contacts_of(batch), disturbances, name, batch.load)
    margin, upper = np.asarray(found.margin), np.asarray(found.upper_bound)
    print(f"{name}, {kind}: {np.bincount(found.status, minlength=6)} by status")
    assert np.mean(np.asarray(found.status) == jg.Status.MAX_ITERATIONS) <= 0.01
    positive = np.flatnonzero(solved(found) & (margin > 1e-3))
    assert len(positive) > 30 and np.all(1 - margin[positive] / upper[positive] <= TOLERANCE)
    members = members_of(disturbances, 60)
    for i in positive:
        case = replace(batch.case(i), wrenches=members)
        others = oracle(case, name)
        assert np.isinf(others) or margin[i] <= others + SAME * max(others, case.scale)
        if found.worst_wrench is not None:
            worst = np.asarray(found.worst_wrench[i])
            # A member: within every half space of the set.
            a = jnp.asarray(np.random.default_rng(2).normal(size=(2000, 6)) / UNITS)
            assert np.all(a @ worst <= disturbances.support(a) * (1 + 1e-9))
            if name not in ("12_fixed", "16"):
                case = replace(case, wrenches=worst[None])
                alone = oracle(case, name)
                assert np.isinf(alone) or abs(alone - upper[i]) <= SAME * max(alone, case.scale)


@pytest.mark.thorough
@pytest.mark.parametrize("kind", SETS)
def test_forces_answer_the_worst_member(kind: str) -> None:
    batch = chain.sample(61, 40, 4, 6)
    G = np.asarray(jg.grasp_map(contacts_of(batch)))
    for name in ("12", "12_fixed", "13"):
        found = jg.formulation_margin(contacts_of(batch), SETS[kind](), name, batch.load)
        held = solved(found) & (np.asarray(found.margin) > 1e-3)
        forces = np.concatenate([np.asarray(found.forces)[:, None], found.disturbed_forces], 1)[held]
        wanted = np.stack(
            [batch.load, batch.load - np.asarray(found.margin)[:, None] * np.asarray(found.worst_wrench)], 1
        )
        supplied = np.einsum("brc,bdc->bdr", G[held], forces.reshape(len(forces), 2, -1))
        np.testing.assert_allclose(supplied, wanted[held], atol=1e-6)
        slip = np.linalg.norm(forces[..., :2], axis=-1) + batch.friction[held][:, None] * forces[..., 2]
        assert slip.max() <= 1e-6 and np.all(-forces[..., 2] <= batch.max_force[held][:, None] + 1e-6)


def test_sixteen_is_twenty_one_for_any_set() -> None:
    batch = chain.sample(3, 24, 3, 6)
    disturbances = SETS["sum"]()
    reduced = np.asarray(jg.largest_disturbance(contacts_of(batch), disturbances, batch.load).margin)
    margin = lambda: jg.formulation_margin(contacts_of(batch), disturbances, "16", batch.load).margin  # noqa: E731
    ours = np.asarray(jax.jit(margin)())
    borne = reduced >= 0
    np.testing.assert_array_equal(borne, np.isfinite(ours))
    np.testing.assert_allclose(ours[borne], reduced[borne], rtol=1e-7, atol=1e-7)
    assert borne.mean() > 0.3


@pytest.mark.thorough
@pytest.mark.parametrize("kind", SETS)
def test_the_chain_for_any_set(kind: str) -> None:
    batch = chain.sample(11, 100, 4, 12)
    found = jg.compare_formulations(contacts_of(batch), SETS[kind](), batch.load)
    m = {name: np.asarray(v) for name, v in found.margins.items()}
    borne = np.isfinite(m["16"])
    np.testing.assert_allclose(m["16"][borne], m["21"][borne], rtol=1e-7, atol=1e-7)
    chains = ("16", "13"), ("13", "12"), ("16", "12_fixed"), ("12_fixed", "12"), ("16", "per_direction_prestrained")
    for less, more in chains:
        upper = np.asarray(found.upper_bounds[more])
        assert np.all((m[less] <= upper + 1e-7 * np.maximum(1, upper))[borne & np.isfinite(m[more])]), (less, more)


def test_what_cannot_be_refined_is_told_in_a_line() -> None:
    contacts = contacts_of(chain.sample(3, 8, 3, 6))
    ball, forces = jg.DisturbanceSet.ball(1.0), jg.DisturbanceSet.forces()
    with pytest.raises(ValueError, match="inside jit, vmap or grad") as raised:
        jax.jit(lambda c: jg.formulation_margin(c, ball, "13").margin)(contacts)
    assert "\n" not in str(raised.value)
    with pytest.raises(ValueError, match="12_fixed"):
        jg.formulation_margin(contacts, ball, "12_fixed", force_bound="norm")
    with pytest.raises(ValueError, match="tolerance: got 0"):
        jg.formulation_margin(contacts, ball, "13", tolerance=0)
    with pytest.raises(ValueError, match="smoothed"):
        jg.formulation_margin(contacts, forces.smoothed(0.1), "13")
    with pytest.raises(ValueError, match="one Q for each direction"):
        jg.formulation_margin(contacts, ball, "13", None, jg.Compliance.per_direction(np.tile(np.eye(9), (2, 1, 1))))


def test_bad_and_empty_grasps_stay_with_themselves() -> None:
    """Without contacts nothing is withstood, and a load is not borne."""
    batch = chain.sample(3, 8, 3, 6)
    contacts = contacts_of(batch)
    broken = replace(
        contacts,
        positions=contacts.positions.at[1].set(jnp.nan),
        active=jnp.ones((8, 3), bool).at[0].set(False),
    )
    radii = np.r_[np.ones(7), -1.0]
    for disturbances in (jg.DisturbanceSet.forces(), jg.DisturbanceSet.ball(radii)):
        found = jg.formulation_margin(broken, disturbances, "13")
        assert found.status[0] == jg.Status.SOLVED and found.margin[0] == 0 and found.upper_bound[0] == 0
        assert found.status[1] == jg.Status.INVALID_INPUT and np.isnan(found.margin[1])
        assert np.all(np.isfinite(found.margin[2:7])) and np.max(found.margin[2:7]) > 0.1
    assert found.status[7] == jg.Status.INVALID_INPUT and np.isnan(found.margin[7])
    load = np.tile([0, 0, 1.0, 0, 0, 0], (8, 1))
    assert jg.formulation_margin(broken, jg.DisturbanceSet.forces(), "13", load).status[0] == jg.Status.INFEASIBLE
    nothing = jg.formulation_margin(broken, jg.DisturbanceSet.forces(0.0), "13")
    assert nothing.status[0] == jg.Status.UNBOUNDED and np.isinf(nothing.margin[0])


@pytest.mark.thorough
@pytest.mark.parametrize("name", FORMULATIONS)
def test_empty_grasps_in_every_formulation(name: str) -> None:
    contacts = contacts_of(chain.sample(3, 8, 3, 6))
    contacts = replace(contacts, active=jnp.zeros((8, 3), bool))
    for disturbances in (jg.DisturbanceSet.forces(), jg.DisturbanceSet.ball(1.0), jg.DisturbanceSet.box(HALF)):
        found = jg.formulation_margin(contacts, disturbances, name)
        assert np.all(solved(found)) and np.all(np.asarray(found.margin) == 0)


@pytest.mark.thorough
def test_shapes_and_precision() -> None:
    batch = chain.sample(3, 6, 3, 6)
    flat = jg.formulation_margin(contacts_of(batch), SETS["ball"](), "13", batch.load)
    shaped = jax.tree.map(lambda x: x.reshape(3, 1, 2, *x.shape[1:]), contacts_of(batch))
    found = jg.formulation_margin(shaped, SETS["ball"](), "13", batch.load.reshape(3, 1, 2, 6))
    assert found.margin.shape == (3, 1, 2) and found.disturbed_forces.shape == (3, 1, 2, 1, 3, 3)
    np.testing.assert_array_equal(found.margin.reshape(-1), flat.margin)
    one = jg.formulation_margin(jax.tree.map(lambda x: x[2], contacts_of(batch)), SETS["ball"](), "13", batch.load[2])
    np.testing.assert_allclose(one.margin, flat.margin[2], rtol=TOLERANCE)
    none = jg.formulation_margin(jax.tree.map(lambda x: x[:0], contacts_of(batch)), SETS["ball"](), "13")
    assert none.margin.shape == (0,)
    single = jax.tree.map(lambda x: x.astype(np.float32) if x.dtype != bool else x, contacts_of(batch))
    for name in ("12", "12_fixed", "13"):
        double = jg.formulation_margin(contacts_of(batch), SETS["ball"](), name)
        coarse = jg.formulation_margin(single, SETS["ball"](), name)
        assert coarse.margin.dtype == np.float32
        np.testing.assert_array_equal(coarse.status, double.status)
        np.testing.assert_allclose(coarse.margin, double.margin, rtol=1e-2, atol=1e-3)
