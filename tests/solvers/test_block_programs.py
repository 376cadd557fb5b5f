"""Groups of blocks of different sizes in one program, against HiGHS."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.optimize import linprog

from jaxgrasp.contact.friction import pyramid_facets
from jaxgrasp.solvers import interior_point
from jaxgrasp.solvers.block.kkt import Blocks
from jaxgrasp.solvers.block.margin import MarginProblem

CONTACTS, BOUNDED, EQUALITIES, EDGES, LANES = 4, 3, 7, 6, 20
SETTINGS = interior_point.Settings(1e-8, 40, 1e-4, 0.0, equal_steps=False, safeguard=0.0, patience=8)


def group(rng, patterns: np.ndarray, count: int, columns: np.ndarray, start: np.ndarray) -> Blocks:
    """Blocks whose rows are all loaded; columns are (lanes, eq, count, k)."""
    rows = (len(patterns), count, LANES)
    return Blocks(
        patterns=jnp.asarray(patterns),
        columns=jnp.asarray(columns.transpose(1, 3, 2, 0)),
        sigma=jnp.asarray(rng.uniform(0.1, 1.0, rows)),
        h=jnp.asarray(rng.uniform(0.5, 1.0, rows)),
        present=jnp.ones((count, LANES)),
        hessian_root=None,
        start=jnp.asarray(start),
    )


def highs(groups: tuple[Blocks, ...], rhs: np.ndarray, lane: int) -> float:
    """max lambda over (x, lambda) of one lane, everything written out."""
    rows, loads, bounds, columns = [], [], [], []
    width = sum(g.columns.shape[1] * g.columns.shape[2] for g in groups)
    at = 0
    for g in groups:
        k, count = g.columns.shape[1:3]
        for block in range(count):
            row = np.zeros((len(g.patterns), width))
            row[:, at : at + k] = g.patterns
            at += k
            rows.append(row)
            loads.append(g.sigma[:, block, lane])
            bounds.append(g.h[:, block, lane])
            columns.append(np.asarray(g.columns[:, :, block, lane]))
    above = np.column_stack([np.concatenate(rows), np.concatenate(loads)])
    equal = np.column_stack([np.concatenate(columns, axis=1), np.zeros(EQUALITIES)])
    cost = np.append(np.zeros(width), -1.0)
    out = linprog(cost, above, np.concatenate(bounds), equal, rhs[:, lane], bounds=(None, None), method="highs")
    assert out.status == 0
    return -out.fun


@pytest.fixture(scope="module")
def programs():
    rng = np.random.default_rng(5)
    unknowns = 3 * CONTACTS + BOUNDED
    rows = np.linalg.qr(rng.normal(size=(LANES, unknowns, EQUALITIES)))[0].transpose(0, 2, 1)
    cut = 3 * CONTACTS
    cones = np.concatenate([pyramid_facets(EDGES), [[0.0, 0.0, -1.0]]])
    return (
        group(rng, cones, CONTACTS, rows[:, :, :cut].reshape(LANES, -1, CONTACTS, 3), np.array([0.0, 0.0, -0.6])),
        group(rng, np.array([[1.0], [-1.0]]), BOUNDED, rows[:, :, cut:].reshape(LANES, -1, BOUNDED, 1), np.zeros(1)),
    ), rng.normal(size=(EQUALITIES, LANES)) * 0.3


def test_contacts_and_bounded_unknowns_in_one_program(programs):
    groups, rhs = programs
    radius = 1 + 1 / np.cos(np.pi / EDGES)

    @jax.jit
    def solve(groups, rhs):
        problem = MarginProblem(groups, rhs, jnp.zeros_like(rhs), radius, 0)
        return interior_point.solve(problem, SETTINGS, jnp.ones(LANES, bool)).record

    record = solve(groups, jnp.asarray(rhs))
    truth = np.array([highs(groups, rhs, lane) for lane in range(LANES)])
    unit = np.maximum(1, np.abs(truth))
    assert np.all(np.abs(record.lower - truth) <= 1e-7 * unit)
    assert np.all(record.lower <= truth + 1e-9 * unit) and np.all(truth <= record.upper + 1e-9 * unit)
    assert [x.shape for x in record.x] == [(3, CONTACTS, LANES), (1, BOUNDED, LANES)]
