"""The same numbers however the lanes are arranged: batch shapes, jit, vmap, devices; and no needless compilation."""

from __future__ import annotations

import time
from functools import partial

import harness
import jax
import jax.numpy as jnp
import numpy as np
import problems
import pytest
from jax.sharding import Mesh, PartitionSpec
from problems import sample

import jaxgrasp as jg
from jaxgrasp.compiling import compiled

SAME = 1e-12
"""Relative: another arrangement of the lanes may contract multiplications and additions differently, not more."""

VMAP_COST = 1.2
"""A mapped single grasp against the direct batch."""

EDGES = 4
"""Fewer facets compile faster, and how the lanes are arranged has nothing to do with them."""

TIMED_LANES, TIMED_ROUNDS = 4096, 15


largest = partial(harness.largest, cone_edges=EDGES)
least = partial(harness.least, cone_edges=EDGES)


@pytest.fixture(scope="module")
def batch() -> problems.Batch:
    return sample()


@pytest.fixture(scope="module")
def direct(batch):
    return harness.as_numpy(largest(*harness.data_of(batch)))


def assert_same(ours, expected) -> None:
    np.testing.assert_array_equal(ours.status, expected.status)
    np.testing.assert_array_equal(ours.iterations, expected.iterations)
    np.testing.assert_array_equal(ours.rank, expected.rank)
    for name in ("margin", "upper_bound", "effort"):
        np.testing.assert_allclose(getattr(ours, name), getattr(expected, name), rtol=SAME, atol=SAME, err_msg=name)
    unit = np.nanmax(np.abs(expected.forces))
    np.testing.assert_allclose(ours.forces, expected.forces, rtol=0, atol=1e3 * SAME * unit)


def at(tree, lanes):
    return jax.tree.map(lambda x: x[lanes], tree)


def reshaped(tree, *shape: int):
    return jax.tree.map(lambda x: x.reshape(*shape, *x.shape[1:]), tree)


def flattened(tree, axes: int):
    return jax.tree.map(lambda x: np.asarray(x).reshape(-1, *x.shape[axes:]), tree)


def test_a_single_grasp(batch, direct):
    for lane in (0, 17, 40):
        single = harness.as_numpy(largest(*at(harness.data_of(batch), lane)))
        assert single.margin.shape == single.status.shape == () and single.forces.shape == (4, 3)
        assert_same(single, at(direct, lane))


@pytest.mark.parametrize("shape", [(1,), (3, 1, 2)])
def test_batch_shapes(batch, direct, shape):
    count = int(np.prod(shape))
    ours = largest(*reshaped(harness.data_of(batch[:count]), *shape))
    assert ours.margin.shape == shape and ours.forces.shape == (*shape, 4, 3)
    assert ours.cone_multipliers.shape[: len(shape)] == shape and ours.wrench_multipliers.shape == (*shape, 6)
    assert_same(flattened(ours, len(shape)), at(direct, slice(count)))


def test_an_empty_batch(batch):
    ours = largest(*harness.data_of(batch[:0]))
    assert ours.margin.shape == (0,) and ours.forces.shape == (0, 4, 3)


def test_all_arguments_broadcast(batch):
    contacts, disturbances, load, _ = at(harness.data_of(batch), slice(3))
    column, disturbances = at(contacts, (slice(None), None)), at(disturbances, 0)
    ours = jg.largest_disturbance(column, disturbances, required_wrench=load[:2], cone_edges=EDGES)
    assert ours.margin.shape == (3, 2)
    for i, j in np.ndindex(3, 2):
        one = jg.largest_disturbance(at(contacts, i), disturbances, required_wrench=load[j], cone_edges=EDGES)
        np.testing.assert_allclose(ours.margin[i, j], one.margin, rtol=1e-9, atol=1e-9)


def test_without_jit(batch, direct):
    contacts, disturbances, load, cone_margin = harness.data_of(batch)
    ours = jg.largest_disturbance(
        contacts, disturbances, required_wrench=load, cone_edges=EDGES, cone_margin=cone_margin
    )
    assert_same(harness.as_numpy(ours), direct)


def test_vmap_and_vmap_of_vmap(batch, direct):
    data = harness.data_of(batch)
    assert_same(harness.as_numpy(jax.vmap(largest)(*data)), direct)
    twice = jax.jit(jax.vmap(jax.vmap(largest)))(*reshaped(data, 6, -1))
    assert_same(flattened(twice, 2), direct)


