"""Random grasps, loads and sets of disturbances, from which families are made."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from benchmarks.suite.lanes import Lanes

Generator = np.random.Generator
DIRECTIONS = 12
"""Vertices of a set that a lane has of its own."""


def log_uniform(rng: Generator, low: float, high: float, shape) -> np.ndarray:
    return np.exp(rng.uniform(np.log(low), np.log(high), shape))


def units(rng: Generator, *shape: int) -> np.ndarray:
    v = rng.normal(size=(*shape, 3))
    return v / np.linalg.norm(v, axis=-1, keepdims=True)


def frames_of(rng: Generator, normals: np.ndarray) -> np.ndarray:
    """Contact frames with tangents turned at random."""
    first = np.cross(units(rng, *normals.shape[:-1]), normals)
    first /= np.linalg.norm(first, axis=-1, keepdims=True)
    return np.stack([first, np.cross(normals, first), normals], axis=-1)


def ellipsoid(rng: Generator, u: np.ndarray, size=(0.01, 0.2)) -> tuple[np.ndarray, np.ndarray]:
    """Points and outward normals where unit vectors (lanes, n_c, 3) meet random ellipsoids."""
    axes = rng.uniform(0.4, 1.0, (len(u), 1, 3))
    normals = u / axes
    normals /= np.linalg.norm(normals, axis=-1, keepdims=True)
    return log_uniform(rng, *size, (len(u), 1, 1)) * u * axes, normals


def grasps(rng: Generator, positions: np.ndarray, normals: np.ndarray, edges=8, **given) -> Lanes:
    """Plain friction, strength and the six forces, where nothing else is given."""
    lanes, n_c = positions.shape[:2]
    plain = {
        "cone_edges": edges,
        "positions": positions,
        "frames": frames_of(rng, normals),
        "friction": rng.uniform(0.3, 1.0, (lanes, 1)) * np.ones(n_c),
        "max_force": log_uniform(rng, 1.0, 20.0, (lanes, 1)) * np.ones(n_c),
        "active": np.ones((lanes, n_c), bool),
        "wrench": np.zeros((lanes, 6)),
        "reserve": np.zeros(lanes),
    }
    return Lanes(**plain | given)


def size_of(lanes: Lanes) -> np.ndarray:
    """(lanes, 1): root-mean-square distance of the contacts that are there, 1 where that is zero."""
    squares = np.sum(lanes.positions**2, axis=-1) * lanes.active
    mean = squares.sum(-1) / np.maximum(lanes.active.sum(-1), 1)
    return np.sqrt(np.where(mean > 0, mean, 1.0))[:, None]


def wrench_of(lanes: Lanes, forces: np.ndarray) -> np.ndarray:
    """(lanes, ..., 6): G f of forces (lanes, ..., n_c, 3) in contact frames."""
    turned = np.einsum("lcij,l...cj->l...ci", lanes.frames, forces)
    arms = np.expand_dims(lanes.positions, tuple(range(1, forces.ndim - 2)))
    return np.concatenate([turned.sum(-2), np.cross(arms, turned).sum(-2)], axis=-1)


def with_vertices(rng: Generator, lanes: Lanes, kinds=(0, 1, 2, 3, 4)) -> Lanes:
    """Each lane with one kind of set: 0 forces, 1 forces and moments, 2 wrenches, 3 moments, 4 what contacts reach."""
    count, size = len(lanes), size_of(lanes)[:, None]
    scale = np.concatenate([np.ones((count, 1, 3)), np.broadcast_to(size, (count, 1, 3))], axis=-1)
    axes = np.vstack([np.eye(6), -np.eye(6)])
    kind = rng.choice(kinds, count)
    parts = np.array([[1, 0], [1, 1], [0, 0], [0, 1], [0, 0]])[kind]
    vertices = axes * scale * np.repeat(parts, 3, axis=-1)[:, None]
    some = np.flatnonzero(kind == 2)
    wrenches = [units(rng, len(some), DIRECTIONS) for _ in range(2)]
    vertices[some] = np.concatenate(wrenches, axis=-1) * scale[some]
    some = np.flatnonzero(kind == 4)
    reached = wrench_of(lanes[some], rng.normal(size=(len(some), DIRECTIONS, *lanes.active.shape[1:], 3)))
    vertices[some] = reached / np.maximum(np.abs(reached / scale[some]).max((1, 2), keepdims=True), 1e-300)
    return replace(lanes, vertices=vertices)


def loaded(rng: Generator, lanes: Lanes, borne: np.ndarray) -> Lanes:
    """A required wrench: of forces well inside the rows where it is borne, else any, up to four times their sum."""
    shape = lanes.active.shape
    normal = -lanes.max_force * rng.uniform(0, 1, shape) * log_uniform(rng, 1e-3, 0.9, (len(lanes), 1))
    angle, share = rng.uniform(0, 2 * np.pi, shape), rng.uniform(0, 0.7, shape)
    tangential = share * lanes.friction * -normal
    forces = np.stack([tangential * np.cos(angle), tangential * np.sin(angle), normal], axis=-1)
    within = wrench_of(lanes, forces * lanes.active[..., None])
    any_wrench = np.concatenate([units(rng, len(lanes)), size_of(lanes) * units(rng, len(lanes))], axis=-1)
    beyond = any_wrench * lanes.max_force.sum(-1, keepdims=True) * log_uniform(rng, 1e-2, 4.0, (len(lanes), 1))
    return replace(lanes, wrench=np.where(borne[:, None], within, beyond))
