"""Linear algebra of small matrices against NumPy, and that no program of the package calls LAPACK."""

from __future__ import annotations

import re
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.test_util import check_grads
from jax_sample import PUSHES, grasps, margin

import jaxgrasp as jg
from jaxgrasp import linalg
from jaxgrasp.explanation.zero_margins import reasons

SIZES = [1, 2, 3, 6, 7, 16, 23, 40]
SHAPES = [(1, 1), (4, 1), (2, 2), (3, 6), (16, 6), (5, 7), (22, 22), (40, 13)]
CLOSE = 1e-12


def positive(size, rows=2):
    factor = np.random.default_rng(size).normal(size=(20, rows * size, size))
    return np.swapaxes(factor, -1, -2) @ factor


def transposed(x):
    return np.swapaxes(x, -1, -2)


@pytest.mark.parametrize("size", SIZES)
def test_factors_and_solutions(size):
    A = positive(size)
    eps = size * np.linalg.cond(A).max() * np.finfo(float).eps
    lower, root = np.asarray(linalg.cholesky(A)), np.asarray(linalg.inverse_root(A))
    np.testing.assert_allclose(lower, np.linalg.cholesky(A), rtol=0, atol=eps * np.abs(A).max())
    np.testing.assert_allclose(root @ lower, np.broadcast_to(np.eye(size), A.shape), atol=10 * eps)
    np.testing.assert_array_equal(root, np.tril(root))
    right = np.random.default_rng(0).normal(size=(20, size, 2))
    found = linalg.solve_positive(jnp.asarray(A), jnp.asarray(right))
    np.testing.assert_allclose(A @ found, right, atol=10 * eps * np.abs(A).max())


@pytest.mark.parametrize("size", [1, 3, 7, 20])
@pytest.mark.parametrize("factor", [linalg.cholesky, linalg.inverse_root])
def test_what_is_not_positive_definite_has_no_factor(factor, size):
    A = positive(size)
    A[3] -= 1e-6 * np.eye(size) + np.linalg.eigvalsh(A[3])[0] * np.eye(size)
    A[7, -1, 0] = np.nan
    A[9] = 0
    found = np.asarray(factor(A))
    bad = np.isin(np.arange(len(A)), (3, 7, 9))
    assert np.isnan(found[bad]).all() and np.isfinite(found[~bad]).all()


@pytest.mark.parametrize("kind", ["random", "graded", "dependent", "alike", "zero", "tiny"])
@pytest.mark.parametrize("shape", SHAPES)
@pytest.mark.parametrize("dtype", ["float64", "float32"])
def test_singular_values(shape, kind, dtype):
    rng, (m, n) = np.random.default_rng(1), shape
    A = rng.normal(size=(100, m, n))
    if kind == "graded":
        A *= 10.0 ** rng.uniform(-7, 0, (100, m, 1)) * 10.0 ** rng.uniform(-7, 0, (100, 1, n))
    elif kind == "dependent":
        A[..., -1], A[:, -1] = A[..., 0], A[:, 0]
    elif kind == "alike":
        left, _, right = np.linalg.svd(A, full_matrices=False)
        A = (left * (1 + 1e-10 * rng.normal(size=min(m, n)))) @ right
    A = (A * {"zero": 0, "tiny": 1e-30}.get(kind, 1)).astype(dtype)
    values, vectors = (np.asarray(x, np.float64) for x in linalg.right_singular(jnp.asarray(A)))
    eps, exact = (40 + n) * np.finfo(dtype).eps, A.astype(np.float64)
    wanted = np.linalg.svd(exact, compute_uv=False)
    within = eps * wanted[:, :1]
    assert (np.diff(values, axis=-1) <= 0).all()
    assert (np.abs(values[:, : min(m, n)] - wanted) <= within).all() and (values[:, min(m, n) :] <= within).all()
    assert np.abs(transposed(vectors) @ vectors - np.eye(n)).max() <= 2 * eps
    turned = exact @ vectors
    products = np.abs(transposed(turned) @ turned) * (1 - np.eye(n))
    assert (products.max((-2, -1)) <= within[:, 0] * wanted[:, 0]).all()


@pytest.mark.parametrize("shape", [(6, 6), (9, 4), (4, 9)])
def test_pseudoinverses(shape):
    rng = np.random.default_rng(2)
    A = rng.normal(size=(20, shape[0], 3)) @ rng.normal(size=(20, 3, shape[1]))
    found = linalg.pinv(jnp.asarray(A), 1e-9)
    np.testing.assert_allclose(found, np.linalg.pinv(A, 1e-9), atol=CLOSE * np.abs(found).max())
    way = rng.normal(size=A.shape)
    both = jax.jvp(lambda x: linalg.pinv(x, 1e-9), (A,), (way,)), jax.jvp(lambda x: jnp.linalg.pinv(x), (A,), (way,))
    np.testing.assert_allclose(both[0][1], both[1][1], rtol=1e-8, atol=1e-8 * np.abs(both[1][1]).max())
    assert not np.asarray(linalg.pinv(jnp.zeros(shape), 1e-9)).any()


