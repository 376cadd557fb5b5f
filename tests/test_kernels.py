"""Fused kernels against XLA: the same functions, the same answers; and what happens where there are none."""

from __future__ import annotations

import os
import subprocess
import sys
import threading
import warnings
from functools import partial

import harness
import jax
import jax.numpy as jnp
import numpy as np
import problems
import pytest
from jax import lax
from scipy import stats

import jaxgrasp as jg
from jaxgrasp import kernels
from jaxgrasp.geometry.pairs.geom import Touch
from jaxgrasp.kernels import machine, native, outline

SAME_MARGIN = {"float64": 2e-8, "float32": 1e-4}
"""Of max(|margin|, Lambda). In float32 both may be off by what the method accepts."""

STALLED = 3e-4
"""Of max(|margin|, Lambda): gaps that float32's rounding holds open near the accepted one, which some pass by luck."""

ROUNDING = {"float64": 1e-13, "float32": 2e-5}
"""Relative, for short functions: reciprocals are good to a unit or two in the last place."""


def fused(function, *leaves, shared=None):
    """A function of one problem over the leading axis, fused; the lane axis trails inside."""
    run = partial(native.fused, shared=shared or (False,) * len(leaves), otherwise=no_kernel)
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


def test_what_cannot_be_fused_is_left_to_xla():
    def transform(parts):
        return jnp.fft.fft(parts[0][:, 0]).real[:, None]

    left = native.fused(transform, [rows(3, 4)], (False,), lambda leaves: leaves[0] * 2)
    np.testing.assert_array_equal(left, rows(3, 4) * 2)


def without_kernels(function, *args):
    jax.clear_caches()
    with kernels.without():
        out = harness.as_numpy(function(*args))
    jax.clear_caches()
    return out


@pytest.mark.parametrize("precision", ["float64", "float32"])
@pytest.mark.parametrize(
    "name", [n if n == "4 contacts" else pytest.param(n, marks=pytest.mark.thorough) for n in problems.GROUPS]
)
def test_the_same_margins_as_on_xla(name, precision):
    group = problems.group(name)
    data, edges = harness.data_of(group.batch, jnp.dtype(precision)), group.cone_edges
    ours, theirs = harness.margins(name, precision), without_kernels(partial(harness.largest, cone_edges=edges), *data)
    S_1, S_2 = jg.worst_case(*data[:2], cone_edges=edges)
    units = jnp.where(group.batch.active, data[0].max_force, 1), jnp.where(group.batch.active, data[0].friction, 1)
    largest = jnp.maximum((-S_1.min(-1) / jnp.maximum(units[1], 1e-6) / units[0]).max(-1), (S_2 / units[0]).max(-1))
    margin, upper = np.fmax(ours.margin, theirs.margin), np.stack([ours.upper_bound, theirs.upper_bound])
    unit = np.maximum(np.abs(margin), 1 / np.asarray(largest))
    same = ours.status == theirs.status
    assert same.all() if precision == "float64" else same.mean() > 0.999
    known = np.isfinite(ours.margin) & np.isfinite(theirs.margin)
    assert (np.abs(ours.margin - theirs.margin)[known] <= (SAME_MARGIN[precision] * unit)[known]).all()
    only_one = (np.isnan(ours.margin) != np.isnan(theirs.margin)) & same
    if precision == "float64":
        assert not only_one.any()
    # Of a load that cannot be borne float32 may prove just that, or close the gap too; the bounds then tell the same.
    # They are one in a thousand at most, as far as a few such lanes can tell, and each is held to that.
    rate = stats.binomtest(int(only_one.sum()), len(only_one), 0.001, alternative="greater")
    assert rate.pvalue > 0.01 and (ours.status == jg.Status.INFEASIBLE)[only_one].all()
    assert (upper < 0)[:, only_one].all()
    assert ((margin - 1e-5 * unit <= upper) & (upper <= margin + STALLED * unit))[:, only_one].all()


def grasps(count: int):
    normals = rows(count, 4, 3, seed=5)
    return jg.Contacts.from_normals(normals, normals, friction=0.5, max_force=1.0)


def margin(contacts):
    return jg.largest_disturbance(contacts, jg.DisturbanceSet.forces(1.0), cone_edges=4).margin


def test_many_threads_at_once():
    every = grasps(506)
    batches = [jax.tree.map(lambda x, k=k: x[k : k + 500], every) for k in range(6)]
    wanted = [np.asarray(margin(batch)) for batch in batches]
    got: list = [None] * len(batches)

    def work(k: int) -> None:
        for _ in range(5):
            got[k] = np.asarray(margin(batches[k]))

    threads = [threading.Thread(target=work, args=(k,)) for k in range(len(batches))]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join(120)
        assert not thread.is_alive()
    for ours, theirs in zip(got, wanted, strict=True):
        np.testing.assert_array_equal(ours, theirs)


def test_a_lane_does_not_depend_on_its_place():
    contacts, order = grasps(100), np.random.default_rng(0).permutation(100)
    np.testing.assert_array_equal(margin(contacts)[order], margin(jax.tree.map(lambda x: x[order], contacts)))


def run(code: str, **environment: str) -> subprocess.CompletedProcess:
    return subprocess.run(
        [sys.executable, "-W", "always", "-c", code],
        env={**os.environ, "JAX_PLATFORMS": "cpu", **environment},
        capture_output=True,
        text=True,
        timeout=200,
        check=True,
    )


SMALL = """
import jax, numpy as np, jax.numpy as jnp
from jaxgrasp.kernels import native
out = native.fused(lambda parts: parts[0] * 2, [jnp.ones((3, 2))], (False,), lambda leaves: jnp.zeros(1))
again = native.fused(lambda parts: parts[0] * 3, [jnp.ones((3, 2))], (False,), lambda leaves: jnp.zeros(1))
print(float(out.sum()))
"""


