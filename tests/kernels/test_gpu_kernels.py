"""Kernels for GPUs against XLA: on the GPU where there is one, else emulated on the host; and the PTX that they are."""

from __future__ import annotations

import dataclasses
import re
import sys
import tempfile
from functools import cache, partial
from pathlib import Path

import emulated_gpu
import harness
import jax
import jax.numpy as jnp
import numpy as np
import problems
import pytest
from jax import lax

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))
import jaxgrasp as jg  # noqa: E402
from benchmarks import gpu_kernels  # noqa: E402
from jaxgrasp import kernels  # noqa: E402
from jaxgrasp.kernels import primitive
from jaxgrasp.kernels.gpu import module as gpu
from jaxgrasp.kernels.program import lowering
from jaxgrasp.kernels.program.expressions import Unsupported

SAME_MARGIN = {"float64": 2e-8, "float32": 1e-4}
"""Of max(|margin|, Lambda). In float32 both may be off by what the method accepts."""

ROUNDING = {"float64": 1e-13, "float32": 2e-5}
"""Relative, for short functions, some of whose sums are in another order."""

CAPABILITIES = (80, 90)


@pytest.fixture
def emulated(tmp_path):
    """Kernels for GPUs in place of others."""
    with emulated_gpu.in_place(tmp_path):
        yield


def assert_same(function, *leaves, shared=None):
    """A function of one problem over the leading axis, fused and by XLA; the lane axis trails inside."""
    shared = shared or (False,) * len(leaves)
    ours = primitive.fused(
        lambda parts: function(*parts), list(leaves), shared, emulated_gpu.no_kernel, platform="cuda"
    )
    one = lambda *parts: jax.tree.map(lambda x: x[..., 0], function(*[x[..., None] for x in parts]))  # noqa: E731
    theirs = jax.vmap(one, [None if s else 0 for s in shared])(*leaves)
    for a, b in zip(jax.tree.leaves(ours), jax.tree.leaves(theirs), strict=True):
        assert a.dtype == b.dtype
        np.testing.assert_allclose(a, b, rtol=ROUNDING[leaves[0].dtype.name], atol=0)


def rows(count: int, *event: int, dtype="float64", seed=0) -> jax.Array:
    return jnp.asarray(np.random.default_rng(seed).normal(size=(count, *event)), dtype)


@pytest.mark.parametrize("dtype", ["float64", "float32"])
def test_arithmetic_with_numbers_that_are_not_ordinary(emulated, dtype):
    """Zeros of both signs, infinities, NaN and what is smaller than any ordinary number, by every operation."""
    info = jnp.finfo(dtype)
    odd = [0.0, -0.0, 1.0, -2.5, np.inf, -np.inf, np.nan, float(info.max), 1e-3, -1e5]
    odd += [float(info.tiny), float(info.tiny) / 8, -float(info.smallest_subnormal)]
    x = jnp.asarray(np.array(np.meshgrid(odd, odd)).reshape(2, -1).T, dtype)

    def function(x):
        a, b = x
        return {
            "sum": a + b,
            "product": a * b,
            "reciprocal": 1 / a,
            "root": jnp.sqrt(a),
            "inverse root": lax.rsqrt(a),
            "finite": jnp.isfinite(a),
            "compared": jnp.stack([a < b, a <= b, a > b, a >= b, a == b, a != b]),
            "size": jnp.abs(a),
            "below": jnp.floor(jnp.where(jnp.isfinite(a), a, 0)),
            "picked": jnp.where((a >= b) & ~(b == 1), a, -b),
            "above": jnp.maximum(a, 0.5),
        }

    with np.errstate(all="ignore"):
        # XLA's code for CPUs may flush what is so small in products; its sums and choices keep it.
        assert_same(function, x)


def test_loops_and_branches_are_each_threads_own(emulated):
    """Loops of known and of unknown length, one in the other, branches, counters, integers and flags."""

    def root(x):
        def body(state):
            guess, step = state
            return 0.5 * (guess + x[0] / guess), step + 1

        def unfinished(state):
            guess, step = state
            return jnp.any((jnp.abs(guess * guess - x[0]) > 1e-9 * x[0]) & (step < 60))

        return lax.while_loop(unfinished, body, (jnp.ones_like(x[0]), jnp.zeros(1, jnp.int32)))

    def nested(x, table):
        def outer(state):
            inner = lax.fori_loop(0, 20, lambda _, y: y * 0.5 + x[1], state[0])
            return inner + lax.cond(jnp.all(x[2] > 0), lambda: x[0] * 3, lambda: x[1] / 7), state[1] + 1

        often = jnp.where(x[2] > 0, 5, 3)
        through = lax.while_loop(lambda state: jnp.all(state[1] < often), outer, (x[0], jnp.zeros(1, jnp.int32)))
        row = lambda i: lax.dynamic_slice_in_dim(table, i, 1)[0]  # noqa: E731
        best = lax.fori_loop(0, 32, lambda i, best: jnp.maximum(best, (row(i) * x).sum(0)), jnp.zeros(1))
        large = lax.cond(jnp.all(x[0] > 0), lambda: (x * 3).sum(0), lambda: jnp.zeros(1))
        return *through, best, large, jnp.argmax(x, 0).astype(jnp.int32), x > 0

    assert_same(root, jnp.exp(5 * rows(70, 1)))
    assert_same(nested, rows(70, 3), rows(32, 3, seed=1), shared=(False, True))


@pytest.mark.parametrize("count", [1, 63, 64, 65])
def test_blocks_that_are_full_and_that_are_not(emulated, count):
    def function(short, long, flags):
        return {"sum": short.sum(0) + long.sum((0, 1)), "long": long * 2, "flags": ~flags, "one": flags[0]}

    flags = jnp.asarray(np.random.default_rng(1).random((count, 5)) < 0.5)
    assert_same(function, rows(count, 3), rows(count, 7, 5), flags)


