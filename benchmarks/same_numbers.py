"""The same numbers as before: margins, efforts, formulations and gradients of 5,000 grasps, held against stored ones.

    JAXGRASP_AUDIT=off python -m benchmarks.same_numbers [--write]

For a change that should change no number. `same_numbers.json` has a digest of every result and a sample of its
entries; where a digest differs, the largest relative difference in the sample is printed. With --write the file is
made anew: on the commit before the change, on the machine that is used after it.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

import jaxgrasp as jg

STORED = Path(__file__).with_suffix(".json")
GRASPS, SAMPLE = 5_000, 24
FORMULATIONS = ("12", "12_fixed", "13", "16", "per_direction", "per_direction_prestrained")


def grasps(dtype: str) -> jg.Contacts:
    """Make random grasps of four contacts on a ball of 5 cm; some contacts are absent, friction and bounds differ."""
    rng = np.random.default_rng(23)
    normals = rng.normal(size=(GRASPS, 4, 3))
    normals /= np.linalg.norm(normals, axis=-1, keepdims=True)
    friction, force = rng.uniform(0.3, 1, (GRASPS, 4)), rng.uniform(1, 5, (GRASPS, 4))
    active = rng.random((GRASPS, 4)) < 0.95
    arrays = (0.05 * normals, normals, friction, force)
    positions, normals, friction, force = (jnp.asarray(x, dtype) for x in arrays)
    return jg.Contacts.from_normals(positions, normals, friction=friction, max_force=force, active=active)


def actuation(dtype: str) -> jg.Actuation:
    jacobian = 0.05 * np.random.default_rng(4).normal(size=(GRASPS, 4, 3, 7))
    limits = 0.6 * np.ones(5)
    given = jacobian, np.eye(7)[:, :5], -limits, limits
    return jg.Actuation.from_jacobian(*(jnp.asarray(x, dtype) for x in given))


def slope(field: Callable[[jg.Contacts], jax.Array], contacts: jg.Contacts) -> tuple[jax.Array, ...]:
    """With respect to positions, friction and the bounds on forces."""

    def total(positions: jax.Array, friction: jax.Array, max_force: jax.Array) -> jax.Array:
        values = field(replace(contacts, positions=positions, friction=friction, max_force=max_force))
        return jnp.where(jnp.isfinite(values), values, 0).sum()

    return jax.grad(total, (0, 1, 2))(contacts.positions, contacts.friction, contacts.max_force)


def programs(dtype: str) -> dict[str, Callable[[jg.Contacts], object]]:
    pushes = jg.DisturbanceSet.forces(jnp.ones((), dtype))
    load = jnp.asarray([0, 0, -0.1, 0, 0, 0], dtype)
    number = lambda value: jnp.asarray(value, dtype)  # noqa: E731
    box = jg.DisturbanceSet.box(jnp.repeat(jnp.asarray([1, 0.02], dtype), 3))
    ball = jg.DisturbanceSet.ball(number(1), number(0.02))
    margin = lambda c, d=pushes, **options: jg.largest_disturbance(c, d, load, **options)  # noqa: E731
    effort = lambda c, d=pushes, **options: jg.least_effort(c, d, number(0.1), load, **options)  # noqa: E731
    return {
        "margin": margin,
        "margin, 8 edges": lambda c: margin(c, cone_edges=8, cone_margin=number(0.01)),
        "margin, box": lambda c: margin(c, box),
        "margin, ball": lambda c: margin(c, ball),
        "margin, smoothed": lambda c: margin(c, smoothing=number(1e-3)),
        "margin, cut off": lambda c: margin(c, cutoff=number(0.5)),
        "margin, actuators": lambda c: margin(c, actuation=actuation(dtype)),
        "effort": effort,
        "effort, ball": lambda c: effort(c, ball),
        "effort, smoothed": lambda c: effort(c, smoothing=number(1e-3)),
        "worst case": lambda c: jg.worst_case(c, pushes),
        "blocking forces": lambda c: jg.blocking_forces(c, pushes.terms[0].wrenches),
        "gradient of margins": lambda c: slope(lambda c: margin(c).margin, c),
        "gradient of efforts": lambda c: slope(lambda c: effort(c).effort, c),
        "gradient of forces": lambda c: slope(lambda c: (margin(c).forces ** 2).sum((-1, -2)), c),
        "gradient, ball": lambda c: slope(lambda c: margin(c, ball).margin, c),
        "gradient, actuators": lambda c: slope(lambda c: margin(c, actuation=actuation(dtype)).margin, c),
        "total effort": lambda c: jg.least_total_effort(c, pushes, number(0.05), load),
        "gradient of total effort": lambda c: slope(
            lambda c: jg.least_total_effort(c, pushes, number(0.05), load).effort, c
        ),
        **{f"({name})": lambda c, name=name: jg.formulation_margin(c, pushes, name, load) for name in FORMULATIONS},
    }


def results() -> dict[str, np.ndarray]:
    found = {}
    for dtype in ("float64", "float32"):
        contacts = grasps(dtype)
        for name, program in programs(dtype).items():
            for path, leaf in jax.tree_util.tree_flatten_with_path(program(contacts))[0]:
                found[f"{dtype}: {name}{jax.tree_util.keystr(path)}"] = np.asarray(leaf)
            print(dtype, name, file=sys.stderr, flush=True)
    return found


def record(values: np.ndarray) -> dict:
    flat = np.where(np.isnan(values), np.nan, values).ravel() if values.dtype.kind == "f" else values.ravel()
    chosen = flat[np.linspace(0, flat.size - 1, min(SAMPLE, flat.size)).astype(int)].astype(float)
    return {"digest": hashlib.sha256(flat.tobytes()).hexdigest()[:24], "sample": [float(x).hex() for x in chosen]}


def difference(now: dict, before: dict) -> float:
    """The largest in the sample, as a share of the largest entry."""
    a, b = (np.array([float.fromhex(x) for x in one["sample"]]) for one in (now, before))
    known = np.isfinite(a) & np.isfinite(b)
    if not np.array_equal(a[~known], b[~known], equal_nan=True):
        return np.inf
    return np.abs(a - b)[known].max(initial=0) / np.abs(b[known]).max(initial=np.finfo(float).tiny)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--write", action="store_true")
    given = parser.parse_args()
    jax.config.update("jax_enable_x64", True)
    now = {name: record(values) for name, values in results().items()}
    if given.write:
        STORED.write_text(json.dumps(now, indent=0) + "\n")
        return
    before = json.loads(STORED.read_text())
    if now.keys() != before.keys():
        sys.exit(f"other results: {sorted(now.keys() ^ before.keys())}")
    other = [name for name in now if now[name]["digest"] != before[name]["digest"]]
    for name in other:
        print(f"{name}: other bits, in the sample by at most {difference(now[name], before[name]):.1e}")
    print(f"{len(now) - len(other)} of {len(now)} results equal to the last bit")
    sys.exit(bool(other))


if __name__ == "__main__":
    main()
