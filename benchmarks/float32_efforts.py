"""Least efforts (22) in float32: how many are decided, and whether what is called solved is so.

    python -m benchmarks.float32_efforts [--grasps 200000]

Plain grasps: 3 to 8 contacts on random ellipsoids of 1 to 20 cm, friction 0.3 to 1, one largest force for all fingers,
margins that are a random share of (21)'s, half of the grasps with a load. What is called solved is checked in float64:
G f = b and every row at the margin by NumPy, the effort and the largest margin against the float64 programs. Writes
float32_efforts.md beside this file.
"""

from __future__ import annotations

import argparse
from dataclasses import dataclass
from pathlib import Path

import jax
import numpy as np

import jaxgrasp as jg
from benchmarks.suite.clock import say
from benchmarks.suite.problems import facets

COUNTS = (3, 4, 5, 6, 7, 8)
# Of the larger of |b| and sum |f_i|, of a contact's largest force, and of the mean largest force.
BALANCE, ROWS, MARGIN = 3e-5, 3e-5, 1e-4
# Of the effort, or of a thousandth of the largest force squared; twice the gap that counts as closed.
EFFORT = 2e-4


@dataclass(frozen=True)
class Plain:
    """Grasps of one number of contacts; numbers that float32 holds, in float64."""

    positions: np.ndarray
    frames: np.ndarray
    friction: np.ndarray
    max_force: np.ndarray
    load: np.ndarray
    share: np.ndarray
    """Of (21)'s margin."""

    def contacts(self, dtype: str) -> jg.Contacts:
        rows = [x.astype(dtype) for x in (self.positions, self.frames, self.friction, self.max_force)]
        return jg.Contacts.from_frames(*rows[:2], friction=rows[2], max_force=rows[3])


def unit(rng: np.random.Generator, *shape: int) -> np.ndarray:
    v = rng.normal(size=(*shape, 3))
    return v / np.linalg.norm(v, axis=-1, keepdims=True)


def plain(count: int, n_c: int, loaded: bool, seed: int) -> Plain:
    rng = np.random.default_rng([seed, n_c, loaded])
    axes, on_sphere = rng.uniform(0.4, 1, (count, 1, 3)), unit(rng, count, n_c)
    normals = on_sphere / axes
    normals /= np.linalg.norm(normals, axis=-1, keepdims=True)
    first = np.cross(unit(rng, count, n_c), normals)
    first /= np.linalg.norm(first, axis=-1, keepdims=True)
    size = np.exp(rng.uniform(np.log(0.01), np.log(0.2), (count, 1)))
    force = np.exp(rng.uniform(np.log(0.5), np.log(50), (count, 1)))
    spread = lambda x: np.broadcast_to(x, (count, n_c))  # noqa: E731
    push, turn = (unit(rng, count) * force * rng.uniform(0, top, (count, 1)) for top in (0.5, 0.1))
    made = Plain(
        positions=on_sphere * axes * size[..., None] / 2,
        frames=np.stack([first, np.cross(normals, first), normals], -1),
        friction=spread(rng.uniform(0.3, 1, (count, 1))),
        max_force=spread(force),
        load=np.concatenate([push, turn * size], -1) * loaded,
        share=rng.uniform(0.05, 0.98, count),
    )
    return Plain(**{name: x.astype(np.float32).astype(np.float64) for name, x in vars(made).items()})


def solved(grasps: Plain, dtype: str, margin: np.ndarray | None = None) -> tuple[jg.Solution, jg.Solution]:
    """(21), and (22) at a margin, at its share of (21)'s where none is given."""
    contacts, forces, load = grasps.contacts(dtype), jg.DisturbanceSet.forces(1.0), grasps.load.astype(dtype)
    largest = jg.largest_disturbance(contacts, forces, required_wrench=load)
    if margin is None:
        margin = np.maximum(np.nan_to_num(np.asarray(largest.margin)), 0) * grasps.share
    least = jg.least_effort(contacts, forces, margin.astype(dtype), required_wrench=load)
    largest, least = (jax.tree.map(lambda x: np.asarray(x, np.float64), s) for s in (largest, least))
    return largest, least


