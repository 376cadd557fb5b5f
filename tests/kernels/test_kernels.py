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
from scipy import stats

import jaxgrasp as jg
from jaxgrasp import kernels
from jaxgrasp.geometry.pairs.geom import Touch
from jaxgrasp.kernels import primitive
from jaxgrasp.kernels.code import llvm
from jaxgrasp.kernels.store import treedef

SAME_MARGIN = {"float64": 2e-8, "float32": 1e-4}
"""Of max(|margin|, Lambda). In float32 both may be off by what the method accepts."""

STALLED = 3e-4
"""Of max(|margin|, Lambda): gaps that float32's rounding holds open near the accepted one, which some pass by luck."""


@pytest.fixture(scope="module", autouse=True)
def there_are_kernels():
    assert kernels.usable()


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
    normals = jnp.asarray(np.random.default_rng(5).normal(size=(count, 4, 3)))
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
from jaxgrasp.kernels import primitive
out = primitive.fused(lambda parts: parts[0] * 2, [jnp.ones((3, 2))], (False,), lambda leaves: jnp.zeros(1))
again = primitive.fused(lambda parts: parts[0] * 3, [jnp.ones((3, 2))], (False,), lambda leaves: jnp.zeros(1))
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
            "from jaxgrasp.kernels.cpu import module as cpu\ncpu.API_BYTES = 9999\n",
            "hands arrays over in another way",
        ),
        ("from jaxgrasp.kernels.cpu import module as cpu; cpu.HANDLER += 'nonsense'", "does not compile"),
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


def test_vectors_are_as_long_as_asked_for(monkeypatch):
    known = llvm.processor_with(None)
    monkeypatch.setenv(llvm.SETTING, "128")
    short = llvm.processor.__wrapped__()
    assert short.vector_bytes == 16 and not short.estimates and not short.spoilt
    # Kernels are kept by this.
    assert (short.description == known.description) == (known.vector_bytes == 16)
    monkeypatch.setenv(llvm.SETTING, "64")
    with pytest.raises(ValueError, match="JAXGRASP_VECTOR_BITS: got '64', wanted auto, 128, 256 or 512"):
        llvm.processor.__wrapped__()
    if known.vector_bytes < 64:
        with pytest.raises(llvm.Unavailable, match="vectors of 512 bits are asked for"):
            llvm.processor_with(512)


def test_kernels_are_kept_on_disk(tmp_path):
    done = run(SMALL, XDG_CACHE_HOME=str(tmp_path))
    assert done.stdout.strip() == "12.0"
    folder = tmp_path / "jaxgrasp" / "kernels"
    kept = sorted(folder.iterdir())
    assert len(kept) == 3 and folder.stat().st_mode & 0o077 == 0
    no_compiling = "from jaxgrasp.kernels.code import llvm; llvm.compile_module = None"
    assert run(no_compiling + SMALL, XDG_CACHE_HOME=str(tmp_path)).stdout.strip() == "12.0"
    # What is cut short, belongs to another key, or could come from others, is not used.
    whole = [file.read_bytes() for file in kept]
    for spoil in (lambda k: whole[k][:-7], lambda k: whole[k - 1]):
        for k, file in enumerate(kept):
            file.write_bytes(spoil(k))
        assert run(SMALL, XDG_CACHE_HOME=str(tmp_path)).stdout.strip() == "12.0"
        assert [file.read_bytes() for file in kept] == whole
    folder.chmod(0o777)
    monkey = "from jaxgrasp.kernels.store import folder; print(folder.read('" + kept[0].name + "'))"
    assert run(monkey, XDG_CACHE_HOME=str(tmp_path)).stdout.strip() == "None"


KNOWN = """
import jax.numpy as jnp
from jaxgrasp.kernels import primitive
def twice(parts):
    print("traced")
    return {"out": parts[0] * 2}
for width in (2, 2, 5):
    out = primitive.fused(twice, [jnp.ones((3, width))], (False,), lambda leaves: None, "twice")
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
    primitive._warn.cache_clear()
    with warnings.catch_warnings(record=True) as told:
        warnings.simplefilter("always")
        primitive._warn("a reason")
        primitive._warn("a reason")
    assert len(told) == 1


def test_structures_of_results_are_data():
    """What is kept beside a kernel names records of this package, and nothing that does something."""
    point = Touch(position=np.zeros((3, 1)), normal=np.zeros((3, 1)), distance=np.zeros(1))
    tree = {"a": [np.zeros((3, 1), np.float32), None], "b": (np.zeros(2, bool),), "c": point}
    again = treedef.read(treedef.write(tree))
    assert jax.tree.structure(again) == jax.tree.structure(tree)
    for one, other in zip(jax.tree.leaves(again), jax.tree.leaves(tree), strict=True):
        assert one.shape == other.shape and one.dtype == other.dtype
    assert treedef.read(treedef.write({"edges": 8})) == {"edges": 8}
    for content in (
        b'{"class": ["os", "system"], "fields": {"command": null}}',
        b'{"class": ["jaxgrasp.kernels.store.folder", "keep"], "fields": {"key": null, "content": null}}',
        b"[]",
        b"no JSON",
    ):
        with pytest.raises(ValueError):
            treedef.read(content)