def some_grasps(dtype="float64"):
    """Of every family, also with contacts that are absent; three with data that are no numbers, or too small."""
    batch = problems.group("4 contacts").batch
    batch = batch[np.linspace(0, len(batch) - 1, 3 * gpu.THREADS + 8).astype(int)]
    contacts, *others = harness.data_of(batch, jnp.dtype(dtype))
    odd = [jnp.nan, jnp.inf, jnp.finfo(dtype).smallest_subnormal]
    positions = contacts.positions.at[jnp.arange(0, 9, 3), 0, 0].set(jnp.asarray(odd, dtype))
    return jax.tree.map(lambda x: positions if x is contacts.positions else x, contacts), *others


def on_xla(function, *args):
    jax.clear_caches()
    with kernels.without():
        out = harness.as_numpy(function(*args))
    jax.clear_caches()
    return out


def assert_same_margins(ours, theirs, dtype):
    same = ours.status == theirs.status
    assert same.all() if dtype == "float64" else same.mean() > 0.98
    known = np.isfinite(theirs.margin) & same
    assert known.mean() > 0.5
    np.testing.assert_array_equal(np.isfinite(ours.margin)[same], known[same])
    unit = np.maximum(np.abs(theirs.margin), 1)[known]
    assert (np.abs(ours.margin - theirs.margin)[known] <= SAME_MARGIN[dtype] * unit).all()


@cache
def margins(dtype: str):
    """Answers of kernels and of XLA, and the code of the kernel."""
    data = some_grasps(dtype)
    with tempfile.TemporaryDirectory() as folder, emulated_gpu.in_place(Path(folder)):
        ours = harness.as_numpy(harness.largest(*data))
        code = emulated_gpu.codes[-1]
    return ours, on_xla(harness.largest, *data), code


@pytest.mark.parametrize("dtype", ["float64", "float32"])
def test_the_same_margins_as_on_xla(dtype):
    ours, theirs, _ = margins(dtype)
    assert_same_margins(ours, theirs, dtype)


def test_the_same_least_efforts(emulated):
    data = some_grasps()
    margin = jnp.full(len(data[2]), 0.1)
    least = partial(harness.least, cone_edges=4)
    ours, theirs = harness.as_numpy(least(*data, margin)), on_xla(least, *data, margin)
    np.testing.assert_array_equal(ours.status, theirs.status)
    assert (ours.status == jg.Status.SOLVED).mean() > 0.4
    np.testing.assert_allclose(ours.effort, theirs.effort, rtol=1e-6, atol=1e-9)


def total(positions, contacts, disturbances, load, reserve):
    moved = dataclasses.replace(contacts, positions=positions)
    return harness.largest(moved, disturbances, load, reserve, cone_edges=4).margin.sum()


def test_the_same_gradients(emulated):
    """Inside jit, grad and vmap over batches."""
    data = jax.tree.map(lambda x: x.reshape(2, -1, *x.shape[1:]), some_grasps())
    gradient = jax.jit(jax.grad(lambda *args: jax.vmap(total)(*args).sum()))
    ours, theirs = np.asarray(gradient(data[0].positions, *data)), on_xla(gradient, data[0].positions, *data)
    np.testing.assert_allclose(ours, theirs, rtol=1e-5, atol=1e-7)
    assert (ours != 0).any((2, 3)).mean() > 0.5


# PTX


@cache
def ptx(dtype: str, capability: int) -> str:
    return gpu.write_ptx(margins(dtype)[2], capability)


@pytest.mark.parametrize("capability", CAPABILITIES)
@pytest.mark.parametrize("dtype", ["float64", "float32"])
def test_ptx_rounds_as_it_should(dtype, capability):
    text, kind = ptx(dtype, capability), "f64" if dtype == "float64" else "f32"
    assert f".target sm_{capability}" in text
    assert len(re.findall(r"\.visible \.entry jaxgrasp_", text)) == 1
    for instruction in ("fma", "rcp", "sqrt"):
        assert f"{instruction}.rn.{kind}" in text
    # Sums and products without .rn could become one instruction, rounded once.
    for wrong in (r"\bcall", r"\.extern", r"\.ftz", r"\.approx", r"\.full", r"\b(add|sub|mul|div)\.f\d", r"\.local"):
        assert not re.search(wrong, text), wrong


@pytest.mark.parametrize(("dtype", "capability"), [("float64", 90), ("float32", 80)])
def test_ptx_assembles(dtype, capability):
    """For all of a thread's registers, and a stack that thousands of threads can have."""
    if gpu_kernels.assembler() is None:
        pytest.skip("no ptxas")
    made = gpu_kernels.assembled(ptx(dtype, capability), capability)
    assert 32 < made.registers <= 255
    assert made.stack < 16_384


def program_of(function, *shapes, dtype="float64"):
    given = [jax.ShapeDtypeStruct((*shape, 1), dtype) for shape in shapes]
    return lowering.lower(jax.make_jaxpr(function)(*given), [False] * len(given))


@pytest.mark.parametrize("function", [jnp.exp, jnp.log])
def test_functions_that_gpus_have_no_instructions_for_are_left_to_xla(function):
    with pytest.raises(Unsupported, match="on a GPU"):
        gpu.write_module(program_of(function, (3,)), "kernel")


def test_operations_without_results_are_left_to_xla():
    def told(x):
        jax.debug.callback(lambda: None)
        return x * 2

    with pytest.raises(Unsupported, match="debug_callback, which has no result"):
        program_of(told, (3,))
