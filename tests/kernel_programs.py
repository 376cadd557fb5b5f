"""The programs that have kernels, on small batches, by groups; what a group holds can take turns.

A program is a function of a dtype whose results have a lane for each grasp. Neighbours are of different families.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import cache, partial

import harness
import jax
import jax.numpy as jnp
import numpy as np
import problems

import jaxgrasp as jg
from jaxgrasp import kernels

LANES = 403
"""No multiple of any width, and many blocks, so that lanes wait."""

FAMILIES = ("uneven", "light load", "absent", "rough", "heavy load", "off centre", "cone margin", "around")
PLAIN = ("around", "light load", "rough", "off centre")
"""Families in which few lanes stand on a kink, for derivatives."""

ASKED = 0.05
"""Margins that efforts are asked for, as shares of the bounds on forces: some can be had, some cannot."""

Program = Callable[[jnp.dtype], object]


@cache
def batch(n_c: int, families: tuple[str, ...] = FAMILIES) -> problems.Batch:
    each = -(-LANES // len(families))
    made = [problems.make_family(70 + k, each, n_c, problems.SETTINGS[f], 12) for k, f in enumerate(families)]
    turns = np.arange(each * len(families)).reshape(len(families), each).T.ravel()
    return problems.concatenate(made)[turns[:LANES]]


@cache
def matrices(*shape: int) -> np.ndarray:
    """Random positive definite ones."""
    root = 0.5 * np.random.default_rng(3).normal(size=shape)
    return root @ np.swapaxes(root, -1, -2) + 0.5 * np.eye(shape[-1])


SETS: dict[str, Callable[[jnp.dtype], jg.DisturbanceSet]] = {
    "forces": lambda dtype: jg.DisturbanceSet.forces(jnp.ones((), dtype)),
    "box": lambda dtype: jg.DisturbanceSet.box(jnp.repeat(jnp.asarray([1, 0.02], dtype), 3)),
    "ball": lambda dtype: jg.DisturbanceSet.ball(jnp.ones((), dtype), jnp.asarray(0.02, dtype)),
    "ellipsoid": lambda dtype: jg.DisturbanceSet.ellipsoid(jnp.asarray(0.1 * matrices(6, 6), dtype)),
    "sum": lambda dtype: SETS["box"](dtype) + SETS["ball"](dtype) + SETS["forces"](dtype),
    "smoothed": lambda dtype: SETS["sum"](dtype).smoothed(jnp.asarray(0.01, dtype)),
}


def by_row(reserve: jax.Array, n_c: int, cone_edges: int) -> jax.Array:
    """A share of a grasp's cone margin in every row, nothing in the first."""
    return reserve[:, None, None] * jnp.linspace(0, 1, n_c * cone_edges, dtype=reserve.dtype).reshape(n_c, cone_edges)


def margin(dtype, n_c=3, cone_edges=4, families=FAMILIES, disturbances=None, moved=lambda c: c, rows=False, **options):
    contacts, vertices, load, reserve = harness.data_of(batch(n_c, families), dtype)
    reserve = by_row(reserve, n_c, cone_edges) if rows else reserve
    wrenches = SETS[disturbances](dtype) if disturbances else vertices
    given = {name: value(dtype) for name, value in options.items()}
    return jg.largest_disturbance(moved(contacts), wrenches, load, cone_edges=cone_edges, cone_margin=reserve, **given)


def effort(dtype, n_c=3, cone_edges=4, families=FAMILIES, disturbances=None, moved=lambda c: c, share=1.0, **options):
    contacts, vertices, load, reserve = harness.data_of(batch(n_c, families), dtype)
    wrenches = SETS[disturbances](dtype) if disturbances else vertices
    wanted = share * ASKED * contacts.max_force.mean(-1)
    given = {name: value(dtype) for name, value in options.items()}
    return jg.least_effort(moved(contacts), wrenches, wanted, load, cone_edges=cone_edges, cone_margin=reserve, **given)


def formulation(dtype, name, n_c=3, **options):
    contacts, vertices, load, _ = harness.data_of(batch(n_c), dtype)
    return jg.formulation_margin(contacts, vertices, name, load, **options)


def total_effort(dtype, n_c=3, moved=lambda c: c, families=FAMILIES, **options):
    contacts, vertices, load, _ = harness.data_of(batch(n_c, families), dtype)
    wanted = 0.3 * ASKED * contacts.max_force.mean(-1)
    options = {name: given(dtype) for name, given in options.items()}
    return jg.least_total_effort(moved(contacts), vertices, wanted, load, **options)


