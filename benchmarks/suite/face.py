"""Functions of the package that make arrays of grasps, and grasps for them."""

from collections.abc import Callable
from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np

import jaxgrasp as jg


def grasps(count: int, contacts: int = 4) -> jg.Contacts:
    normals = np.random.default_rng(5).normal(size=(count, contacts, 3))
    normals /= np.linalg.norm(normals, axis=-1, keepdims=True)
    return jg.Contacts.from_normals(0.05 * normals, normals, friction=0.5, max_force=1.0)


def pushes(vertices: int) -> jg.DisturbanceSet:
    if vertices == 6:
        return jg.DisturbanceSet.forces(1.0)
    given = np.random.default_rng(6).normal(size=(vertices, 6))
    return jg.DisturbanceSet.vertices(given * [1, 1, 1, 0.05, 0.05, 0.05])


def soft(c: jg.Contacts) -> jg.Contacts:
    return replace(c, torsional_friction=0.01 * c.friction)


def program(c: jg.Contacts) -> jax.Array:
    """The answer of a small program of each grasp."""
    rows = c.positions.reshape(*c.batch_shape, -1)
    columns = jnp.eye(rows.shape[-1], dtype=rows.dtype)
    found = jg.solvers.solve_qp(columns, 20 * rows, G=columns[:3], h=0.5 + 0 * rows[..., :3])
    return found.x


def uncertain(**more: float) -> jg.Uncertainty:
    return jg.Uncertainty.of(friction=jg.uncertainty.uniform(0.05), max_force=jg.uncertainty.uniform(0.05), **more)


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
    "bound Linf": lambda c, d: jg.metrics.ferrari_canny_bound(c, "Linf"),
    "singular": lambda c, d: jg.metrics.smallest_singular_value(c),
    "residual": lambda c, d: jg.metrics.closure_residual(c),
    "solve_qp": lambda c, d: program(c),
    "ball": lambda c, d: jg.largest_disturbance(c, jg.DisturbanceSet.ball(1.0, 0.05), cone_edges=4).margin,
    "smoothed": lambda c, d: jg.largest_disturbance(c, d, cone_edges=4, smoothing=0.01).margin,
    "soft": lambda c, d: jg.largest_disturbance(soft(c), d, cone_edges=4).margin,
    "soft effort": lambda c, d: jg.least_effort(soft(c), d, 0.1, cone_edges=4).effort,
    "total effort": lambda c, d: jg.least_total_effort(c, d, 0.1, cone_edges=4).effort,
    "compare": lambda c, d: jnp.stack([*jg.compare_formulations(c, d, cone_edges=4).margins.values()], -1),
    "distribution": lambda c, d: (
        jg.margin_distribution(c, d, uncertain(position=0.002), cone_edges=4, samples=8).mean.value
    ),
    "box_effort": lambda c, d: jg.uncertainty.box_effort(c, d, 0.1, uncertain(), cone_edges=4).effort,
    "scenario_effort": lambda c, d: (
        jg.uncertainty.scenario_effort(c, d, 0.05, uncertain(), 0.5, cone_edges=4, samples=8).effort
    ),
}
