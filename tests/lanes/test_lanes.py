"""Stages that work on several programs of a lane: the same numbers as without lanes, however they are arranged."""

from __future__ import annotations

import contextlib

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxgrasp.kernels import without
from jaxgrasp.lanes.fence import fenced
from jaxgrasp.lanes.tiles import Each, map_lanes

LANES, PROGRAMS = 37, 5
FACTORS = np.arange(1.0, PROGRAMS + 1)


def spread(given: dict) -> tuple:
    x = given["x"]
    programs = {"first": x[:, None] * FACTORS[:, None], "second": (x + given["shared"])[:, None]}
    return {"x": x}, {"a": programs, "b": {"x": x[:, None]}}


def collect(given: tuple) -> jax.Array:
    kept, solved = given
    return solved["a"].sum(0) + kept["x"][0] + solved["b"][0, 0]


STAGES = (
    spread,
    Each({"a": lambda t: t["first"][0] * t["second"][1] - t["first"][2], "b": lambda t: 2 * t["x"]}),
    collect,
)


def mapped(x: jax.Array, shared: jax.Array) -> jax.Array:
    arguments, alike = {"x": x, "shared": shared}, {"x": False, "shared": True}
    return map_lanes(STAGES, arguments, alike, 8, compact=False, tile=4)


def expected(x: np.ndarray, shared: np.ndarray) -> np.ndarray:
    first, second = x[:, :, None] * FACTORS, (x + shared)[:, :, None]
    return (first[:, 0] * second[:, 1] - first[:, 2]).sum(-1) + x[:, 0] + 2 * x[:, 0]


@pytest.mark.parametrize("fused", [True, False])
def test_programs_of_a_lane_are_lanes_of_their_own(fused):
    rng = np.random.default_rng(0)
    x, shared = rng.normal(size=(LANES, 3)), rng.normal(size=3)
    with contextlib.nullcontext() if fused else without():
        np.testing.assert_allclose(jax.jit(mapped)(x, shared), expected(x, shared), rtol=1e-12)
        batches = rng.normal(size=(4, LANES, 3))
        wanted = np.stack([expected(one, shared) for one in batches])
        np.testing.assert_allclose(jax.vmap(mapped, (0, None))(batches, jnp.asarray(shared)), wanted, rtol=1e-12)
        assert mapped(jnp.zeros((0, 3)), jnp.asarray(shared)).shape == (0,)


def test_a_fenced_result_that_is_costly_enough_for_threads_stays_in_its_tile():
    """XLA divides such an operation over threads, which it cannot do inside a tile that is one function."""

    @fenced
    def costly(x: jax.Array) -> jax.Array:
        y = x
        for _ in range(30):
            y = jnp.sin(y * y + x)
        return y

    x = np.random.default_rng(0).random((512, 256), np.float32)
    run = jax.jit(lambda x: map_lanes((lambda x: 2 * costly(x),), x, False, 8, compact=True))
    with without():
        np.testing.assert_allclose(run(x), 2 * costly(x), rtol=1e-5, atol=1e-5)