def worst_case(dtype, n_c=3, disturbances=None):
    contacts, vertices, _, _ = harness.data_of(batch(n_c), dtype)
    return jg.worst_case(contacts, SETS[disturbances](dtype) if disturbances else vertices)


def specified(dtype, kind):
    contacts, vertices, load, _ = harness.data_of(batch(4), dtype)
    return jg.specified_disturbances(contacts, vertices, kind, load)


def measured(dtype, metric, n_c=4, cone_edges=4, torsion=None, families=FAMILIES, moved=lambda c: c, **options):
    """One of the field's metrics; every other contact is soft where there is torsion."""
    contacts = harness.data_of(batch(n_c, families), dtype)[0]
    if torsion is not None:
        arms = torsion * contacts.friction * jnp.asarray(np.arange(n_c) % 2, dtype)
        contacts = replace(contacts, torsional_friction=arms)
    return metric(moved(contacts), space=jg.metrics.WrenchSpace(cone_edges=cone_edges), **options)


def gradient_of_metric(dtype, metric):
    """With respect to positions and friction."""
    contacts = harness.data_of(batch(4, PLAIN), dtype)[0]

    def total(positions, friction):
        values = measured(
            dtype, metric, families=PLAIN, moved=lambda c: replace(c, positions=positions, friction=friction)
        )
        return jnp.where(jnp.isfinite(values), values, 0).sum()

    return jax.jit(jax.grad(total, (0, 1)))(contacts.positions, contacts.friction)


def actuation(dtype):
    rng = np.random.default_rng(4)
    jacobian, limits = 0.05 * rng.normal(size=(LANES, 3, 3, 7)), 0.6 * np.ones(5)
    return jg.Actuation.from_jacobian(*(jnp.asarray(x, dtype) for x in (jacobian, np.eye(7)[:, :5], -limits, limits)))


def whole_hand(dtype):
    """An actuator drives two joints, dry friction acts on all: efforts for all directions."""
    rng = np.random.default_rng(4)
    jacobian = 0.05 * rng.normal(size=(LANES, 3, 3, 7))
    transmission = np.concatenate([np.eye(7)[:, :5] + np.eye(7, 5, -2), np.eye(7)], 1)
    limits = np.repeat([0.6, 0.02], [5, 7])
    return jg.Actuation.from_jacobian(*(jnp.asarray(x, dtype) for x in (jacobian, transmission, -limits, limits)))


def gradient(dtype, of: Callable, field: str, n_c=3, power=1, **options):
    """With respect to positions, friction and the bounds on forces."""
    options = {"families": PLAIN, **options}
    contacts = harness.data_of(batch(n_c, PLAIN), dtype)[0]

    def total(positions, friction, max_force):
        change = partial(replace, positions=positions, friction=friction, max_force=max_force)
        values = getattr(of(dtype, n_c, moved=lambda c: change(c), **options), field) ** power
        return jnp.where(jnp.isfinite(values), values, 0).sum()

    return jax.jit(jax.grad(total, (0, 1, 2)))(contacts.positions, contacts.friction, contacts.max_force)


def tangent(dtype, of: Callable, field: str, n_c=3, **options):
    contacts = harness.data_of(batch(n_c, PLAIN), dtype)[0]
    along = jnp.asarray(0.01 * np.random.default_rng(6).normal(size=contacts.positions.shape), dtype)
    move = lambda p: getattr(of(dtype, n_c, moved=lambda c: replace(c, positions=p), families=PLAIN, **options), field)  # noqa: E731
    return jax.jit(lambda p: jax.jvp(move, (p,), (along,))[1])(contacts.positions)


def number(value: float) -> Callable[[jnp.dtype], jax.Array]:
    return lambda dtype: jnp.asarray(value, dtype)


def blocks(*shape: int) -> Callable[[jnp.dtype], jax.Array]:
    return lambda dtype: jnp.asarray(matrices(*shape), dtype)


