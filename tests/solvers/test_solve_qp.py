"""solve_qp against HiGHS, Clarabel and certificates that NumPy checks, on programs by published recipes."""

import clarabel
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import qp_recipes
from scipy import sparse
from scipy.optimize import linprog

from jaxgrasp.solvers import solve_qp
from jaxgrasp.solvers.status import Status

# What users of float64 ask of a QP solver; of float32's seven digits an interior point keeps three to five.
ERROR = {"float64": 1e-6, "float32": 1e-3}
# Objectives of independent solvers that stop at 1e-8.
OBJECTIVE = 1e-6
LANES = 25

solve = jax.jit(solve_qp)


def lanes_of(solution):
    solution = jax.tree.map(np.asarray, solution)
    return [jax.tree.map(lambda v, lane=lane: v[lane], solution) for lane in range(len(solution.status))]


def clarabel_objective(P, q, A, b, G, h):
    settings = clarabel.DefaultSettings()
    settings.verbose = False
    cones = [clarabel.ZeroConeT(len(b)), clarabel.NonnegativeConeT(len(h))]
    rows, right = sparse.csc_matrix(np.vstack([A, G])), np.concatenate([b, h])
    answer = clarabel.DefaultSolver(sparse.csc_matrix(np.triu(P)), q, rows, right, cones, settings).solve()
    return answer.obj_val if "Solved" in str(answer.status) else np.nan


def highs(q, A, b, G, h):
    return linprog(q, A_ub=G, b_ub=h, A_eq=A, b_eq=b, bounds=(None, None), method="highs")


@pytest.mark.parametrize(
    "dtype, size",
    [
        ("float64", qp_recipes.SIZES[1]),
        ("float32", qp_recipes.SIZES[1]),
        pytest.param("float64", qp_recipes.SIZES[4], marks=pytest.mark.thorough),
    ],
    ids=str,
)
def test_recipes(dtype, size):
    undecided, total = [], 0
    for recipe in qp_recipes.RECIPES:
        programs = qp_recipes.batch(recipe, size, LANES)
        data = [v.astype(dtype) for v in qp_recipes.stacked(programs, size)]
        for lane, (program, answer) in enumerate(zip(programs, lanes_of(solve(*data)), strict=True)):
            total += 1
            if answer.status == Status.MAX_ITERATIONS:
                undecided.append((recipe, lane))
                continue
            assert Status(int(answer.status)).name == program.answer.upper(), (recipe, lane)
            assert qp_recipes.error(answer, [v[lane] for v in data]) <= ERROR[dtype], (recipe, lane)
    assert len(undecided) <= 0.01 * total, undecided
    assert not [recipe for recipe, _ in undecided if recipe.startswith(("infeasible", "unbounded"))], undecided


@pytest.mark.parametrize("recipe", ["strongly_convex", "not_strongly_convex", "degenerate", "duplicated_rows", "box"])
def test_objective_against_clarabel(recipe):
    programs = qp_recipes.batch(recipe, qp_recipes.SIZES[1], LANES, seed=1)
    for program, answer in zip(
        programs, lanes_of(solve(*qp_recipes.stacked(programs, qp_recipes.SIZES[1]))), strict=True
    ):
        expected = clarabel_objective(*program.data)
        assert answer.status == Status.SOLVED
        assert abs(answer.objective - expected) <= OBJECTIVE * max(1, abs(expected))


@pytest.mark.parametrize("recipe", ["linear", "degenerate_linear", "infeasible_linear", "unbounded_linear"])
def test_linear_programs_against_highs(recipe):
    programs = qp_recipes.batch(recipe, qp_recipes.SIZES[1], LANES, seed=1)
    for program, answer in zip(
        programs, lanes_of(solve(*qp_recipes.stacked(programs, qp_recipes.SIZES[1]))), strict=True
    ):
        expected = highs(*program.data[1:])
        assert {0: "SOLVED", 2: "INFEASIBLE", 3: "UNBOUNDED"}[expected.status] == Status(int(answer.status)).name
        if expected.status == 0:
            assert program.optimum == pytest.approx(expected.fun, rel=1e-8, abs=1e-8)
            assert answer.objective == pytest.approx(expected.fun, rel=OBJECTIVE, abs=OBJECTIVE)


def small():
    """min (x0 - 1)^2 + (x1 - 3)^2 over x0 + x1 = 1, x >= 0: x = (0, 1), y = 4, z = (2, 0)."""
    G, h = -np.eye(2), np.zeros(2)
    return [2 * np.eye(2), np.array([-2.0, -6.0]), np.ones((1, 2)), np.ones(1), G, h]