def wrong(grasps: Plain, least: jg.Solution, exact: tuple[jg.Solution, jg.Solution]) -> np.ndarray:
    """(grasps,) bool, of forces that are called the least."""
    force, limit = least.forces, grasps.max_force
    pushes = np.einsum("gcij,gcj->gci", grasps.frames, force)
    size = np.sqrt((grasps.positions**2).sum((1, 2)) / force.shape[1])[:, None]
    wrench = np.concatenate([pushes.sum(1), np.cross(grasps.positions, pushes).sum(1) / size], -1)
    load = grasps.load / np.concatenate([np.ones((len(size), 3)), np.repeat(size, 3, 1)], -1)
    applied = np.maximum(np.linalg.norm(load, axis=-1), np.linalg.norm(force, axis=-1).sum(-1))
    bad = np.linalg.norm(wrench - load, axis=-1) > BALANCE * applied
    S_1, S_2 = jg.worst_case(grasps.contacts("float64"), jg.DisturbanceSet.forces(1.0))
    c, s, k = facets().T
    along = force[..., :1] * c + force[..., 1:2] * s + grasps.friction[..., None] * k * force[..., 2:]
    cone = along - np.asarray(S_1) * least.margin[:, None, None]
    bound = np.asarray(S_2) * least.margin[:, None] - force[..., 2] - limit
    bad |= (np.maximum(cone.max(-1), bound) > ROWS * limit).any(-1)
    largest, least_64 = exact
    known = largest.status == jg.Status.SOLVED
    bad |= known & (np.abs(least.upper_bound - largest.margin) > MARGIN * limit.mean(-1))
    unit = np.maximum(least_64.effort, 1e-3 * limit.mean(-1) ** 2)
    return bad | (least_64.status == jg.Status.SOLVED) & (np.abs(least.effort - least_64.effort) > EFFORT * unit)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--grasps", type=int, default=200_000)
    each = parser.parse_args().grasps // (2 * len(COUNTS))
    jax.config.update("jax_enable_x64", True)
    rows, counts = [], []
    for loaded in (False, True):
        for n_c in COUNTS:
            grasps = plain(each, n_c, loaded, 0)
            largest, least = solved(grasps, "float32")
            margin = (np.maximum(np.nan_to_num(largest.margin), 0) * grasps.share).astype(np.float32)
            names = ("MAX_ITERATIONS", "ILL_CONDITIONED", "INFEASIBLE", "NOT_VERIFIED", "SOLVED")
            stuck, ill, never, doubted, answered = (least.status == jg.Status[name] for name in names)
            bad = answered & wrong(grasps, least, solved(grasps, "float64", margin))
            counts.append([x.sum() for x in (stuck | ill | doubted, ill, never, bad)])
            rows.append(f"| {n_c} | {'yes' if loaded else 'no'} | {each:,} | {' | '.join(map(str, counts[-1]))} |")
            say(rows[-1])
    total, grasps = np.sum(counts, 0), each * len(counts)
    rows.append(f"| all | | {grasps:,} | {total[0]} ({total[0] / grasps:.2%}) | {' | '.join(map(str, total[1:]))} |")
    text = f"""# Least efforts in float32

`python -m benchmarks.float32_efforts --grasps {grasps}`: plain grasps on random ellipsoids, margins that are a share of
the largest, with and without a load. What is called solved is checked in float64.

| contacts | load | grasps | undecided | of these ill-conditioned | infeasible | solved and wrong |
| --- | --- | --- | --- | --- | --- | --- |
{chr(10).join(rows)}
"""
    Path(__file__).with_suffix(".md").write_text(text)
    say(text)


if __name__ == "__main__":
    main()
