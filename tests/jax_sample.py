"""The grasps and the functions on which JAX's transformations are tried; few kernels, which other tests have, too."""

from __future__ import annotations

from dataclasses import replace

import jax.numpy as jnp
import numpy as np

import jaxgrasp as jg

PUSHES = jg.DisturbanceSet.forces(1.0)


def grasps(count: int) -> jg.Contacts:
    normals = np.random.default_rng(5).normal(size=(count, 4, 3))
    normals /= np.linalg.norm(normals, axis=-1, keepdims=True)
    return jg.Contacts.from_normals(0.05 * normals, normals, friction=0.5, max_force=1.0)


def margin(contacts: jg.Contacts) -> jnp.ndarray:
    return jg.largest_disturbance(contacts, PUSHES, cone_edges=4).margin


def at(positions: jnp.ndarray, contacts: jg.Contacts) -> jnp.ndarray:
    return margin(replace(contacts, positions=positions))


def min_weight(contacts: jg.Contacts) -> jnp.ndarray:
    return jg.metrics.min_weight(contacts, jg.metrics.WrenchSpace(cone_edges=4))
