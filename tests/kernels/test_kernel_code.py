"""The code of fused kernels: short functions of every kind against XLA."""

from __future__ import annotations

import re
from functools import partial
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import lax

import jaxgrasp as jg
from jaxgrasp import kernels
from jaxgrasp.disturbance.sets import support
from jaxgrasp.disturbance.vertices import Vertices
from jaxgrasp.kernels import primitive
from jaxgrasp.kernels.cpu.module import write_module
from jaxgrasp.kernels.program.lowering import lower
from jaxgrasp.lanes.fence import loops, repeat

ROUNDING = {"float64": 1e-13, "float32": 2e-5}
"""Relative, for short functions: reciprocals are good to a unit or two in the last place."""


def fused(function, *leaves, shared=None):
    """A function of one problem over the leading axis, fused; the lane axis trails inside."""
    run = partial(primitive.fused, shared=shared or (False,) * len(leaves), otherwise=no_kernel)
    return run(lambda parts: function(*parts), list(leaves))


def no_kernel(leaves):
    raise AssertionError("no fused kernel")


def mapped(function, *leaves, shared=None):
    """The same by XLA."""
    axes = [None if s else 0 for s in shared or (False,) * len(leaves)]
    one = lambda *parts: jax.tree.map(lambda x: x[..., 0], function(*[x[..., None] for x in parts]))  # noqa: E731
    return jax.vmap(one, axes)(*leaves)


def assert_same(function, *leaves, shared=None):
    ours, theirs = fused(function, *leaves, shared=shared), mapped(function, *leaves, shared=shared)
    for a, b in zip(jax.tree.leaves(ours), jax.tree.leaves(theirs), strict=True):
        assert a.dtype == b.dtype
        np.testing.assert_allclose(a, b, rtol=ROUNDING[leaves[0].dtype.name], atol=1e-30)


def rows(count: int, *event: int, dtype="float64", seed=0) -> jax.Array:
    return jnp.asarray(np.random.default_rng(seed).normal(size=(count, *event)), dtype)


@pytest.fixture(scope="module", autouse=True)
def there_are_kernels():
    assert kernels.usable()


@pytest.mark.parametrize("dtype", ["float64", "float32"])
@pytest.mark.parametrize("count", [1, 7, 8, 33])
def test_arrays_of_every_length_are_packed_and_unpacked(count, dtype):
    """Arrays shorter and longer than a vector; blocks that are full and that are not."""

    def function(short, long, flags):
        return {
            "sum": short.sum(0) + long.sum((0, 1)),
            "long": long * 2,
            "short": short,
            "flags": ~flags,
            "one": flags[0],
        }

    flags = jnp.asarray(np.random.default_rng(1).random((count, 5)) < 0.5)
    assert_same(function, rows(count, 3, dtype=dtype), rows(count, 7, 5, dtype=dtype), flags)


@pytest.mark.parametrize("dtype", ["float64", "float32"])
def test_arithmetic_with_numbers_that_are_not_ordinary(dtype):
    info = jnp.finfo(dtype)
    odd = [0.0, -0.0, 1.0, -2.5, np.inf, -np.inf, np.nan, float(info.tiny), float(info.max), 1e-3, 7.0, -1e5]
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
            "less": a < b,
            "equal": a == b,
            "differ": a != b,
            "size": jnp.abs(a),
            "picked": jnp.where(a >= b, a, b),
            "above": jnp.maximum(a, 0.5),
        }

    with np.errstate(all="ignore"):
        assert_same(function, x)