@pytest.mark.parametrize(
    ("before", "why"),
    [
        ("import sys; sys.modules['llvmlite'] = None", "llvmlite is not installed"),
        (
            "import llvmlite.binding as b; F = type('F', (dict,), {'flatten': lambda s: ''})\n"
            "b.get_host_cpu_features = F",
            "has no fused multiply-add",
        ),
        (
            "from jaxgrasp.kernels import cpu\n"
            "cpu.HANDLER = cpu.HANDLER.replace('uge i64 %api.size, 152', 'uge i64 %api.size, 9999')",
            "hands arrays over in another way",
        ),
        ("from jaxgrasp.kernels import cpu; cpu.HANDLER += 'nonsense'", "does not compile"),
    ],
)
def test_where_there_are_none_one_warning_says_why(before, why, tmp_path):
    done = run(before + SMALL, XDG_CACHE_HOME=str(tmp_path))
    assert done.stdout.strip() == "0.0"
    assert done.stderr.count("fused kernels are not used") == 1
    assert why in done.stderr


def test_the_setting(monkeypatch, tmp_path):
    done = run(SMALL, JAXGRASP_KERNELS="xla")
    assert done.stdout.strip() == "0.0" and "fused" not in done.stderr
    monkeypatch.setenv("JAXGRASP_KERNELS", "fast")
    with pytest.raises(ValueError, match="JAXGRASP_KERNELS: got 'fast', wanted auto, xla or fused"):
        kernels.usable()


def test_kernels_are_kept_on_disk(tmp_path):
    done = run(SMALL, XDG_CACHE_HOME=str(tmp_path))
    assert done.stdout.strip() == "12.0"
    folder = tmp_path / "jaxgrasp" / "kernels"
    kept = sorted(folder.iterdir())
    assert len(kept) == 3 and folder.stat().st_mode & 0o077 == 0
    no_compiling = "from jaxgrasp.kernels import machine; machine.compiled = None"
    assert run(no_compiling + SMALL, XDG_CACHE_HOME=str(tmp_path)).stdout.strip() == "12.0"
    # What is cut short, or could come from others, is not used.
    for file in kept:
        file.write_bytes(file.read_bytes()[:-7])
    assert run(SMALL, XDG_CACHE_HOME=str(tmp_path)).stdout.strip() == "12.0"
    assert all(machine.hashlib.sha256(f.read_bytes()[32:]).digest() == f.read_bytes()[:32] for f in kept)
    folder.chmod(0o777)
    monkey = "from jaxgrasp.kernels import machine; print(machine.cached('" + kept[0].name + "'))"
    assert run(monkey, XDG_CACHE_HOME=str(tmp_path)).stdout.strip() == "None"


KNOWN = """
import jax.numpy as jnp
from jaxgrasp.kernels import native
def twice(parts):
    print("traced")
    return {"out": parts[0] * 2}
for width in (2, 2, 5):
    out = native.fused(twice, [jnp.ones((3, width))], (False,), lambda leaves: None, "twice")
    print(float(out["out"].sum()))
"""


def test_what_is_known_by_its_name_is_not_traced_again(tmp_path):
    done = run(KNOWN, XDG_CACHE_HOME=str(tmp_path))
    assert done.stdout.split() == ["traced", "12.0", "12.0", "traced", "30.0"]
    assert run(KNOWN, XDG_CACHE_HOME=str(tmp_path)).stdout.split() == ["12.0", "12.0", "30.0"]
    # Compiled code is long, what is known of a program short: without the first it is traced after all.
    for file in (tmp_path / "jaxgrasp" / "kernels").iterdir():
        if file.read_bytes()[32:36] == b"\x7fELF":
            file.unlink()
    again = run(KNOWN, XDG_CACHE_HOME=str(tmp_path)).stdout.split()
    assert again == ["traced", "12.0", "12.0", "traced", "30.0"]


def test_a_folder_that_cannot_be_written(tmp_path):
    (tmp_path / "jaxgrasp").write_text("a file where a folder is wanted")
    done = run(SMALL, XDG_CACHE_HOME=str(tmp_path))
    assert done.stdout.strip() == "12.0"
    assert done.stderr.count("cannot be kept on disk") == 1


def test_a_warning_is_not_repeated():
    native._tell.cache_clear()
    with warnings.catch_warnings(record=True) as told:
        warnings.simplefilter("always")
        native._tell("a reason")
        native._tell("a reason")
    assert len(told) == 1


def test_outlines_are_data():
    """What is kept beside a kernel names records of this package, and nothing that does something."""
    point = Touch(position=np.zeros((3, 1)), normal=np.zeros((3, 1)), distance=np.zeros(1))
    tree = {"a": [np.zeros((3, 1), np.float32), None], "b": (np.zeros(2, bool),), "c": point}
    again = outline.read(outline.written(tree))
    assert jax.tree.structure(again) == jax.tree.structure(tree)
    for one, other in zip(jax.tree.leaves(again), jax.tree.leaves(tree), strict=True):
        assert one.shape == other.shape and one.dtype == other.dtype
    assert outline.read(outline.written({"edges": 8})) == {"edges": 8}
    for content in (
        b'{"class": ["os", "system"], "fields": {"command": null}}',
        b'{"class": ["jaxgrasp.kernels.machine", "keep"], "fields": {"key": null, "objects": null}}',
        b"[]",
        b"no JSON",
    ):
        with pytest.raises(ValueError):
            outline.read(content)
