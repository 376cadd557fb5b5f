"""The package itself, compiled for a shape and spread over the devices of this process."""

from __future__ import annotations

import functools
import time
from collections.abc import Callable
from typing import Any

import jax
import numpy as np
from jax.sharding import Mesh, NamedSharding
from jax.sharding import PartitionSpec as P

import jaxgrasp as jg
from benchmarks.suite.problems import FRICTION, MAX_FORCE, Grasps, sample
from jaxgrasp.compiling import options


class Compiled:
    """A function compiled for its arguments; `run` calls it and waits, `out` is what it returned last."""

    def __init__(self, function: Callable, batched: Any, shared: Any, devices: int) -> None:
        mesh = Mesh(np.array(jax.local_devices()[:devices]), ("lanes",))
        if devices > 1:
            function = jax.shard_map(
                function, mesh=mesh, in_specs=(P("lanes"), P()), out_specs=P("lanes"), check_vma=False
            )
        self._arguments = (
            jax.device_put(batched, NamedSharding(mesh, P("lanes"))),
            jax.device_put(shared, NamedSharding(mesh, P())),
        )
        start = time.perf_counter()
        self._call = jax.jit(function, compiler_options=options()).lower(*self._arguments).compile()
        self.compile_seconds = time.perf_counter() - start
        self.out: Any = None
        self.run()

    def run(self) -> None:
        self.out = jax.block_until_ready(self._call(*self._arguments))


def contacts(grasps: Grasps, dtype: str) -> jg.Contacts:
    return jg.Contacts.from_frames(
        grasps.positions.astype(dtype), grasps.frames.astype(dtype), friction=FRICTION, max_force=MAX_FORCE
    )


@functools.cache
def margins(n_c: int, batch: int, dtype: str, devices: int, *, mapped: bool = False) -> Compiled:
    """(21) from contacts to the whole solution, its certificates included; `mapped` by vmap over single grasps."""
    grasps = sample(batch, n_c)
    solve = jax.vmap(jg.largest_disturbance, (0, None)) if mapped else jg.largest_disturbance
    return Compiled(solve, contacts(grasps, dtype), jg.DisturbanceSet.forces(1.0), devices)


def worst_cases(grasps: Grasps, wrenches: np.ndarray, dtype: str, devices: int) -> Compiled:
    """S_1 (17) and S_2 (18) for vertices that all grasps share."""
    vertices = jg.DisturbanceSet.vertices(wrenches.astype(dtype))
    return Compiled(jg.worst_case, contacts(grasps, dtype), vertices, devices)