SMOOTHING = {"smoothing": number(1e-3)}
GROUPS: dict[str, dict[str, Program]] = {
    "plain": {"margin": margin, "effort": effort},
    "smooth": {"smoothed set": partial(margin, disturbances="smoothed")},
    "gradients": {
        "of margins": partial(gradient, of=margin, field="margin"),
        "of efforts": partial(gradient, of=effort, field="effort", share=0.2),
    },
    "margins": {f"{n_c} contacts": partial(margin, n_c=n_c, cone_edges=8) for n_c in (2, 3, 4, 5, 8)},
    "efforts": {f"{n_c} contacts": partial(effort, n_c=n_c, cone_edges=8) for n_c in (2, 3, 4, 5, 8)},
    "edges": {f"{what.__name__}, {n}": partial(what, cone_edges=n) for n in (6, 16) for what in (margin, effort)},
    "sets": {f"margin, {name}": partial(margin, disturbances=name) for name in SETS}
    | {f"effort, {name}": partial(effort, disturbances=name) for name in SETS}
    | {f"worst case, {name}": partial(worst_case, disturbances=name) for name in SETS}
    | {"worst case, vertices": worst_case},
    "options": {
        "smoothed margin": partial(margin, **SMOOTHING),
        "smoothed effort": partial(effort, **SMOOTHING),
        "cutoff": partial(margin, cutoff=number(2.0)),
        "cone margins of rows": partial(margin, rows=True),
        "compliance": partial(margin, compliance=blocks(LANES, 3, 3, 3)),
        "effort, compliance": partial(effort, compliance=blocks(LANES, 3, 3, 3)),
        "compliance of all": partial(margin, compliance=blocks(9, 9)),
        "compliance by direction": partial(
            margin, compliance=lambda dtype: jg.Compliance.per_direction(blocks(12, 3, 3, 3)(dtype))
        ),
        "weights": partial(effort, effort_weights=blocks(LANES, 3, 3, 3)),
        "full weights": partial(effort, effort_weights=blocks(LANES, 9, 9)),
        "actuators": partial(margin, actuation=actuation),
        "effort, actuators": partial(effort, actuation=actuation),
    },
    "hands": {
        "margin": partial(margin, actuation=whole_hand),
        "effort": partial(effort, actuation=whole_hand),
    },
    "chain": {
        name: partial(formulation, name=name)
        for name in ("12", "12_fixed", "13", "16", "per_direction", "per_direction_prestrained")
    }
    | {
        "12, norm": partial(formulation, name="12", force_bound="norm"),
        "total effort": total_effort,
        "total effort, 4": partial(total_effort, n_c=4),
        "total effort, matrices": partial(
            total_effort,
            compliance=lambda dtype: jg.Compliance.per_direction(blocks(12, 3, 3, 3)(dtype)),
            effort_weights=blocks(LANES, 9, 9),
        ),
        "specified, (6)": partial(specified, kind="6"),
        "specified, (9)": partial(specified, kind="9"),
    },
    "metrics": {
        "closure": partial(measured, metric=jg.metrics.force_closure),
        "closure, 3": partial(measured, metric=jg.metrics.force_closure, n_c=3, cone_edges=8),
        "closure, soft": partial(measured, metric=jg.metrics.force_closure, torsion=0.1),
        "nearest facet": partial(measured, metric=jg.metrics.nearest_facet, norm="L1"),
        "nearest facet, each finger": partial(measured, metric=jg.metrics.nearest_facet, norm="Linf", n_c=3),
        "task": partial(measured, metric=partial(jg.metrics.task_wrench, task=jg.DisturbanceSet.forces(1.0))),
        "derivatives of min-weights": partial(gradient_of_metric, metric=jg.metrics.min_weight),
    },
    "derivatives": {
        "of forces": partial(gradient, of=margin, field="forces", power=2),
        "of smoothed forces": partial(gradient, of=margin, field="forces", power=2, **SMOOTHING),
        "of smoothed efforts": partial(gradient, of=effort, field="effort", share=0.2, **SMOOTHING),
        "of an effort's forces": partial(gradient, of=effort, field="forces", power=2, share=0.2),
        "of total efforts": partial(gradient, of=total_effort, field="effort"),
        "along, margin": partial(tangent, of=margin, field="margin"),
        "along, forces": partial(tangent, of=effort, field="forces", share=0.2),
    },
    "derivatives, sets": {
        name: partial(gradient, of=margin, field="margin", disturbances=name) for name in SETS if name != "forces"
    },
}


def answers(group: str, dtype: str) -> dict[str, np.ndarray]:
    """All results of one call of every program, by program and path."""
    found = {}
    for name, program in GROUPS[group].items():
        for path, leaf in jax.tree_util.tree_flatten_with_path(program(jnp.dtype(dtype)))[0]:
            found[f"{name}: {jax.tree_util.keystr(path)}"] = np.asarray(leaf)
    return found


def answers_of_xla(group: str, dtype: str) -> dict[str, np.ndarray]:
    jax.clear_caches()
    with kernels.without():
        found = answers(group, dtype)
    jax.clear_caches()
    return found


def differing(ours: np.ndarray, theirs: np.ndarray) -> np.ndarray:
    """The lanes that are not equal to the last bit; NaN equals NaN."""
    a, b = ours.reshape(len(ours), -1), theirs.reshape(len(theirs), -1)
    same = a == b
    if a.dtype.kind == "f":
        same |= np.isnan(a) & np.isnan(b)
    return np.flatnonzero(~same.all(1))