@pytest.mark.parametrize("dtype", ["float64", "float32"])
def test_sums_of_products_with_every_sign(dtype):
    """They are turned into chains; what else uses a product or a part of a sum keeps it."""

    def function(x):
        pairs = [x[i] * x[i + 1] for i in range(39)]
        long = sum(pairs[1:30], pairs[0])
        shared = pairs[30] + pairs[31]
        return {
            "long": long,
            "taken away": x[0] - sum(pairs[31:38], pairs[38]),
            "turned": (pairs[32] - pairs[33]) - (pairs[34] - (pairs[35] - x[3])),
            "product": pairs[35],
            "part": shared,
            "whole": shared - pairs[36] - pairs[37] * 2,
            "negative": -(pairs[36] + pairs[37] * x[5]) - x[2] * x[7],
        }

    assert_same(function, 1 + jnp.abs(rows(20, 40, dtype=dtype)))


@pytest.mark.parametrize("dtype", ["float64", "float32"])
def test_sums_with_constants_in_common(dtype):
    """The constants are taken out, from sums of values and of products, alone or among others."""

    def function(x, whole):
        return {
            "two": 0.3 * x[0] + 0.3 * x[1],
            "products": 0.3 * (x[2] * x[3]) + 0.3 * (x[4] * x[5]),
            "inside": (0.3 * x[6]) * x[7] + (0.3 * x[8]) * x[9] + x[10] * x[11],
            "signs": x[12] - 0.7 * x[13] - 0.7 * x[14] + x[15] * x[16],
            "turned": -(0.7 * x[17]) - 0.7 * (x[18] * x[19]),
            "others": 0.3 * x[20] + 0.7 * x[21] + 0.3 * x[22] - 0.7 * x[23] + x[24],
            "of constants": -0.5 * (0.25 * x[25]) + 1e-30 * (1e-30 * x[26]),
            "largest": jnp.maximum(-x[27], -x[28]),
            "whole": -3 * whole + 2 * (5 * whole),
        }

    whole = jnp.asarray(np.arange(20)[:, None] - 7, jnp.int32)
    assert_same(function, 1 + jnp.abs(rows(20, 30, dtype=dtype)), whole)


def test_loops_end_for_each_problem_by_itself():
    """Newton's iteration: some problems take long, and none goes on after its end."""

    def function(x):
        def body(state):
            root, step = state
            return 0.5 * (root + x[0] / root), step + 1

        def unfinished(state):
            root, step = state
            return jnp.any((jnp.abs(root * root - x[0]) > 1e-9 * x[0]) & (step < 60))

        return lax.while_loop(unfinished, body, (jnp.ones_like(x[0]), jnp.zeros(1, jnp.int32)))

    assert_same(function, jnp.exp(5 * rows(50, 1)))


@pytest.mark.parametrize("dtype", ["float64", "float32"])
@pytest.mark.parametrize("count", [1, 5, 16, 37, 400])
def test_problems_that_take_longer_wait_for_each_other(count, dtype):
    """What a problem has of every kind goes with it, before, in and after the loop; and so does its row."""

    def function(start, marks, table):
        known = jnp.sqrt(jnp.abs(start)) + table[1]

        def body(state):
            total, step, odd = state
            return total * 0.5 + known + jnp.where(marks[0], table[0], 0), step + 1, odd ^ marks

        def unfinished(state):
            return jnp.any(state[1] < jnp.asarray(7 * jnp.abs(start[0]), jnp.int32))

        total, step, odd = lax.while_loop(unfinished, body, (start * 2, jnp.zeros(1, jnp.int32), marks))
        return {"total": total - start, "known": known, "step": step, "odd": odd, "marks": ~marks}

    start = rows(count, 3, dtype=dtype)
    marks = jnp.asarray(np.random.default_rng(1).random((count, 2)) < 0.5)
    table = rows(2, 1, dtype=dtype, seed=2)
    assert_same(function, start, marks, table, shared=(False, False, True))