def test_closed_form_and_fields():
    answer = solve(*small())
    np.testing.assert_allclose(answer.x, [0, 1], atol=1e-7)
    np.testing.assert_allclose(answer.s, [0, 1], atol=1e-7)
    np.testing.assert_allclose(answer.y, [4], atol=1e-6)
    np.testing.assert_allclose(answer.z, [2, 0], atol=1e-6)
    np.testing.assert_allclose(answer.objective, -5, atol=1e-7)
    assert answer.status == Status.SOLVED
    assert max(answer.primal_residual, answer.dual_residual, answer.gap) < 1e-7
    assert 0 < answer.iterations < 20


def test_certificates_fill_only_their_fields():
    nothing = solve(None, np.ones(1), None, None, np.array([[1.0], [-1.0]]), np.array([-1.0, -1.0]))
    assert nothing.status == Status.INFEASIBLE and nothing.objective == np.inf
    assert np.isnan(nothing.x).all() and np.isnan(nothing.s).all() and np.isinf(nothing.primal_residual)
    np.testing.assert_allclose(nothing.z, [0.5, 0.5], atol=1e-7)
    ever = solve(None, np.array([-2.0]), None, None, np.array([[-1.0]]), np.zeros(1))
    assert ever.status == Status.UNBOUNDED and ever.objective == -np.inf
    assert np.isnan(ever.z).all() and np.isinf(ever.dual_residual) and np.isinf(ever.gap)
    np.testing.assert_allclose(ever.x, [0.5], atol=1e-7)


@pytest.mark.parametrize("omit, x", [((2, 3), [1, 3]), ((4, 5), [-0.5, 1.5]), ((0, 4, 5), None)])
def test_omitted_arguments(omit, x):
    data = [None if k in omit else v for k, v in enumerate(small())]
    answer = solve(*data)
    if x is None:
        assert answer.status == Status.UNBOUNDED
    else:
        assert answer.status == Status.SOLVED
        np.testing.assert_allclose(answer.x, x, atol=1e-6)


def test_batches_broadcast_and_vmap():
    batch = (3, 1, 2)
    P, q, A, b, G, h = small()
    many = q + np.random.default_rng(0).standard_normal((*batch, 2))
    answer = solve(P, many, A, b, G, h)
    assert answer.x.shape == (*batch, 2) and answer.status.shape == answer.gap.shape == batch
    mapped = lambda q: solve_qp(P, q, A, b, G, h)  # noqa: E731
    for _ in batch:
        mapped = jax.vmap(mapped)
    for one, other in zip(jax.tree.leaves(answer), jax.tree.leaves(jax.jit(mapped)(many)), strict=True):
        # Other shapes of products sum in another order.
        np.testing.assert_allclose(one, other, atol=1e-8)


def test_neighbours_do_not_touch_each_other():
    base = small()
    lanes = [np.stack([v] * 6) for v in base]
    lanes[1][1, 0] = np.nan
    lanes[5][2, 0] = np.nan
    lanes[0][3] = -np.eye(2)
    lanes[3][4] = -1.0
    answer = solve(*lanes)
    assert [Status(int(code)).name for code in answer.status] == [
        "SOLVED",
        "INVALID_INPUT",
        "INVALID_INPUT",
        "INVALID_INPUT",
        "INFEASIBLE",
        "SOLVED",
    ]
    np.testing.assert_allclose(answer.x[0], solve(*base).x, atol=1e-8)
    np.testing.assert_array_equal(answer.x[0], answer.x[5])
    assert np.isnan(answer.x[1:4]).all() and np.isnan(answer.objective[1:4]).all()
    assert (answer.iterations[1:4] == 0).all()


def boxed(dtype="float64"):
    """Random programs -1 <= G x <= 2, as [G; -G] x <= [2; 1], and where a side is missing; no x grows without bound."""
    rng = np.random.default_rng(3)
    root, G = rng.normal(size=(LANES, 4, 4)), rng.normal(size=(LANES, 6, 4))
    P, q = root @ root.swapaxes(1, 2) + 0.1 * np.eye(4), rng.normal(size=(LANES, 4))
    G, h = np.concatenate([G, -G], 1), np.repeat([[2.0] * 6 + [1.0] * 6], LANES, 0) * rng.uniform(0.1, 1, (LANES, 12))
    return [v.astype(dtype) for v in (P, q, G, h)], rng.random((LANES, 12)) < 0.4


