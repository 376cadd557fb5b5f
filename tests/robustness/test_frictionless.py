"""Contacts without friction push along their normals alone: against HiGHS on programs that have no other unknowns."""

from __future__ import annotations

import sys
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path

import clarabel
import jax
import jax.numpy as jnp
import numpy as np
import problems
import pytest
import scipy.sparse
from scipy.optimize import linprog

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))

import jaxgrasp as jg  # noqa: E402
from benchmarks.suite import chain  # noqa: E402
from jaxgrasp import kernels  # noqa: E402

SAME = 1e-8
"""Of max(margin, Lambda)."""
CHAIN = 1e-6
"""The same for the chain, as in test_formulations."""
SLOPE = 1e-5
"""Of max(1, sum of the absolute parts of the slope)."""

COUNT, SLOTS, EDGES, LENGTH = 200, 12, 8, 0.05
RANK = 1e-9
HIGHS = {"primal_feasibility_tolerance": 1e-10, "dual_feasibility_tolerance": 1e-10, "presolve": False}


@dataclass(frozen=True, kw_only=True)
class Grasps:
    """A batch (count, slots, ...) of grasps, absent contacts among them."""

    positions: np.ndarray
    frames: np.ndarray
    friction: np.ndarray
    max_force: np.ndarray
    active: np.ndarray
    wrenches: np.ndarray
    load: np.ndarray
    Q: np.ndarray | None = None
    reserve: float = 0.0

    def contacts(self, dtype: type = np.float64) -> jg.Contacts:
        given = (self.positions, self.frames, self.friction, self.max_force)
        positions, frames, friction, max_force = (jnp.asarray(x, dtype) for x in given)
        return jg.Contacts.from_frames(positions, frames, friction=friction, max_force=max_force, active=self.active)

    def data(self, dtype: type = np.float64) -> dict:
        Q = None if self.Q is None else jnp.asarray(self.Q, dtype)
        return {
            "disturbances": jg.DisturbanceSet.vertices(jnp.asarray(self.wrenches, dtype)),
            "required_wrench": jnp.asarray(self.load, dtype),
            "compliance": Q,
            "cone_margin": jnp.asarray(self.reserve, dtype),
        }