def test_loops_of_known_length_and_branches():
    def function(x):
        turned = lax.fori_loop(0, 40, lambda i, y: y * 0.9 + x, jnp.zeros_like(x))
        picked = lax.fori_loop(0, 3, lambda i, y: y.at[i].add(x[2 - i] * i), x[:3])
        large = lax.cond(jnp.all(x[0] > 0), lambda: (x * 3).sum(0), lambda: jnp.zeros(1))
        stacked = lax.map(lambda row: row * row, x)
        return turned, picked, large, stacked, jnp.argmax(x, 0), jnp.linalg.cholesky(jnp.eye(3) * (2 + x[0] ** 2))

    assert_same(lambda x: tuple(function(x)[:4]), rows(20, 4))
    assert_same(lambda x: function(x)[5][..., None], rows(20, 4))


def test_long_loops_read_what_all_problems_share():
    """As for thousands of disturbance directions."""

    def function(x, table):
        def body(i, best):
            some = lax.dynamic_slice_in_dim(table, i * 4, 4)
            return jnp.maximum(best, (some[:, :3] * x[None]).sum(1).max(0))

        return lax.fori_loop(0, 32, body, jnp.zeros(1))

    assert_same(function, rows(30, 3), rows(128, 3, seed=1), shared=(False, True))


def test_large_loops_read_what_they_carry():
    """A round that slices what the rounds before it computed is written out, however much it computes."""

    def function(x):
        with loops():
            return repeat(4, lambda i, x: jnp.where(x > 0, x + x[i] * x[i], x), x)

    assert_same(function, rows(9, 6, 500))


@pytest.mark.parametrize("dtype", ["float64", "float32"])
def test_long_loops_read_and_stack_what_is_computed(dtype):
    """Arrays computed before the loops, in a round of the loop around them, or stacked by a loop before."""

    def function(x, table):
        fixed, marks = jnp.abs(x) * 2 + jnp.abs(table), x > 0

        def one(sums, parts):
            a, b, mark = parts
            whole = jnp.where(mark, a / (1 + b), a + b)
            return 0.5 * sums + whole, (whole[None], jnp.full_like(whole, 2), mark | (a > b), sums)

        def again(sums, parts):
            (whole,), two, flag, before = parts
            return 0.5 * sums + jnp.where(flag, whole, two * whole), whole + 0.1 * before

        def round_of(state):
            step, y, total = state
            moving = jnp.roll(y, 1, 0) * 0.5 + fixed
            total, stacked = lax.scan(one, total, (fixed, moving, marks))
            total, last = lax.scan(again, total, stacked)
            return step + 1, y * 0.9 + last / (1 + last * last), total

        unfinished = lambda state: (state[0] < 30) & jnp.any(state[1][0] < 3 + jnp.abs(x[1]))
        with loops():
            return lax.while_loop(unfinished, round_of, (jnp.zeros((), jnp.int32), jnp.abs(x), x[0] * 0))[1:]

    assert_same(function, rows(37, 80, dtype=dtype), rows(80, dtype=dtype, seed=2), shared=(False, True))


def test_grasps_of_twenty_contacts_have_kernels(monkeypatch):
    """As many as a hand has links; of (21), and of (22), whose program is the larger one."""

    class Lowered(Exception):
        pass

    def stop(plan, name):
        lower(plan.trace(), list(plan.shared))
        raise Lowered

    def solve(normals, margin):
        grasp = jg.Contacts.from_normals(0.03 * normals, normals, friction=0.6, max_force=6.0)
        forces, weight = jg.DisturbanceSet.forces(1.0), jnp.zeros((2, 6))
        if margin is None:
            return jg.largest_disturbance(grasp, forces, weight).margin
        return jg.least_effort(grasp, forces, margin, weight).forces

    monkeypatch.setattr(primitive, "_compile", stop)
    monkeypatch.setattr(primitive.folder, "read", lambda _: None)
    monkeypatch.setattr(primitive.folder, "keep", lambda *_: None)
    for margin in (None, jnp.ones(2)):
        with pytest.raises(Lowered):
            jax.jit(solve).lower(rows(2, 20, 3), margin)