@pytest.mark.parametrize("dtype", ["float64", "float32"])
def test_an_infinite_side_is_no_row(dtype):
    (P, q, G, h), missing = boxed(dtype)
    missing[0] = True
    for infinite in (np.inf, 1e20, 1e30):
        answer = solve(P, q, None, None, G, np.where(missing, infinite, h).astype(dtype))
        for lane, one in enumerate(lanes_of(answer)):
            there = ~missing[lane]
            expected = clarabel_objective(
                P[lane], q[lane], np.zeros((0, 4)), np.zeros(0), G[lane, there], h[lane, there]
            )
            assert one.status == Status.SOLVED
            assert one.objective == pytest.approx(expected, rel=ERROR[dtype], abs=ERROR[dtype])
            assert (one.z[~there] == 0).all() and np.isinf(one.s[~there]).all() and np.isfinite(one.s[there]).all()


@pytest.mark.parametrize("far", [1e6, 1e12, 1e19])
def test_a_side_that_is_far_away_does_no_harm(far):
    (P, q, G, h), missing = boxed()
    near, away = (solve(P, q, None, None, G, np.where(missing, side, h)) for side in (np.inf, far))
    assert (away.status == Status.SOLVED).all()
    np.testing.assert_allclose(away.x, near.x, atol=ERROR["float64"])


def test_linear_programs_with_missing_sides_against_highs():
    """x = 0 is admissible: what HiGHS does not solve is unbounded, or the solver says that it did not come so far."""
    (_, q, G, h), missing = boxed()
    answer, solved = solve(None, q, None, None, G, np.where(missing, np.inf, h)), 0
    for lane, one in enumerate(lanes_of(answer)):
        there = ~missing[lane]
        expected = linprog(q[lane], G[lane, there], h[lane, there], bounds=(None, None))
        if expected.status == 0:
            solved += 1
            assert one.status == Status.SOLVED
            assert one.objective == pytest.approx(expected.fun, rel=OBJECTIVE, abs=OBJECTIVE)
        else:
            assert one.status in (Status.UNBOUNDED, Status.MAX_ITERATIONS)
    assert 0 < solved < LANES


def test_a_side_that_nothing_meets():
    P, q, A, b, G, h = small()
    sides = np.array([[0.0, 0.0], [0.0, -np.inf], [0.0, -1e20], [np.nan, -np.inf], [0.0, np.nan]])
    answer = solve(P, q, A, b, G, sides)
    names = [Status(int(code)).name for code in answer.status]
    assert names == ["SOLVED", "INFEASIBLE", "INFEASIBLE", "INVALID_INPUT", "INVALID_INPUT"]
    assert np.isnan(answer.x[1:]).all() and np.isnan(answer.z[1:]).all() and np.isinf(answer.objective[1:3]).all()
    np.testing.assert_array_equal(answer.x[0], solve(*small()).x)


@pytest.mark.parametrize("units", [1e-4, 1e4])
def test_units_of_data_do_not_matter(units):
    """Lengths in other units: x = units * x', and an objective in others too."""
    P, q, A, b, G, h = small()
    answer = solve(P / units, q, A, b * units, G, h * units)
    assert answer.status == Status.SOLVED
    np.testing.assert_allclose(np.asarray(answer.x) / units, [0, 1], atol=1e-6)


def test_far_bounds_cost_no_accuracy():
    P, q, A, b, G, h = small()
    answer = solve(P, q, A, b, np.vstack([G, np.eye(2)]), np.concatenate([h, [1e4, 1e4]]))
    assert answer.status == Status.SOLVED
    np.testing.assert_allclose(answer.x, [0, 1], atol=1e-6)


@pytest.mark.parametrize(
    "position, value, message",
    [
        (0, np.eye(3), r"P: got shape \(3, 3\), wanted \(\*batch, 2, 2\)"),
        (2, np.ones((1, 3)), r"A: got shape \(1, 3\)"),
        (3, np.ones(2), r"b: got shape \(2,\), wanted \(\*batch, 1\)"),
        (5, None, "h: got None"),
        (1, np.ones((3, 2)), None),
        (1, np.array([1j, 0]), "q: got dtype complex128"),
        (1, np.ones((4, 2)), "do not broadcast"),
    ],
)
def test_wrong_shapes_and_dtypes(position, value, message):
    data = small()
    data[4], data[5] = np.stack([data[4]] * 3), np.stack([data[5]] * 3)
    data[position] = value
    if message is None:
        assert jax.eval_shape(solve_qp, *data).x.shape == (3, 2)
    else:
        with pytest.raises(ValueError, match=message):
            solve_qp(*data)


def test_float32_stays_float32():
    answer = solve(*(jnp.asarray(v, jnp.float32) for v in small()))
    assert answer.x.dtype == answer.objective.dtype == jnp.float32
    np.testing.assert_allclose(answer.x, [0, 1], atol=1e-4)