@pytest.mark.thorough
def test_vmap_over_one_argument_alone(batch, direct):
    contacts, disturbances, load, cone_margin = harness.data_of(batch)
    lane = 9
    one, pushed, reserve = at((contacts, disturbances, cone_margin), lane)
    ours = jax.vmap(lambda b: largest(one, pushed, b, reserve))(load)
    assert_same(at(harness.as_numpy(ours), lane), at(direct, lane))
    mapped_last = jax.vmap(largest, in_axes=(0, 0, 1, 0))(contacts, disturbances, load.T, cone_margin)
    assert_same(harness.as_numpy(mapped_last), direct)


def test_least_effort_and_blocking_forces_under_vmap(batch, direct):
    data = harness.data_of(batch)
    margin = jnp.asarray(0.5 * np.where(direct.margin > 0, direct.margin, 0.0))
    whole = harness.as_numpy(least(*data, margin))
    assert_same(harness.as_numpy(jax.vmap(least)(*data, margin)), whole)
    contacts, vertices = data[0], jnp.asarray(batch.vertices)
    np.testing.assert_allclose(
        jax.vmap(jg.blocking_forces)(contacts, vertices),
        jg.blocking_forces(contacts, vertices),
        atol=1e-12 * float(jnp.abs(vertices).max()),
    )


def test_shard_map_over_two_devices(batch, direct):
    devices = jax.devices("cpu")
    assert len(devices) >= 2
    mesh = Mesh(np.array(devices[:2]), ("lanes",))
    lanes = PartitionSpec("lanes")
    sharded = jax.jit(jax.shard_map(largest, mesh=mesh, in_specs=lanes, out_specs=lanes))
    assert_same(harness.as_numpy(sharded(*harness.data_of(batch))), direct)


def test_other_data_are_not_compiled_again(batch, compilations):
    first = harness.data_of(batch[:7])
    largest(*first).margin.block_until_ready()
    assert compilations, "the listener hears of compilations"
    others = [at(harness.data_of(batch), slice(k, k + 7)) for k in (7, 14)]
    jax.block_until_ready(others)
    before = len(compilations)
    for other in others:
        largest(*other).margin.block_until_ready()
    assert len(compilations) == before


def test_a_second_direct_call_compiles_nothing(batch, compilations):
    contacts, disturbances, load, cone_margin = harness.data_of(batch)
    margins = jnp.full(len(batch), 1e-3)

    def work(load, cone_margin):
        options = {"cone_edges": EDGES, "cone_margin": cone_margin}
        margin = jg.largest_disturbance(contacts, disturbances, load, **options)
        effort = jg.least_effort(contacts, disturbances, margins, load, **options)
        jax.block_until_ready((margin, effort))

    work(load, cone_margin)
    doubled = jax.block_until_ready((2 * load, cone_margin + 1e-3))
    before = len(compilations)
    work(*doubled)
    assert len(compilations) == before


@pytest.mark.thorough
def test_vmap_costs_what_the_direct_batch_costs():
    some = problems.make_family(99, TIMED_LANES, 4, problems.Setting(closure="around"), 6)
    data = harness.data_of(some)
    direct, mapped = jax.jit(largest), jax.jit(jax.vmap(largest))
    best = {"direct": np.inf, "mapped": np.inf}
    for _ in range(TIMED_ROUNDS):
        for name, solve in (("direct", direct), ("mapped", mapped)):
            start = time.perf_counter()
            jax.block_until_ready(solve(*data))
            best[name] = min(best[name], time.perf_counter() - start)
    assert best["mapped"] <= VMAP_COST * best["direct"], best


@pytest.mark.thorough
def test_many_edges_in_more_than_one_tile():
    """XLA's CPU backend refuses a tile whose operations it finds large."""
    rng = np.random.default_rng(3)
    normals = jnp.asarray(rng.normal(size=(100, 8, 3)), jnp.float32)
    contacts = jg.Contacts.from_normals(normals, normals, friction=0.5, max_force=jnp.float32(1.0))
    solution = jg.largest_disturbance(contacts, jg.DisturbanceSet.ball(1.0, 0.1), cone_edges=16)
    assert np.mean(solution.status == jg.Status.SOLVED) > 0.95


def test_the_compilers_options_do_not_stand_in_the_way():
    """JAX takes options for whole programs only; who nests a call, or differentiates it, need not know."""
    x = jnp.linspace(0.0, 1.0, 3)
    sine = compiled(jnp.sin)
    np.testing.assert_allclose(jax.jit(lambda: sine(x))(), sine(x))
    np.testing.assert_allclose(jax.jit(lambda x: sine(x))(x), sine(x))
    np.testing.assert_allclose(jax.vmap(jax.grad(sine))(x), jnp.cos(x))