@pytest.mark.parametrize("size", [3, 20])
def test_derivatives(size):
    A = jnp.asarray(positive(size)[:2] / size)
    right = jnp.asarray(np.random.default_rng(3).normal(size=(2, size, 2)))
    even = lambda x: (x + jnp.swapaxes(x, -1, -2)) / 2
    for function in (linalg.cholesky, linalg.inverse_root, lambda x: linalg.pinv(x[..., :2], 1e-9)):
        check_grads(lambda x, f=function: f(even(x)), (A,), order=1, rtol=1e-5)
    check_grads(lambda x, b: linalg.solve_positive(even(x), b), (A, right), order=1, rtol=1e-5)


def blocks(contacts):
    return jnp.broadcast_to(2 * jnp.eye(3), (*contacts.positions.shape, 3))


def whole(contacts):
    return jnp.broadcast_to(2 * jnp.eye(12), (len(contacts.positions), 12, 12))


def actuated(contacts):
    given = jnp.ones((2, 3)) + contacts.positions[0, 0]
    actuation = jg.Actuation.from_jacobian(jnp.ones((4, 3, 2)), given, -jnp.ones(3), jnp.ones(3))
    return jg.largest_disturbance(contacts, PUSHES, actuation=actuation).margin


def slope(function):
    return lambda c: jax.grad(lambda p: jnp.sum(function(replace(c, positions=p))))(c.positions)


def quadratic(contacts):
    solve = lambda q: jg.solvers.solve_qp(jnp.eye(3), q, jnp.ones((1, 3)), jnp.ones(1)).x
    return jax.vmap(jax.jacobian(solve))(contacts.positions[:, 0])


PROGRAMS = {
    "margin": slope(margin),
    "blocks": lambda c: jg.largest_disturbance(c, PUSHES, compliance=blocks(c)).margin,
    "compliance": slope(lambda c: jg.largest_disturbance(c, PUSHES, compliance=whole(c)).margin),
    "effort weights": lambda c: jg.least_effort(c, PUSHES, 0.1, effort_weights=blocks(c)).effort,
    "full effort weights": lambda c: jg.least_effort(c, PUSHES, 0.1, effort_weights=whole(c)).effort,
    "actuation": actuated,
    "rotated": lambda c: jg.largest_disturbance(c, PUSHES.rotated(c.frames[0, 0])).margin,
    "total effort": slope(lambda c: jg.least_total_effort(c, PUSHES, 0.05, compliance=blocks(c)).effort),
    "total effort, full": slope(lambda c: jg.least_total_effort(c, PUSHES, 0.05, compliance=whole(c)).effort),
    "formulation (13)": slope(lambda c: jg.formulation_margin(c, PUSHES, "13").margin),
    "min_weight": slope(jg.metrics.min_weight),
    "force_closure": jg.metrics.force_closure,
    "task_wrench": slope(lambda c: jg.metrics.task_wrench(c, PUSHES)),
    "isotropy": slope(jg.metrics.isotropy),
    "smallest_singular_value": slope(jg.metrics.smallest_singular_value),
    "ferrari_canny_bound": slope(jg.metrics.ferrari_canny_bound),
    "ferrari_canny_bound, Linf": lambda c: jg.metrics.ferrari_canny_bound(c, "Linf"),
    "solve_qp": quadratic,
    "why margins are zero": lambda c: reasons(c, PUSHES, 4),
}


@pytest.mark.parametrize("name", PROGRAMS)
def test_no_program_calls_lapack(name):
    with jg.without_kernels():
        text = jax.jit(PROGRAMS[name]).lower(grasps(2)).as_text()
    assert "lapack" not in text and "blas" not in text


def test_no_source_calls_lapack():
    calls = re.compile(r"\bjnp\.linalg\.(?!norm\b)|jax\.scipy\.linalg|lax\.linalg|from jax\.\S* import .*linalg")
    package = Path(jg.__file__).parent
    assert [path.name for path in package.rglob("*.py") if calls.search(path.read_text())] == []


TWO_DEVICES = """
import jax
jax.config.update("jax_num_cpu_devices", 2)
jax.config.update("jax_enable_x64", True)
import numpy as np
from jax.sharding import Mesh, NamedSharding, PartitionSpec as P
import jaxgrasp as jg
from jax_sample import grasps
mesh = Mesh(np.array(jax.devices()), ("g",))
contacts = jax.device_put(grasps(4096), NamedSharding(mesh, P("g")))
divided = jax.jit(jg.metrics.min_weight)
mapped = jax.jit(jax.shard_map(jax.vmap(jg.metrics.min_weight), mesh=mesh, in_specs=P("g"), out_specs=P("g")))
for function in (divided, mapped):
    for _ in range(4):
        found = jax.block_until_ready(function(contacts))
    print(len(found.addressable_shards))
"""


def test_two_devices_do_not_wait_for_each_other():
    """LAPACK's batches on both did for ever, at about every second try."""
    run = subprocess.run([sys.executable, "-c", TWO_DEVICES], capture_output=True, text=True, cwd="tests", timeout=300)
    assert run.stdout.split() == ["2", "2"], run.stderr
