"""Derivatives of solve_qp: against central differences, forward against reverse, and lanes that have none."""

from functools import cache

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxgrasp.solvers import solve_qp
from jaxgrasp.solvers.status import Status

# Central differences with this step are exact to 1e-10 by their series, and to 1e-4 of the solver's own error of 1e-9.
STEP = 1e-4
DIFFERENCES = 1e-5
# Both modes solve with the same factors.
MODES = 1e-10
SYMMETRY = 1e-8

N, N_EQ, N_INEQ, LANES = 4, 1, 7, 6
NAMES = ("P", "q", "A", "b", "G", "h")


def programs(linear: bool, seed: int) -> list[np.ndarray]:
    """Programs around a known, strictly complementary optimum, which is unique with its multipliers."""
    rng = np.random.default_rng(seed)
    root = rng.standard_normal((LANES, N, N))
    P = 0 * root if linear else root @ root.swapaxes(1, 2) / N + 0.5 * np.eye(N)
    A, G = rng.standard_normal((LANES, N_EQ, N)), rng.standard_normal((LANES, N_INEQ, N))
    x, y = rng.standard_normal((LANES, N)), rng.standard_normal((LANES, N_EQ))
    active = np.arange(N_INEQ) < (N - N_EQ if linear else 2)
    s, z = (np.where(on, 0.2 + rng.random((LANES, N_INEQ)), 0) for on in (~active, active))
    times = lambda matrix, v: np.einsum("lij,lj->li", matrix, v)  # noqa: E731
    q = -times(P, x) - times(A.swapaxes(1, 2), y) - times(G.swapaxes(1, 2), z)
    return [P, q, A, times(A, x), G, times(G, x) + s]


def outputs(*data) -> tuple[jax.Array, ...]:
    answer = solve_qp(*data)
    return answer.x, answer.s, answer.y, answer.z, answer.objective


solve = jax.jit(outputs)
forward = jax.jit(lambda data, tangents: jax.jvp(outputs, data, tangents)[1])


@jax.jit
def reverse(data, weights):
    """The gradient of a weighted sum of all outputs, through vmap of jit."""

    def weighed(data):
        parts = jax.vmap(jax.jit(outputs))(*data)
        return sum(jnp.sum(w * v) for w, v in zip(weights, parts, strict=True))

    return jax.grad(weighed)(data)


@cache
def weights() -> tuple[np.ndarray, ...]:
    rng = np.random.default_rng(5)
    shapes = [(LANES, N), (LANES, N_INEQ), (LANES, N_EQ), (LANES, N_INEQ), (LANES,)]
    return tuple(rng.standard_normal(shape) for shape in shapes)


def inner(some, others) -> np.ndarray:
    """Inner products of trees, lane by lane."""
    return sum((np.asarray(a) * b).reshape(LANES, -1).sum(1) for a, b in zip(some, others, strict=True))


@pytest.mark.parametrize("linear", [False, True], ids=["strictly convex", "linear"])
@pytest.mark.parametrize("name", NAMES)
def test_both_modes_against_central_differences(name, linear):
    data, k = programs(linear, 1), NAMES.index(name)
    direction = np.random.default_rng(2).standard_normal(data[k].shape)
    tangents = [direction if i == k else np.zeros_like(v) for i, v in enumerate(data)]
    found = forward(tuple(data), tuple(tangents))
    near = lambda step: solve(*(v + step * t for v, t in zip(data, tangents, strict=True)))  # noqa: E731
    if linear and name == "P":
        # P = 0 cannot be left in both directions.
        squares = direction @ direction.swapaxes(1, 2)
        found = forward(tuple(data), (squares, *tangents[1:]))
        first, second, third = (solve(squares * step, *data[1:]) for step in (0, STEP, 2 * STEP))
        expected = [(4 * b - c - 3 * a) / (2 * STEP) for a, b, c in zip(first, second, third, strict=True)]
        tangents[0] = squares
    else:
        expected = [(u - d) / (2 * STEP) for u, d in zip(near(STEP), near(-STEP), strict=True)]
    for one, other in zip(found, expected, strict=True):
        scale = np.maximum(1, np.abs(other).reshape(LANES, -1).max(1))
        error = np.abs(one - other).reshape(LANES, -1).max(1) / scale
        assert error.max() <= DIFFERENCES, error
    gradient = reverse(tuple(data), weights())
    expected = inner(found, weights())
    np.testing.assert_allclose(inner(gradient, tangents), expected, rtol=MODES, atol=MODES)


