"""Arrays that are divided over devices: each computes its own lanes, and nothing is sent."""

from __future__ import annotations

import re
import subprocess
import sys

import jax
import numpy as np
import pytest
from jax.sharding import AxisType, NamedSharding
from jax.sharding import PartitionSpec as P
from jax_sample import PUSHES, at, grasps, margin

import jaxgrasp as jg
from jaxgrasp.metrics.interior import contains_origin

SAME = 1e-9
SENT = re.compile(r"\b(all-reduce|all-gather|all-to-all|collective-permute|reduce-scatter)")


def slope(contacts):
    return jax.grad(lambda p: at(p, contacts).sum())(contacts.positions)


def effort(contacts):
    return jg.least_effort(contacts, PUSHES, 0.1, cone_edges=4).effort


@pytest.mark.parametrize("kind", [AxisType.Auto, AxisType.Explicit])
@pytest.mark.parametrize("function", [margin, effort, slope])
def test_the_work_is_divided(function, kind):
    contacts = grasps(8)
    mesh = jax.make_mesh((2,), ("g",), axis_types=(kind,), devices=jax.devices("cpu")[:2])
    spread = jax.device_put(contacts, NamedSharding(mesh, P("g")))
    program = jax.jit(function).lower(spread).compile()
    out = program(spread)
    assert {shard.data.shape[0] for shard in out.addressable_shards} == {4}
    assert not SENT.search(program.as_text())
    np.testing.assert_allclose(out, function(contacts), rtol=SAME, atol=SAME)


def test_without_jit_and_inside_set_mesh():
    contacts = grasps(8)
    mesh = jax.make_mesh((2,), ("g",), devices=jax.devices("cpu")[:2])
    spread = jax.device_put(contacts, NamedSharding(mesh, P("g")))
    with jax.set_mesh(mesh):
        found, turned = margin(spread), slope(spread)
        assert jax.typeof(found).sharding.spec == P("g")
        np.testing.assert_allclose(jax.vmap(margin)(spread), found, rtol=SAME)
    np.testing.assert_allclose(found, margin(contacts), rtol=SAME)
    np.testing.assert_allclose(turned, slope(contacts), rtol=SAME, atol=SAME)


@pytest.mark.parametrize("kind", [AxisType.Auto, AxisType.Explicit])
def test_a_sample_of_each_device_is_audited(kind):
    """Of 150 lanes on two devices the last 11 of each are left over by an audit of one in sixteen."""
    contacts = grasps(150)
    mesh = jax.make_mesh((2,), ("g",), axis_types=(kind,), devices=jax.devices("cpu")[:2])
    spread = jax.device_put(contacts, NamedSharding(mesh, P("g")))
    found = jax.jit(margin)(spread)
    assert {shard.data.shape[0] for shard in found.addressable_shards} == {75}
    np.testing.assert_allclose(found, margin(contacts), rtol=SAME, atol=SAME)


def test_closure_is_tested_on_each_device():
    mesh = jax.make_mesh((2,), ("g",), axis_types=(AxisType.Auto,), devices=jax.devices("cpu")[:2])
    wrenches = 0.1 * jax.random.normal(jax.random.key(0), (4, 12, 6))
    on_each = jax.shard_map(jax.vmap(contains_origin), mesh=mesh, in_specs=P("g"), out_specs=P("g"))
    np.testing.assert_array_equal(on_each(wrenches), jax.vmap(contains_origin)(wrenches))


FIRST = """
import jax
from jax_sample import grasps, margin
with jax.set_mesh(jax.make_mesh((1,), ("g",))):
    print(margin(grasps(3)).shape, jax.jit(margin)(grasps(3)).shape)
"""


def test_the_first_call_of_a_process_inside_set_mesh():
    run = subprocess.run([sys.executable, "-c", FIRST], capture_output=True, text=True, cwd="tests", timeout=200)
    assert run.stdout == "(3,) (3,)\n", run.stderr
