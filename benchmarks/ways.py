"""Every function of the package in every transformation of JAX, at several sizes, each cell in a process of its own.

    python -m benchmarks.ways [--functions margin,effort] [--ways jit,scan] [--sizes 0,3,4096] [--kernels both]

A cell runs one function in one way and holds the result against the plain batch: 1e-9 for values, 1e-6 for what goes
through derivatives. It prints "ok", or what went wrong: a difference, an error, an abort of the process, or too much
time. `benchmarks/ways.md` is what it wrote.
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh, NamedSharding
from jax.sharding import PartitionSpec as P

import jaxgrasp as jg

VALUES, SLOPES = 1e-9, 1e-6
SECONDS = 300


def grasps(count: int, contacts: int = 4) -> jg.Contacts:
    normals = np.random.default_rng(5).normal(size=(count, contacts, 3))
    normals /= np.linalg.norm(normals, axis=-1, keepdims=True)
    return jg.Contacts.from_normals(0.05 * normals, normals, friction=0.5, max_force=1.0)


def pushes(vertices: int) -> jg.DisturbanceSet:
    if vertices == 6:
        return jg.DisturbanceSet.forces(1.0)
    given = np.random.default_rng(6).normal(size=(vertices, 6))
    return jg.DisturbanceSet.vertices(given * [1, 1, 1, 0.05, 0.05, 0.05])


# Of contacts and a set; one float array (*batch, ...) each.
FUNCTIONS: dict[str, Callable] = {
    "margin": lambda c, d: jg.largest_disturbance(c, d, cone_edges=4).margin,
    "effort": lambda c, d: jg.least_effort(c, d, 0.1, cone_edges=4).effort,
    "worst_case": lambda c, d: jg.worst_case(c, d, cone_edges=4)[1],
    "blocking": lambda c, d: jg.blocking_forces(c, d.terms[0].wrenches)[..., 0, :, :],
    "margin_13": lambda c, d: jg.formulation_margin(c, d, "13", cone_edges=4).margin,
    "min_weight": lambda c, d: jg.metrics.min_weight(c),
    "closure": lambda c, d: jg.metrics.force_closure(c).min_weight,
    "task_wrench": lambda c, d: jg.metrics.task_wrench(c, d),
    "isotropy": lambda c, d: jg.metrics.isotropy(c),
    "bound": lambda c, d: jg.metrics.ferrari_canny_bound(c),
}


def total(f: Callable, p: jax.Array, c: jg.Contacts) -> jax.Array:
    value = f(replace(c, positions=p))
    return jnp.where(jnp.isfinite(value), value, 0).sum()


def slope(f: Callable, c: jg.Contacts) -> jax.Array:
    return jax.grad(lambda p: total(f, p, c))(c.positions)


def along(f: Callable, c: jg.Contacts) -> jax.Array:
    return jax.jvp(lambda p: f(replace(c, positions=p)), (c.positions,), (jnp.ones_like(c.positions),))[1]


def _custom_vjp(f: Callable, c: jg.Contacts) -> jax.Array:
    own = jax.custom_vjp(lambda p: total(f, p, c))
    own.defvjp(lambda p: jax.vjp(lambda p: total(f, p, c), p), lambda back, ct: back(ct))
    return jax.grad(own)(c.positions)


def _custom_jvp(f: Callable, c: jg.Contacts) -> jax.Array:
    own = jax.custom_jvp(lambda p: total(f, p, c))
    own.defjvp(lambda p, dp: jax.jvp(lambda p: total(f, p, c), p, dp))
    return jax.grad(own)(c.positions)


def _cond(f: Callable, c: jg.Contacts) -> jax.Array:
    nothing = jax.eval_shape(f, c)
    branch = lambda c: lax_cond(c, lambda c: f(c), lambda c: jnp.zeros(nothing.shape, nothing.dtype))  # noqa: E731
    return jax.jit(branch)(c)


def lax_cond(c: jg.Contacts, yes: Callable, no: Callable) -> jax.Array:
    return jax.lax.cond(c.positions.shape[0] + jnp.sum(c.active) >= 0, yes, no, c)


def _while(f: Callable, c: jg.Contacts) -> jax.Array:
    start = jnp.zeros_like(f(c))
    return jax.lax.while_loop(lambda s: s[0] < 2, lambda s: (s[0] + 1, f(c) + 0 * s[1]), (0, start))[1]


def _divided(explicit: bool) -> Callable:
    def way(f: Callable, c: jg.Contacts) -> jax.Array:
        kind = jax.sharding.AxisType.Explicit if explicit else jax.sharding.AxisType.Auto
        mesh = jax.make_mesh((2,), ("g",), axis_types=(kind,), devices=jax.devices()[:2])
        return jax.jit(f)(jax.device_put(c, NamedSharding(mesh, P("g"))))

    return way


def _shard_map(f: Callable, c: jg.Contacts) -> jax.Array:
    mesh = Mesh(np.array(jax.devices()[:2]), ("g",))
    return jax.jit(jax.shard_map(f, mesh=mesh, in_specs=P("g"), out_specs=P("g")))(c)


def _set_mesh(f: Callable, c: jg.Contacts) -> jax.Array:
    with jax.set_mesh(jax.make_mesh((2,), ("g",), devices=jax.devices()[:2])):
        return f(c)


def _pmap(f: Callable, c: jg.Contacts) -> jax.Array:
    halves = jax.tree.map(lambda x: x.reshape(2, x.shape[0] // 2, *x.shape[1:]), c)
    out = jax.pmap(f)(halves)
    return out.reshape(-1, *out.shape[2:])


def _pmap_shared(f: Callable, c: jg.Contacts) -> jax.Array:
    each = jax.pmap(lambda p, c: f(replace(c, positions=p)), in_axes=(0, None))
    return each(jnp.stack([c.positions] * 2), c)[1]


def _custom_vmap(f: Callable, c: jg.Contacts) -> jax.Array:
    one = jax.custom_batching.custom_vmap(f)
    one.def_vmap(lambda size, batched, c: (jax.vmap(f)(c), True))
    return jax.vmap(one)(c)


def _callback(f: Callable, c: jg.Contacts) -> jax.Array:
    def beside(c: jg.Contacts) -> jax.Array:
        value = f(c)
        return value + jax.pure_callback(np.zeros_like, jax.ShapeDtypeStruct(value.shape, value.dtype), value)

    return jax.jit(beside)(c)


# What each gives the plain call does, too,
PLAIN: dict[str, Callable] = {
    "jit": lambda f, c: jax.jit(f)(c),
    "compiled ahead": lambda f, c: jax.jit(f).lower(c).compile()(c),
    "donated": lambda f, c: jax.jit(f, donate_argnums=0)(jax.tree.map(jnp.copy, c)),
    "closed over": lambda f, c: jax.jit(lambda x: f(c) + 0 * x)(0.0),
    "vmap": lambda f, c: jax.vmap(f)(c),
    "custom_vmap": _custom_vmap,
    "lax.map": lambda f, c: jax.lax.map(f, jax.tree.map(lambda x: x[None], c))[0],
    "lax.map in batches": lambda f, c: jax.lax.map(f, c, batch_size=2),
    "scan": lambda f, c: jax.lax.scan(lambda s, c: (s, f(c)), 0, jax.tree.map(lambda x: x[None], c))[1][0],
    "after associative_scan": lambda f, c: jax.jit(lambda c: f(jax.lax.associative_scan(lambda a, b: b, c)))(c),
    "while_loop": _while,
    "cond": _cond,
    "beside a callback": _callback,
    "divided": _divided(False),
    "divided, explicit": _divided(True),
    "shard_map": _shard_map,
    "vmap in shard_map": lambda f, c: _shard_map(jax.vmap(f), c),
    "shard_map in vmap": lambda f, c: jax.vmap(lambda c: _shard_map(f, c))(jax.tree.map(lambda x: x[None], c))[0],
    "set_mesh": _set_mesh,
    "pmap": _pmap,
    "pmap, shared": _pmap_shared,
}
# what `along` does,
FORWARD: dict[str, Callable] = {
    "jvp": along,
    "jit jvp": lambda f, c: jax.jit(lambda c: along(f, c))(c),
    "linearize": lambda f, c: jax.linearize(lambda p: f(replace(c, positions=p)), c.positions)[1](
        jnp.ones_like(c.positions)
    ),
}
# and what `slope` does.
REVERSE: dict[str, Callable] = {
    "grad": slope,
    "jit grad": lambda f, c: jax.jit(lambda c: slope(f, c))(c),
    "vmap grad": lambda f, c: jax.vmap(lambda c: slope(f, c))(c),
    "vjp with more": lambda f, c: jax.vjp(lambda p: (total(f, p, c), p), c.positions, has_aux=True)[1](1.0)[0],
    "checkpoint": lambda f, c: slope(jax.checkpoint(f), c),
    "checkpoint, all saved": lambda f, c: slope(
        jax.checkpoint(f, policy=jax.checkpoint_policies.everything_saveable), c
    ),
    "custom_vjp": _custom_vjp,
    "custom_jvp": _custom_jvp,
    "slope, divided": lambda f, c: _divided(False)(lambda c: slope(f, c), c),
    "slope, shard_map": lambda f, c: _shard_map(lambda c: slope(f, c), c),
}
WAYS = PLAIN | FORWARD | REVERSE
SLOPED = dict.fromkeys(FORWARD, along) | dict.fromkeys(REVERSE, slope)
EVEN = {
    *("divided", "divided, explicit", "shard_map", "vmap in shard_map", "shard_map in vmap", "pmap"),
    *("slope, divided", "slope, shard_map"),
}


def cell(function: str, way: str, size: int, vertices: int = 6, contacts: int = 4) -> str:
    """What comes of one cell: "ok", or the difference."""
    if way in EVEN:
        size += size % 2
    c, d = grasps(size, contacts), pushes(vertices)
    f = lambda c: FUNCTIONS[function](c, d)  # noqa: E731
    plain, tolerance = SLOPED.get(way, lambda f, c: f(c)), SLOPES if way in SLOPED else VALUES
    wanted, found = np.asarray(plain(f, c)), np.asarray(WAYS[way](f, c))
    if wanted.shape != found.shape:
        return f"shape {found.shape} for {wanted.shape}"
    both = np.isfinite(wanted) & np.isfinite(found)
    if not np.array_equal(wanted[~both], found[~both], equal_nan=True):
        return "other lanes have an answer"
    scale = np.maximum(1, np.abs(wanted[both]).max(initial=0))
    worst = np.abs(wanted[both] - found[both]).max(initial=0) / scale
    return "ok" if worst <= tolerance else f"off by {worst:.1e}"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--functions", default=",".join(FUNCTIONS))
    parser.add_argument("--ways", default=";".join(WAYS), help="separated by semicolons")
    parser.add_argument("--sizes", default="0,3,4096")
    parser.add_argument("--vertices", type=int, default=6)
    parser.add_argument("--contacts", type=int, default=4)
    parser.add_argument("--kernels", choices=("auto", "xla", "both"), default="both")
    parser.add_argument("--output", type=Path)
    parser.add_argument("--one", action="store_true", help="this cell, in this process")
    given = parser.parse_args()
    functions, ways = given.functions.split(","), given.ways.split(";")
    sizes = [int(size) for size in given.sizes.split(",")]
    if given.one:
        jax.config.update("jax_enable_x64", True)
        jax.config.update("jax_num_cpu_devices", 2)
        print(cell(functions[0], ways[0], sizes[0], given.vertices, given.contacts))
        return
    kernels = ("auto", "xla") if given.kernels == "both" else (given.kernels,)
    rows = [(f, w, s, k) for k in kernels for f in functions for s in sizes for w in ways]
    lines = ["| function | way | grasps | kernels | result |", "|---|---|---|---|---|"]
    bad = 0
    for function, way, size, kernel in rows:
        result = _in_process(function, way, size, kernel, given)
        bad += result != "ok"
        lines.append(f"| {function} | {way} | {size:,} | {kernel} | {result} |")
        print(lines[-1], flush=True)
        if given.output:
            given.output.write_text("\n".join([*lines, "", f"{len(lines) - 2} cells, {bad} not ok.", ""]))
    print(f"{len(rows)} cells, {bad} not ok")


def _in_process(function: str, way: str, size: int, kernel: str, given: argparse.Namespace) -> str:
    command = [sys.executable, "-W", "ignore", "-m", "benchmarks.ways", "--one", "--functions", function]
    command += ["--ways", way, "--sizes", str(size), "--vertices", str(given.vertices)]
    command += ["--contacts", str(given.contacts)]
    try:
        run = subprocess.run(
            command,
            env={**os.environ, "JAXGRASP_KERNELS": kernel},
            capture_output=True,
            text=True,
            timeout=SECONDS,
            check=False,
        )
    except subprocess.TimeoutExpired:
        return f"more than {SECONDS} s"
    if run.returncode == 0:
        return run.stdout.strip()
    last = (run.stderr.strip().splitlines() or [""])[-1]
    return f"exit {run.returncode}: {last[:100]}"


if __name__ == "__main__":
    main()
