"""`jax.shard_map` as JAX has it by default: results vary over the axes over which their arguments do."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.sharding import Mesh
from jax.sharding import PartitionSpec as P
from jax_sample import at, grasps, margin, min_weight

SAME = 1e-9
DIVIDED, WHOLE = P("g"), P()


@pytest.fixture(scope="module")
def contacts():
    return grasps(8)


@pytest.fixture(scope="module")
def mesh():
    return Mesh(np.array(jax.devices("cpu")[:2]), ("g",))


def over(mesh, function, in_specs=DIVIDED, out_specs=DIVIDED):
    return jax.jit(jax.shard_map(function, mesh=mesh, in_specs=in_specs, out_specs=out_specs))


@pytest.mark.parametrize("function", [margin, min_weight])
def test_the_same_values(mesh, contacts, function):
    np.testing.assert_allclose(over(mesh, function)(contacts), function(contacts), rtol=SAME)


def test_results_vary_like_their_arguments(mesh, contacts):
    types = []
    over(mesh, lambda c: types.append(jax.typeof(margin(c))) or c.friction)(contacts)
    assert types[0].manual_axis_type.varying == {"g"}
    with pytest.raises(ValueError, match="out_specs"):
        over(mesh, lambda c: margin(c).sum(), out_specs=WHOLE)(contacts)


@pytest.mark.parametrize("inside", [True, False])
def test_the_gradient_of_what_all_devices_share(mesh, contacts, inside):
    """d/dt of the sum of t times the margins of all devices is the sum of all margins."""
    weighed = lambda c, t: (t * jax.lax.stop_gradient(margin(c))).sum()  # noqa: E731
    if inside:
        slope = over(mesh, lambda c, t: jax.grad(weighed, 1)(c, t), (DIVIDED, WHOLE), WHOLE)(contacts, 1.0)
    else:
        total = over(mesh, lambda c, t: jax.lax.psum(weighed(c, t), "g"), (DIVIDED, WHOLE), WHOLE)
        slope = jax.grad(total, 1)(contacts, 1.0)
    np.testing.assert_allclose(slope, margin(contacts).sum(), rtol=SAME)


@pytest.mark.parametrize("inside", [True, False])
def test_the_gradient_of_a_margin(mesh, contacts, inside):
    slope = jax.grad(lambda p, c: at(p, c).sum())
    plain = slope(contacts.positions, contacts)
    if inside:
        found = over(mesh, slope, (DIVIDED, DIVIDED))(contacts.positions, contacts)
    else:
        found = jax.grad(lambda p, c: over(mesh, at, (DIVIDED, DIVIDED))(p, c).sum())(contacts.positions, contacts)
    assert jnp.abs(plain).max() > 0
    np.testing.assert_allclose(found, plain, rtol=SAME, atol=SAME)