def test_lanes_without_a_solution_have_zero_gradients_and_touch_no_neighbour():
    data = programs(False, 3)
    alone = reverse(tuple(data), weights())
    broken = [v.copy() for v in data]
    broken[1][0, 1] = np.nan
    broken[3][1, 0] = np.inf
    broken[0][2] = -np.eye(N)
    broken[4][3, :2], broken[5][3, :2] = [[1, 0, 0, 0], [-1, 0, 0, 0]], -1.0
    broken[0][4], broken[1][4], broken[4][4] = 0, [-1, 0, 0, 0], 0
    broken[2][4], broken[3][4], broken[5][4] = [[0, 1, 0, 0]], 0, 1
    answer = jax.jit(solve_qp)(*broken)
    names = ["INVALID_INPUT", "INVALID_INPUT", "INVALID_INPUT", "INFEASIBLE", "UNBOUNDED", "SOLVED"]
    assert [Status(int(code)).name for code in answer.status] == names
    gradient = reverse(tuple(broken), weights())
    tangents = forward(tuple(broken), tuple(np.ones_like(v) for v in data))
    for part, expected in zip(gradient, alone, strict=True):
        np.testing.assert_array_equal(part[:5], 0)
        np.testing.assert_allclose(part[5], expected[5], rtol=1e-8, atol=1e-8)
    for part in tangents:
        np.testing.assert_array_equal(part[:5], 0)
        assert np.any(part[5] != 0)


def test_repeated_rows_share_the_derivative_of_one():
    """Row k in three copies: x does not notice, and its derivatives with respect to the copies add up to those of one.

    The last two rows of the reference never bind, so that both programs have the same shape.
    """
    single = programs(False, 4)
    single[4][:, 5:], single[5][:, 5:] = 0, 1
    copies = [v.copy() for v in single]
    copies[4][:, 5:], copies[5][:, 5:] = copies[4][:, :1], copies[5][:, :1]
    on_x = tuple(w if k == 0 else 0 * w for k, w in enumerate(weights()))
    expected, found = reverse(tuple(single), on_x), reverse(tuple(copies), on_x)
    assert np.abs(expected[5][:, 0]).min() > 1e-3
    for k in (0, 1, 2, 3):
        np.testing.assert_allclose(found[k], expected[k], rtol=1e-6, atol=1e-6)
    for k in (4, 5):
        np.testing.assert_allclose(found[k][:, [0, 5, 6]].sum(1), expected[k][:, 0], rtol=1e-6, atol=1e-6)


def test_missing_sides_vary_nothing():
    """A row whose side is infinite has no derivatives; those of everything else are as without it."""
    data = programs(False, 6)
    without, missing = [v.copy() for v in data], [v.copy() for v in data]
    without[4][:, 0], without[5][:, 0], missing[5][:, 0] = 0, 1, np.inf
    on_x = tuple(w if k in (0, 4) else 0 * w for k, w in enumerate(weights()))
    expected, found = (reverse(tuple(each), on_x) for each in (without, missing))
    for part, other in zip(found[:4], expected[:4], strict=True):
        np.testing.assert_allclose(part, other, rtol=1e-6, atol=1e-6)
    for part, other in zip(found[4:], expected[4:], strict=True):
        np.testing.assert_array_equal(part[:, 0], 0)
        np.testing.assert_allclose(part[:, 1:], other[:, 1:], rtol=1e-6, atol=1e-6)


def test_dependent_equalities():
    """The same equality twice: rank-deficient, multipliers not unique, x as if it stood once."""
    twice = lambda b: solve_qp(2 * np.eye(2), np.array([-2.0, -6.0]), np.ones((2, 2)), b * np.ones(2)).x  # noqa: E731
    for jacobian in jax.jit(lambda b: (jax.jacfwd(twice)(b), jax.jacrev(twice)(b)))(1.0):
        np.testing.assert_allclose(jacobian, [0.5, 0.5], atol=1e-7)


def test_hessians():
    """Of the optimal value, where only first-order sensitivities enter, and of a function of x, s, y and z."""
    data = [v[0] for v in programs(False, 6)]
    own = [w[0] for w in weights()]

    def merit(q, h):
        x, s, y, z, objective = outputs(data[0], q, data[2], data[3], data[4], h)
        return jnp.stack([objective, sum(jnp.sum(w * v**3) for w, v in zip(own, (x, s, y, z), strict=False))])

    gradient = lambda q, h: (jax.jacrev(merit, (0, 1))(q, h),) * 2  # noqa: E731
    derivatives = jax.jit(jax.jacfwd(gradient, (0, 1), has_aux=True))
    ((qq, qh), (hq, hh)), _ = derivatives(data[1], data[5])
    full = np.concatenate([np.concatenate([qq, qh], 2), np.concatenate([hq, hh], 2)], 1)
    np.testing.assert_allclose(full, full.swapaxes(1, 2), rtol=SYMMETRY, atol=SYMMETRY)
    for k in range(N + N_INEQ):
        shift = STEP * (np.arange(N + N_INEQ) == k)
        up, down = (derivatives(data[1] + t[:N], data[5] + t[N:])[1] for t in (shift, -shift))
        column = np.concatenate([(u - d) / (2 * STEP) for u, d in zip(up, down, strict=True)], 1)
        np.testing.assert_allclose(full[:, :, k], column, rtol=DIFFERENCES, atol=DIFFERENCES)
