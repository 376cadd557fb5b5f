"""Every function of the package in every transformation of JAX, at several sizes, each cell in a process of its own.

    python -m benchmarks.ways [--functions margin,effort] [--ways "jit;scan"] [--sizes 0,3,4096] [--kernels both]

A cell runs one function in one way and holds the result against the plain batch: 1e-9 for values, 1e-6 for what goes
through derivatives. It prints "ok", or what went wrong: a difference, an error, an abort of the process, or too much
time. With `--together` the ways of one function share a process until one of them ends it, which is several times
faster. `benchmarks/ways.md` is what it wrote.
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
import tempfile
import threading
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from jax import export
from jax.experimental import checkify, io_callback
from jax.sharding import Mesh, NamedSharding
from jax.sharding import PartitionSpec as P

import jaxgrasp as jg
from benchmarks.suite.face import FUNCTIONS, grasps, pushes

VALUES, SLOPES = 1e-9, 1e-6
SECONDS = 300


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


def _custom_vjp_nondiff(f: Callable, c: jg.Contacts) -> jax.Array:
    own = jax.custom_vjp(lambda f, p: total(f, p, c), nondiff_argnums=(0,))
    own.defvjp(lambda f, p: (total(f, p, c), p), lambda f, p, ct: (ct * jax.grad(lambda p: total(f, p, c))(p),))
    return jax.grad(lambda p: own(f, p))(c.positions)


def _transposed(f: Callable, c: jg.Contacts) -> jax.Array:
    value, line = jax.linearize(lambda p: total(f, p, c), c.positions)
    return jax.linear_transpose(line, c.positions)(jnp.ones_like(value))[0]


def _ahead(c: jg.Contacts) -> jg.Contacts:
    return jax.tree.map(lambda x: x[None], c)


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


def _io_callback(f: Callable, c: jg.Contacts) -> jax.Array:
    def beside(c: jg.Contacts) -> jax.Array:
        value = f(c)
        io_callback(lambda x: None, None, value, ordered=True)
        return value

    return jax.jit(beside)(c)


def _checked(f: Callable, c: jg.Contacts) -> jax.Array:
    def checking(c: jg.Contacts) -> jax.Array:
        checkify.check(jnp.all(c.friction > 0), "no friction")
        return f(c)

    error, value = jax.jit(checkify.checkify(checking))(c)
    error.throw()
    return value


def _exported(f: Callable, c: jg.Contacts) -> jax.Array:
    like = jax.tree.map(lambda x: jax.ShapeDtypeStruct(x.shape, x.dtype), c)
    leaves, structure = jax.tree.flatten(like)
    with jg.without_kernels():
        program = export.export(jax.jit(lambda *x: f(jax.tree.unflatten(structure, x))))(*leaves)
    return program.call(*jax.tree.leaves(c))


def _threads(f: Callable, c: jg.Contacts) -> jax.Array:
    with ThreadPoolExecutor(2) as pool:
        first, second = pool.map(lambda _: jax.block_until_ready(jax.jit(lambda c: f(c))(c)), range(2))
    assert np.array_equal(first, second, equal_nan=True)
    return first


def _nested(f: Callable, c: jg.Contacts) -> jax.Array:
    mapped = lambda c: _shard_map(jax.vmap(f), c)  # noqa: E731
    return jax.lax.scan(lambda s, c: (s, mapped(c)), 0, jax.tree.map(lambda x: x[None], c))[1][0]


def _leaks(f: Callable, c: jg.Contacts) -> jax.Array:
    with jax.checking_leaks():
        return jax.jit(f)(c)


def _no_jit(f: Callable, c: jg.Contacts) -> jax.Array:
    with jax.disable_jit():
        return f(c)


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
    "switch": lambda f, c: jax.lax.switch(jnp.sum(c.active) % 2, [f, f], c),
    "vmap of another axis": lambda f, c: jax.vmap(f, in_axes=1)(jax.tree.map(lambda x: jnp.moveaxis(x, 0, 1), c)),
    "beside a callback": _callback,
    "beside an ordered callback": _io_callback,
    "checkify": _checked,
    "exported": _exported,
    "two threads": _threads,
    "checking leaks": _leaks,
    "disable_jit": _no_jit,
    "divided": _divided(False),
    "divided, explicit": _divided(True),
    "shard_map": _shard_map,
    "vmap in shard_map": lambda f, c: _shard_map(jax.vmap(f), c),
    "vmap in shard_map in scan": _nested,
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
    "jvp of vmap": lambda f, c: along(jax.vmap(f), c),
    "jvp in fori_loop": lambda f, c: jax.lax.fori_loop(0, 1, lambda _, x: along(f, c) + 0 * x, along(f, c)),
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
    "checkpoint, dots saved": lambda f, c: slope(jax.checkpoint(f, policy=jax.checkpoint_policies.dots_saveable), c),
    "grad in scan": lambda f, c: jax.lax.scan(lambda s, c: (s, slope(f, c)), 0, jax.tree.map(lambda x: x[None], c))[1][
        0
    ],
    "grad of scan": lambda f, c: slope(lambda c: jax.lax.scan(lambda s, c: (s, f(c)), 0, _ahead(c))[1], c),
    "grad of lax.map": lambda f, c: slope(lambda c: jax.lax.map(f, c, batch_size=2), c),
    "vmap of vmap grad": lambda f, c: jax.vmap(jax.vmap(lambda c: slope(f, c)))(_ahead(c))[0],
    "transpose of linearize": lambda f, c: _transposed(f, c),
    "custom_vjp": _custom_vjp,
    "custom_vjp, nondiff": _custom_vjp_nondiff,
    "custom_jvp": _custom_jvp,
    "slope, divided": lambda f, c: _divided(False)(lambda c: slope(f, c), c),
    "slope, shard_map": lambda f, c: _shard_map(lambda c: slope(f, c), c),
}
WAYS = PLAIN | FORWARD | REVERSE
SLOPED = dict.fromkeys(FORWARD, along) | dict.fromkeys(REVERSE, slope)
EVEN = {
    *(
        "divided",
        "divided, explicit",
        "shard_map",
        "vmap in shard_map",
        "vmap in shard_map in scan",
        "shard_map in vmap",
    ),
    *("pmap", "slope, divided", "slope, shard_map"),
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
    parser.add_argument("--one", action="store_true", help="these ways of one function, in this process")
    parser.add_argument("--together", action="store_true", help="the ways of a function share a process")
    given = parser.parse_args()
    functions, ways = given.functions.split(","), given.ways.split(";")
    sizes = [int(size) for size in given.sizes.split(",")]
    if given.one:
        jax.config.update("jax_enable_x64", True)
        jax.config.update("jax_num_cpu_devices", 2)
        for way in ways:
            print(_tried(functions[0], way, sizes[0], given), flush=True)
        return
    kernels = ("auto", "xla") if given.kernels == "both" else (given.kernels,)
    lines = ["| function | way | grasps | kernels | result |", "|---|---|---|---|---|"]
    bad = 0
    for kernel, function, size in ((k, f, s) for k in kernels for f in functions for s in sizes):
        for way, result in _in_processes(function, ways, size, kernel, given):
            bad += result != "ok"
            lines.append(f"| {function} | {way} | {size:,} | {kernel} | {result} |")
            print(lines[-1], flush=True)
            if given.output:
                given.output.write_text("\n".join([*lines, "", f"{len(lines) - 2} cells, {bad} not ok.", ""]))
    print(f"{len(lines) - 2} cells, {bad} not ok")


def _tried(function: str, way: str, size: int, given: argparse.Namespace) -> str:
    try:
        return cell(function, way, size, given.vertices, given.contacts)
    except Exception as error:
        return f"{type(error).__name__}: {(str(error).strip().splitlines() or [''])[0][:150]}"


def _in_processes(
    function: str, ways: list[str], size: int, kernel: str, given: argparse.Namespace
) -> Iterator[tuple[str, str]]:
    """Ways with what came of each; a process runs one, or all until one of them ends it."""
    left = list(ways)
    while left:
        tried = left if given.together else left[:1]
        for way, result in zip(list(tried), _in_process(function, tried, size, kernel, given), strict=False):
            left.remove(way)
            yield way, result


def _in_process(function: str, ways: list[str], size: int, kernel: str, given: argparse.Namespace) -> Iterator[str]:
    command = [sys.executable, "-W", "ignore", "-m", "benchmarks.ways", "--one", "--functions", function]
    command += ["--ways", ";".join(ways), "--sizes", str(size), "--vertices", str(given.vertices)]
    command += ["--contacts", str(given.contacts)]
    environment = {**os.environ, "JAXGRASP_KERNELS": kernel}
    with tempfile.TemporaryFile("w+") as told:
        child = subprocess.Popen(command, env=environment, stdout=subprocess.PIPE, stderr=told, text=True)
        assert child.stdout is not None
        late = threading.Event()

        def stop() -> None:
            late.set()
            child.kill()

        for _ in ways:
            timer = threading.Timer(SECONDS, stop)
            timer.start()
            line = child.stdout.readline()
            timer.cancel()
            if not line:
                child.wait()
                told.seek(0)
                last = (told.read().strip().splitlines() or [""])[-1]
                yield f"more than {SECONDS} s" if late.is_set() else f"exit {child.returncode}: {last[:100]}"
                return
            yield line.strip()
        child.wait()


if __name__ == "__main__":
    main()