def around(seed: int, count: int = COUNT, kind: str = "ellipsoid") -> Grasps:
    """Contacts around ellipsoids of some centimetres, spheres, or ellipses in any plane; normal forces alone."""
    rng = np.random.default_rng(seed)
    positions, frames = problems.ellipsoid_contacts(rng, count, SLOTS, "around")
    wrenches = problems.random_wrenches(rng, count, 6, 1.0)
    present = {"ellipsoid": (9, 12), "sphere": (4, 8), "planar": (3, 7)}[kind]
    if kind == "sphere":
        positions = frames[..., 2].copy()
        wrenches[..., 3:] = 0.0
    if kind == "planar":
        turn = problems.rotations(rng, count)
        turn[: count // 2] = np.eye(3)
        angle = rng.uniform(0, 2 * np.pi, (count, SLOTS))
        ellipse = np.stack([np.cos(angle), np.sin(angle), 0 * angle], -1) * [1.0, 0.6, 0.0]
        normals = ellipse / [1.0, 0.36, 1.0]
        normals /= np.linalg.norm(normals, axis=-1, keepdims=True)
        frames = problems.frames_from_normals(normals, rng.uniform(0, 2 * np.pi, (count, SLOTS)))
        wrenches *= [1.0, 1.0, 0.0, 0.0, 0.0, 1.0]
        positions, frames = ellipse @ turn.swapaxes(-1, -2), turn[:, None] @ frames
        wrenches = np.concatenate(
            [wrenches[..., :3] @ turn.swapaxes(-1, -2), wrenches[..., 3:] @ turn.swapaxes(-1, -2)], -1
        )
    active = np.arange(SLOTS) < rng.integers(present[0], present[1] + 1, count)[:, None]
    return Grasps(
        positions=LENGTH * positions,
        frames=frames,
        friction=np.zeros((count, SLOTS)),
        max_force=np.exp(rng.uniform(np.log(2.0), np.log(10.0), (count, SLOTS))),
        active=rng.permuted(active, axis=-1),
        wrenches=wrenches * np.repeat([1.0, LENGTH], 3),
        load=np.zeros((count, 6)),
    )


def mixed(seed: int, count: int = COUNT, compliant: bool = True) -> Grasps:
    """Every other contact with friction, some with a load that they reach and a Q in blocks."""
    rng, made = np.random.default_rng(seed), around(seed, count)
    friction = np.where(rng.random((count, SLOTS)) < 0.5, 0.0, rng.uniform(0.2, 1.0, (count, SLOTS)))
    M = rng.normal(size=(count, SLOTS, 3, 3))
    Q = 0.5 * np.eye(3) + M @ M.swapaxes(-1, -2) if compliant else None
    active = np.arange(SLOTS) < rng.integers(3, 8, count)[:, None]
    return replace(
        made, friction=friction, Q=Q, active=active, load=0.3 * made.wrenches[:, 0] * (rng.random((count, 1)) < 0.3)
    )


def columns(g: Grasps, lane: int) -> tuple[np.ndarray, np.ndarray, list[tuple[int, slice]]]:
    """G with moments over its size for the components that there are, these, and each contact's place among them."""
    on = np.flatnonzero(g.active[lane])
    size = np.sqrt(np.mean(np.sum(g.positions[lane, on] ** 2, -1)))
    found, places, components, start = [], [], [], 0
    for i in on:
        axes = [0, 1, 2] if g.friction[lane, i] > 0 else [2]
        for axis in axes:
            arm = g.frames[lane, i, :, axis]
            found.append(np.concatenate([arm, np.cross(g.positions[lane, i], arm) / size]))
            components.append(3 * i + axis)
        places.append((i, slice(start, start + len(axes))))
        start += len(axes)
    return np.array(found).T, np.array(components), places


def rows_of(g: Grasps, lane: int, G: np.ndarray, places: list) -> tuple[np.ndarray, ...]:
    """Rows A f <= h and their units: pyramids, no pull without friction, then the bounds."""
    A, h, units = [], [], []
    for i, place in places:
        mu, F = g.friction[lane, i], g.max_force[lane, i]
        k = np.cos(np.pi / EDGES)
        if mu > 0:
            angle = (2 * np.arange(EDGES) + 1) * np.pi / EDGES
            facets, unit = np.stack([np.cos(angle), np.sin(angle), 0 * angle + k * mu], -1), mu * F
        else:
            facets, unit = np.full((1, 1), k), F
        block = np.vstack([facets, np.eye(facets.shape[1])[-1:] * -1])
        wide = np.zeros((len(block), G.shape[1]))
        wide[:, place] = block
        A.append(wide)
        h += [*[-g.reserve] * len(facets), F]
        units += [*[unit] * len(facets), F]
    return np.vstack(A), np.array(h), np.array(units)


def weighted_inverse(g: Grasps, lane: int, G: np.ndarray, components: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """G* of the components that there are, and an orthonormal basis of the range of G."""
    Q = np.eye(len(components))
    if g.Q is not None:
        whole = np.zeros((3 * SLOTS,) * 2)
        for i, block in enumerate(g.Q[lane]):
            whole[3 * i : 3 * i + 3, 3 * i : 3 * i + 3] = block
        Q = whole[np.ix_(components, components)]
    root = np.linalg.inv(np.linalg.cholesky(Q)).T
    left, values, _ = np.linalg.svd(G, full_matrices=False)
    return root @ np.linalg.pinv(G @ root, RANK), left[:, values > RANK * values[0]]


def of_highs(g: Grasps, lane: int) -> tuple[float, float]:
    """The margin with no unknowns but forces that there are, and its natural scale; nan where the load is not borne."""
    G, components, places = columns(g, lane)
    A, h, units = rows_of(g, lane, G, places)
    size = np.sqrt(np.mean(np.sum(g.positions[lane, g.active[lane]] ** 2, -1)))
    scale = np.repeat([1.0, 1 / size], 3)
    inverse, basis = weighted_inverse(g, lane, G, components)
    W, b = g.wrenches[lane] * scale, g.load[lane] * scale
    outside = lambda w: np.linalg.norm(w - w @ basis @ basis.T, axis=-1) > 1e-8  # noqa: E731
    sigma = np.maximum((-W @ inverse.T @ A.T).max(0), 0) / units
    natural = 1 / sigma.max() if sigma.max() > 0 else 1.0
    never = outside(W).any()
    last = (np.ones_like(sigma) if never else sigma * natural)[:, None]
    F = np.array([g.max_force[lane, c // 3] for c in components])
    rows = np.hstack([A * F / units[:, None], last])
    equal = np.hstack([basis.T @ G * F, np.zeros((basis.shape[1], 1))])
    cost = np.append(np.zeros(len(F)), -1.0)
    if outside(b[None]).any():
        return np.nan, natural
    found = linprog(cost, rows, h / units, equal, basis.T @ b, (None, None), "highs", options=HIGHS)
    if found.status == 2:
        return np.nan, natural
    assert found.status == 0
    if never:
        return (0.0 if -found.fun >= -1e-9 else np.nan), 0.0
    return -found.fun * natural, natural


FAMILIES = {
    "ellipsoids": around(1),
    "spheres": around(2, kind="sphere"),
    "planar": around(3, kind="planar"),
    "mixed": mixed(4),
    "mixed, with a reserve": replace(mixed(5, compliant=False), reserve=0.05),
}


@cache
def truth(name: str) -> tuple[np.ndarray, np.ndarray]:
    g = FAMILIES[name]
    margins, scales = zip(*(of_highs(g, lane) for lane in range(COUNT)), strict=True)
    return np.array(margins), np.array(scales)


def compare(name: str, found: jg.Solution, tolerance: float) -> None:
    margins, scales = truth(name)
    ours, status = np.asarray(found.margin), np.asarray(found.status)
    bearable = margins >= -tolerance * scales
    np.testing.assert_array_equal(status, np.where(bearable, jg.Status.SOLVED, jg.Status.INFEASIBLE))
    away = np.abs(ours - margins)[bearable]
    assert np.all(away <= tolerance * np.maximum(margins, scales)[bearable])
    assert (margins[bearable] > 1e-6).mean() > 0.2 and not (ours[~bearable] >= 0).any()
    smooth = FAMILIES[name].friction == 0
    assert not np.asarray(found.forces)[bearable][smooth[bearable]][:, :2].any()


@pytest.mark.parametrize("name", FAMILIES)
def test_margins_are_those_of_normal_forces(name):
    g = FAMILIES[name]
    with jg.audit("strict"):
        compare(name, jg.largest_disturbance(g.contacts(), **g.data()), SAME)


@pytest.mark.thorough
@pytest.mark.parametrize("name", ["planar", "mixed"])
def test_without_kernels(name):
    g = FAMILIES[name]
    with kernels.without():
        compare(name, jg.largest_disturbance(g.contacts(), **g.data()), SAME)


@pytest.mark.thorough
def test_float32_tells_what_it_can():
    """Contacts off the axes leave the rank of normals in doubt; in the plane of two axes rows of G are zero exactly."""
    for name, share in (("ellipsoids", 0.9), ("planar", 0.5), ("mixed", 0.75)):
        g, (margins, scales) = FAMILIES[name], truth(name)
        found = jg.largest_disturbance(g.contacts(np.float32), **g.data(np.float32))
        solved = np.asarray(found.status) == jg.Status.SOLVED
        away = np.abs(np.asarray(found.margin) - margins)[solved]
        assert np.all(away <= 1e-4 * np.maximum(margins, scales)[solved])
        assert solved.mean() >= share
        rest = np.asarray(found.status)[~solved]
        bears = margins[~solved] >= 0
        np.testing.assert_array_equal(rest, np.where(bears, jg.Status.ILL_CONDITIONED, jg.Status.INFEASIBLE))


def test_pseudo_inverses_are_those_of_numpy():
    g = mixed(7, 100)
    ours = np.asarray(jg.weighted_pseudo_inverse(g.contacts(), g.Q))
    for lane in range(len(ours)):
        G, components, _ = columns(g, lane)
        wanted = np.zeros((3 * SLOTS, 6))
        inverse, basis = weighted_inverse(g, lane, G, components)
        wanted[components] = inverse
        size = np.sqrt(np.mean(np.sum(g.positions[lane, g.active[lane]] ** 2, -1)))
        # Of wrenches in the range of G.
        away = (ours[lane] * np.repeat([1.0, size], 3) - wanted) @ basis
        assert np.abs(away).max() <= 1e-11 * np.abs(wanted).max()
        assert not ours[lane][np.setdiff1d(np.arange(3 * SLOTS), components)].any()


def full(Q: np.ndarray) -> np.ndarray:
    """Blocks of contacts as one matrix."""
    whole = np.zeros((*Q.shape[:-3], 3 * SLOTS, 3 * SLOTS))
    for i in range(SLOTS):
        whole[..., 3 * i : 3 * i + 3, 3 * i : 3 * i + 3] = Q[..., i, :, :]
    return whole


@pytest.mark.thorough
def test_the_form_of_the_compliance_does_not_matter():
    g = mixed(8, 64)
    blocks = jg.largest_disturbance(g.contacts(), **g.data())
    each = jg.Compliance.per_direction(np.repeat(g.Q[:, None], 6, 1))
    for Q in (full(g.Q), each):
        found = jg.largest_disturbance(g.contacts(), **(g.data() | {"compliance": Q}))
        np.testing.assert_array_equal(found.status, blocks.status)
        np.testing.assert_allclose(found.margin, blocks.margin, rtol=SAME, atol=SAME)


def effort_of_clarabel(g: Grasps, lane: int, margin: float, weights: np.ndarray) -> float:
    """(22) with no unknowns but forces that there are."""
    G, components, places = columns(g, lane)
    A, h, units = rows_of(g, lane, G, places)
    inverse, basis = weighted_inverse(g, lane, G, components)
    size = np.sqrt(np.mean(np.sum(g.positions[lane, g.active[lane]] ** 2, -1)))
    scale = np.repeat([1.0, 1 / size], 3)
    sigma = np.maximum((-(g.wrenches[lane] * scale) @ inverse.T @ A.T).max(0), 0)
    P = full(weights[lane])[np.ix_(components, components)]
    settings = clarabel.DefaultSettings()
    settings.verbose = False
    settings.tol_gap_abs = settings.tol_gap_rel = settings.tol_feas = 1e-11
    rows = scipy.sparse.csc_matrix(np.vstack([basis.T @ G, A / units[:, None]]))
    right = np.concatenate([basis.T @ (g.load[lane] * scale), (h - margin * sigma) / units])
    cones = [clarabel.ZeroConeT(basis.shape[1]), clarabel.NonnegativeConeT(len(h))]
    P = scipy.sparse.csc_matrix(np.triu(P))
    return clarabel.DefaultSolver(P, np.zeros(len(components)), rows, right, cones, settings).solve().obj_val


@pytest.mark.thorough
@pytest.mark.parametrize("name", ["spheres", "mixed"])
def test_efforts_are_those_of_clarabel(name):
    g = FAMILIES[name]
    margins = truth(name)[0]
    rows = np.flatnonzero(margins > 1e-3)[:40]
    g = picked(g, rows)
    M = np.random.default_rng(9).normal(size=(len(rows), SLOTS, 3, 3))
    weights = np.eye(3) + 0.3 * M @ M.swapaxes(-1, -2)
    asked = 0.75 * margins[rows]
    with jg.audit("strict"):
        given = g.contacts(), g.data()["disturbances"], asked, g.load, g.Q
        found = jg.least_effort(*given, effort_weights=weights)
    assert (np.asarray(found.status) == jg.Status.SOLVED).all()
    wanted = np.array([effort_of_clarabel(g, lane, asked[lane], weights) for lane in range(len(rows))])
    np.testing.assert_allclose(found.effort, wanted, rtol=1e-6)
    assert not np.asarray(found.forces)[g.friction == 0][:, :2].any()


def chain_batch(count: int) -> chain.Batch:
    made = chain.sample(13, count, 5, 6)
    friction = np.where(np.random.default_rng(14).random(made.friction.shape) < 0.3, 0.0, made.friction)
    return replace(made, friction=friction)


@pytest.mark.thorough
@pytest.mark.parametrize("name", ["12", "12_fixed", "13", "16"])
def test_the_chain_is_that_of_whole_programs(name):
    batch = chain_batch(60)
    contacts = jg.Contacts.from_frames(
        batch.positions, batch.frames, friction=batch.friction, max_force=batch.max_force
    )
    sets = jg.DisturbanceSet.vertices(batch.wrenches)
    with jg.audit("strict"):
        found = jg.formulation_margin(contacts, sets, name, batch.load)
    wanted = np.array([chain.ORACLES[name](batch.case(i)) for i in range(len(batch))])
    known = ~np.isinf(wanted)
    ours = np.asarray(found.margin)
    np.testing.assert_array_equal(np.isnan(ours)[known], np.isnan(wanted)[known])
    both = known & ~np.isnan(wanted)
    assert both.sum() > 30 and (wanted[both] > 1e-3).mean() > 0.5
    scale = np.array([batch.case(i).scale for i in range(len(batch))])
    assert np.all(np.abs(ours - wanted)[both] <= CHAIN * np.maximum(wanted, scale)[both])
    smooth = batch.friction == 0
    assert not np.nan_to_num(np.asarray(found.forces))[smooth][:, :2].any()
    assert not np.nan_to_num(np.moveaxis(np.asarray(found.disturbed_forces), 1, 2))[smooth][..., :2].any()


@pytest.mark.thorough
def test_least_total_effort_is_clarabels():
    batch = chain_batch(24)
    contacts = jg.Contacts.from_frames(
        batch.positions, batch.frames, friction=batch.friction, max_force=batch.max_force
    )
    sets = jg.DisturbanceSet.vertices(batch.wrenches)
    asked = 0.5 * np.nan_to_num(np.asarray(jg.formulation_margin(contacts, sets, "13", batch.load).margin))
    with jg.audit("strict"):
        found = jg.least_total_effort(contacts, sets, asked, batch.load)
    solved = np.asarray(found.status) == jg.Status.SOLVED
    assert solved.sum() > 12
    for i in np.flatnonzero(solved):
        wanted = chain.least_total_effort(batch.case(i), asked[i])
        assert abs(found.effort[i] - wanted) <= 1e-6 * max(wanted, 1e-3 * batch.max_force[i].max() ** 2)
    smooth = batch.friction[solved] == 0
    assert not np.asarray(found.forces)[solved][smooth][:, :2].any()
    assert not np.moveaxis(np.asarray(found.changes)[solved], 1, 2)[smooth][..., :2].any()


def few(count: int) -> Grasps:
    """Grasps of six contacts, two of them without friction, that all have a margin."""
    made = mixed(21, 8 * count, compliant=False)
    spread = lambda row: np.tile(row, (8 * count, 1))  # noqa: E731
    places = np.arange(SLOTS)
    made = replace(
        made, friction=spread(np.where(places % 3 == 0, 0.0, 0.6)), active=spread(places < 6), load=0 * made.load
    )
    rows = np.flatnonzero([of_highs(made, lane)[0] > 0.1 for lane in range(8 * count)])[:count]
    assert len(rows) == count
    return picked(made, rows)


def picked(g: Grasps, rows: np.ndarray) -> Grasps:
    return Grasps(**{name: x[rows] if isinstance(x, np.ndarray) else x for name, x in vars(g).items()})


@pytest.mark.parametrize("with_set", [False, pytest.param(True, marks=pytest.mark.thorough)])
def test_derivatives(with_set):
    """At friction 0 that of friction is zero: the frictionless contact is a model of its own."""
    g, rng = few(8), np.random.default_rng(22)

    def margins(positions, friction, max_force, load, wrenches=g.wrenches):
        contacts = jg.Contacts.from_frames(positions, g.frames, friction=friction, max_force=max_force, active=g.active)
        return jg.largest_disturbance(contacts, jg.DisturbanceSet.vertices(wrenches), load).margin

    x = (g.positions, g.friction, g.max_force, 0.02 * g.wrenches[:, 0], g.wrenches)[: 5 if with_set else 4]
    slopes = jax.jit(jax.grad(lambda *x: margins(*x).sum(), argnums=range(len(x))))(*x)
    assert not np.asarray(slopes[1])[g.friction == 0].any() and np.asarray(slopes[1])[g.friction > 0].any()
    for i, at in enumerate(x):
        change, away = rng.normal(size=at.shape) * (at > 0 if i == 1 else 1), []
        parts = np.asarray(slopes[i] * change).reshape(len(at), -1)
        size = np.maximum(1, np.abs(parts).sum(-1))
        # Long steps cross kinks, short ones feel the solver's tolerance.
        for step in (1e-5, 1e-6):
            sides = [margins(*x[:i], at + sign * step * change, *x[i + 1 :]) for sign in (1, -1)]
            away.append(np.abs(parts.sum(-1) - (sides[0] - sides[1]) / (2 * step)) / size)
        assert np.all(np.min(away, 0) <= SLOPE)


@pytest.mark.thorough
def test_derivatives_of_forces():
    g, rng = few(4), np.random.default_rng(23)
    weights = np.where(g.friction[..., None] > 0, rng.normal(size=(4, SLOTS, 3)), rng.normal(size=(4, SLOTS, 1)))
    asked = 0.5 * np.array([of_highs(g, lane)[0] for lane in range(4)])

    def total(positions, max_force, sideways):
        contacts = jg.Contacts.from_frames(
            positions, g.frames, friction=g.friction, max_force=max_force, active=g.active
        )
        found = jg.least_effort(contacts, jg.DisturbanceSet.vertices(g.wrenches), asked, smoothing=1e-3)
        # Tangential forces that are zero whatever happens have no share in it.
        counted = jnp.asarray(weights).at[..., :2].multiply(jnp.where(g.friction > 0, 1.0, sideways)[..., None])
        return jnp.sum(found.forces * counted) + found.effort.sum()

    x, slope = (g.positions, g.max_force), jax.jit(jax.grad(total, (0, 1)))
    found = slope(*x, 1.0)
    for one, other in zip(found, slope(*x, 0.0), strict=True):
        np.testing.assert_array_equal(one, other)
    for i, step in enumerate((1e-6, 1e-5)):
        change = rng.normal(size=x[i].shape)
        sides = [total(*x[:i], x[i] + sign * step * change, *x[i + 1 :], 1.0) for sign in (1, -1)]
        difference = (sides[0] - sides[1]) / (2 * step)
        assert abs(np.sum(found[i] * change) - difference) <= SLOPE * max(1, abs(difference))


def test_neighbours_with_friction_do_not_notice():
    g = few(8)
    rough = replace(g, friction=np.full_like(g.friction, 0.6))
    both = replace(g, friction=np.where(np.arange(8)[:, None] % 2, g.friction, rough.friction))
    found, alone = (jg.largest_disturbance(x.contacts(), **x.data()) for x in (both, rough))
    same = lambda a, b: np.testing.assert_array_equal(np.asarray(a)[::2], np.asarray(b)[::2])  # noqa: E731
    jax.tree.map(same, found, alone)
    assert (np.asarray(found.margin)[1::2] != np.asarray(alone.margin)[1::2]).all()