def test_the_example_of_the_compilers_map(capsys):
    """What the example in the README of kernels prints is what stands there."""
    text = (Path(kernels.__file__).parent / "README.md").read_text()
    code, *printed = re.findall(r"^```(?:python)?\n(.*?)^```", text.partition("## One example")[2], re.S | re.M)
    exec(code, {})
    assert capsys.readouterr().out.strip() == "".join(printed).strip()


def test_loops_add_their_counter_to_integers_of_every_lane():
    def function(x, whole):
        def body(i, state):
            total, mixed, last = state
            return total + x * i, mixed + i * whole, jnp.where(x[0] > 0, i, i + 1) + last

        return lax.fori_loop(0, 40, body, (jnp.zeros_like(x), whole, whole[0]))

    whole = jnp.asarray(np.arange(40).reshape(20, 2) - 7, jnp.int32)
    assert_same(function, rows(20, 4), whole)


def test_what_cannot_be_fused_is_left_to_xla():
    def transform(parts):
        return jnp.fft.fft(parts[0][:, 0]).real[:, None]

    left = primitive.fused(transform, [rows(3, 4)], (False,), lambda leaves: leaves[0] * 2)
    np.testing.assert_array_equal(left, rows(3, 4) * 2)


def test_what_has_no_kernel_is_known_from_disk(monkeypatch, tmp_path):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    one = [jax.ShapeDtypeStruct((4, 1), jnp.float64)]
    plan = primitive._make_plan(lambda parts: jnp.fft.fft(parts[0][:, 0]).real[:, None], one, (False,), None, "cpu")
    with pytest.raises(primitive.Unsupported, match="complex"):
        primitive._load(plan)
    with pytest.raises(primitive.Unsupported, match="earlier"):
        primitive._load(plan)


@pytest.mark.parametrize(
    "function",
    [lambda w: w & 3, lambda w: 8 | w, lambda w: w ^ w[::-1], lambda w: ~w, jnp.abs, lambda w: lax.reduce_and(w, (0,))],
)
def test_bits_of_integers_are_left_to_xla(function):
    """Kernels have these operations for truth values or for floats alone."""
    whole = jnp.asarray(np.arange(12).reshape(6, 2) - 5, jnp.int32)
    run = lambda w, x: (function(w), x)  # noqa: E731
    leaves = [whole, rows(6, 1)]
    by_xla = mapped(run, *leaves)
    out = primitive.fused(lambda parts: run(*parts), leaves, (False, False), lambda leaves: mapped(run, *leaves))
    np.testing.assert_array_equal(out[0], by_xla[0])


def reach(wrenches, rows):
    with loops():
        return support((Vertices(wrenches=wrenches),), rows)


@pytest.mark.parametrize("shared", [True, False])
def test_code_is_as_long_for_many_vertices_as_for_few(shared):
    def lines(count: int) -> int:
        jaxpr = jax.make_jaxpr(reach)(jnp.zeros((count, 6, 1)), jnp.zeros((6, 9, 4, 1)))
        return write_module(lower(jaxpr, [shared, False]), "length", 8, estimates=False).count("\n")

    # All but the pointers into the frame, of which there are a few more where it is large.
    assert abs(lines(128) - lines(4096)) < 100


@pytest.mark.parametrize("shared", [True, False])
def test_many_vertices_that_each_problem_has_for_itself(shared):
    """They need more room than there is on a thread's stack."""
    wrenches = jnp.asarray(np.random.default_rng(0).normal(size=((1,) if shared else (37,)) + (1024, 6)))
    turned = jnp.asarray(np.random.default_rng(1).normal(size=(37, 6, 9, 4)))
    out = fused(reach, wrenches[0] if shared else wrenches, turned, shared=(shared, False))
    np.testing.assert_allclose(out, np.einsum("lvi,lirc->lvrc", wrenches, turned).max(1), rtol=ROUNDING["float64"])
