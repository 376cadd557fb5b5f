"""Answers for whole groups of problems, ours and HiGHS', each computed once a process."""

from __future__ import annotations

from dataclasses import fields
from functools import cache, lru_cache

import jax
import jax.numpy as jnp
import numpy as np
import oracles
import problems

import jaxgrasp as jg


def contacts_of(batch: problems.Batch, dtype=jnp.float64) -> jg.Contacts:
    return jg.Contacts.from_frames(
        jnp.asarray(batch.positions, dtype),
        jnp.asarray(batch.frames, dtype),
        friction=jnp.asarray(batch.friction, dtype),
        max_force=jnp.asarray(batch.max_force, dtype),
        active=jnp.asarray(batch.active),
    )


def data_of(batch: problems.Batch, dtype=jnp.float64) -> tuple:
    """Contacts, disturbances, required wrenches and cone margins, as `largest` and `least` take them."""
    vertices, load, reserve = (
        jnp.asarray(getattr(batch, name), dtype) for name in ("vertices", "required_wrench", "cone_margin")
    )
    return contacts_of(batch, dtype), jg.DisturbanceSet.vertices(vertices), load, reserve


def largest(contacts, disturbances, required_wrench, cone_margin, cone_edges=8):
    return jg.largest_disturbance(
        contacts, disturbances, required_wrench=required_wrench, cone_edges=cone_edges, cone_margin=cone_margin
    )


def least(contacts, disturbances, required_wrench, cone_margin, margin, cone_edges=8):
    return jg.least_effort(
        contacts, disturbances, margin, required_wrench=required_wrench, cone_edges=cone_edges, cone_margin=cone_margin
    )


def as_numpy(tree):
    return jax.tree.map(np.asarray, tree)


@cache
def margins(name: str, precision: str = "float64"):
    """Our answers to (21) for a group."""
    group = problems.group(name)
    return as_numpy(largest(*data_of(group.batch, jnp.dtype(precision)), cone_edges=group.cone_edges))


@lru_cache(maxsize=1)
def grasps(name: str) -> list[oracles.Grasp]:
    """A group as the oracles want it; only the latest is kept, as what they derive from it is large."""
    group = problems.group(name)
    return [group.batch.grasp(lane, group.cone_edges) for lane in range(len(group.batch))]


@cache
def highs(name: str) -> dict[str, np.ndarray]:
    """HiGHS' answers to (21) for a group: the fields of `oracles.Answer`, each (lanes,)."""
    answers = oracles.largest_disturbances(grasps(name))
    return {f.name: np.array([getattr(a, f.name) for a in answers]) for f in fields(oracles.Answer)}


def tell(group: problems.Group, lanes: np.ndarray, **columns: np.ndarray) -> str:
    """A message that names the lanes: their family, their number, and what is asked for."""
    chosen = np.flatnonzero(lanes)
    rows = [f"{len(chosen)} of {len(group.batch)} lanes"]
    for lane in chosen[:12]:
        values = ", ".join(f"{key} {np.asarray(value)[lane]}" for key, value in columns.items())
        rows.append(f"  {group.family[lane]!r} lane {lane}: {values}")
    return "\n".join(rows)
