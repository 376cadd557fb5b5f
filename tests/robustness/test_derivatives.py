"""Derivatives of every output with respect to every input, against central differences of 1,000 random grasps.

Differences are taken of central points, which Newton's method finds to rounding, where the bounds of the exact margin
leave 1e-8. They count where the same rows are active, and the same vertices worst, on both sides of the step, and for
the exact margin where every row is active or not by a factor; how many grasps that leaves is asserted, too.
"""

from __future__ import annotations

from functools import cache, partial

import jax
import jax.numpy as jnp
import numpy as np
import problems
import pytest

import jaxgrasp as jg

pytestmark = pytest.mark.thorough

LANES, CONTACTS, EDGES = 1000, 4, 8
KAPPA = {"bounds": 1e-9, "margin": 1e-6, "effort": 1e-8}
"""In units of the margin's or the effort's natural scale: small enough to stand for the exact margin; of the central
points that the derivatives of (21)'s and of (22)'s exact forces belong to."""
STEP = 3e-7
"""Relative to the largest entry of an input; of a cone margin, to a newton."""
NEARLY_ACTIVE = 1e-4
"""Least max(s, z) over the rows, by f_max and by the margin's scale, at an optimum with a single slope."""
COUNTED = 0.9
MOST, WORST = 1e-5, 1e-3
"""Errors of the 99th percentile and of the worst grasp, relative to the derivative or, where that is larger, to the
size of the outputs over that of the input."""
OUTPUTS = ("margin", "forces", "effort")
WRENCH = np.array([1, 1, 1, 0.03, 0.03, 0.03])


def positive_definite(rng: np.random.Generator) -> np.ndarray:
    root = rng.normal(size=(LANES, CONTACTS, 3, 3))
    return 0.2 * root @ np.swapaxes(root, -1, -2) + np.eye(3)


@cache
def inputs() -> dict[str, jax.Array]:
    """Ellipsoids of a few centimetres, a light load, and a sum of sets of every kind."""
    rng = np.random.default_rng(11)
    directions, axes = problems.unit_vectors(rng, LANES, CONTACTS), rng.uniform(0.02, 0.06, (LANES, 1, 3))
    given = {
        "positions": directions * axes,
        "normals": directions / axes * 0.03,
        "friction": rng.uniform(0.5, 1.0, (LANES, CONTACTS)),
        "max_force": rng.uniform(2.0, 6.0, (LANES, CONTACTS)),
        "vertices": rng.normal(size=(LANES, 5, 6)) * WRENCH,
        "half_extents": rng.uniform(0.1, 0.5, (LANES, 6)) * WRENCH,
        "shape_matrix": 0.3 * rng.normal(size=(LANES, 6, 6)) * WRENCH[:, None],
        "radius": rng.uniform(0.1, 0.5, LANES),
        "required_wrench": 0.1 * rng.normal(size=(LANES, 6)) * WRENCH,
        "cone_margin": rng.uniform(0.01, 0.05, LANES),
        "compliance": positive_definite(rng),
    }
    return {name: jnp.asarray(value) for name, value in given.items()}


def data(x: dict[str, jax.Array]) -> tuple[jg.Contacts, jg.DisturbanceSet, dict]:
    contacts = jg.Contacts.from_normals(x["positions"], x["normals"], friction=x["friction"], max_force=x["max_force"])
    disturbances = jg.DisturbanceSet.vertices(x["vertices"]) + jg.DisturbanceSet.box(x["half_extents"])
    disturbances += jg.DisturbanceSet.ellipsoid(x["shape_matrix"]) + jg.DisturbanceSet.ball(x["radius"], 0.02)
    return contacts, disturbances, {k: x[k] for k in ("required_wrench", "compliance", "cone_margin")}


def solve(x: dict[str, jax.Array], smoothing: jax.Array | None) -> jg.Solution:
    """(22) where a margin is among the inputs, else (21)."""
    contacts, disturbances, rest = data(x)
    if "margin" not in x:
        return jg.largest_disturbance(contacts, disturbances, **rest, smoothing=smoothing)
    weights = x["effort_weights"]
    return jg.least_effort(contacts, disturbances, x["margin"], **rest, effort_weights=weights, smoothing=smoothing)


central = jax.jit(solve)


@jax.jit
def reaches(x: dict[str, jax.Array]) -> jax.Array:
    """-S_1 and S_2, scaled, (lanes, rows)."""
    contacts, disturbances, rest = data(x)
    cone, bound = jg.worst_case(contacts, disturbances, rest["compliance"])
    cone = -cone / (contacts.friction * contacts.max_force)[..., None]
    return jnp.concatenate([cone, (bound / contacts.max_force)[..., None]], -1).reshape(LANES, -1)


def natural_scale(x: dict[str, jax.Array]) -> jax.Array:
    return 1 / reaches(x).max(-1)


def outputs(x: dict[str, jax.Array], smoothing: jax.Array | None) -> dict[str, jax.Array]:
    solution = solve(x, smoothing)
    return {name: getattr(solution, name) for name in OUTPUTS}


@jax.jit
def pulled(x: dict, cotangents: dict, smoothing: jax.Array | None) -> dict:
    return jax.vjp(partial(outputs, smoothing=smoothing), x)[1](cotangents)[0]


@jax.jit
def pushed(x: dict, change: dict) -> dict:
    return jax.jvp(partial(outputs, smoothing=None), (x,), (change,))[1]


def random_like(tree: dict, seed: int) -> dict:
    rng = np.random.default_rng(seed)
    return {name: jnp.asarray(rng.normal(size=np.shape(value))) for name, value in sorted(tree.items())}


def along(a: dict, b: dict) -> np.ndarray:
    """Inner products, grasp by grasp."""
    return sum(np.sum(np.asarray(a[k] * b[k]).reshape(LANES, -1), -1) for k in a)


def rows(solution: jg.Solution, x: dict, kappa: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Slacks, by f_max, and multipliers, by the objective that they are to be seen against; (lanes, rows)."""
    force = np.asarray(x["max_force"])
    units = np.concatenate([np.repeat((np.asarray(x["friction"]) * force)[..., None], EDGES, -1), force[..., None]], -1)
    z = np.concatenate([solution.cone_multipliers, np.asarray(solution.bound_multipliers)[..., None]], -1)
    scale = np.asarray(natural_scale(x) if "margin" not in x else effort_unit(x))
    s = kappa[:, None, None] / np.where(z > 0, z, 1)
    return (s / units).reshape(LANES, -1), (z * units / scale[:, None, None]).reshape(LANES, -1)


def check(x: dict, kappa: float, unit: jax.Array, exact: bool, names: tuple[str, ...] = OUTPUTS) -> None:
    """Derivatives of the named outputs along a random direction of every input by itself."""
    smoothing = np.asarray(kappa * unit)
    here = central(x, smoothing)
    solved = np.asarray(here.status) == jg.Status.SOLVED
    s, z = rows(here, x, smoothing)
    # What max(s, z) is at the optimum, it is at the central point, and a little more.
    least = 0.5 * (NEARLY_ACTIVE + np.sqrt(NEARLY_ACTIVE**2 + 4 * kappa))
    generic = solved & (np.maximum(s, z).min(-1) > least)
    cotangents = random_like({k: getattr(here, k) for k in OUTPUTS}, 1)
    for k, v in cotangents.items():
        cotangents[k] = jnp.where((k in names) & solved.reshape(-1, *[1] * (v.ndim - 1)), v, 0)
    gradient = pulled(x, cotangents, None if exact else smoothing)
    for name, direction in random_like(x, 2).items():
        if name in ("compliance", "effort_weights"):
            direction = direction + jnp.swapaxes(direction, -1, -2)
        size = float(jnp.abs(x[name]).max()) if name != "cone_margin" else 1.0
        step = STEP * size
        moved = [{**x, name: x[name] + sign * step * direction} for sign in (1, -1)]
        sides = [central(each, smoothing) for each in moved]
        same = [np.equal(*(a > b for a, b in (rows(side, x, smoothing), (s, z)))).all(-1) for side in sides]
        low, middle, high = (np.asarray(reaches(each)) for each in (moved[1], x, moved[0]))
        bend, slope = np.abs(low + high - 2 * middle).max(-1), np.abs(high - low).max(-1)
        counted = generic & same[0] & same[1] & (bend <= 1e-2 * slope)
        assert np.mean(counted[solved]) >= COUNTED, (name, np.mean(counted[solved]))
        values = [along(cotangents, {k: getattr(side, k) for k in OUTPUTS})[counted] for side in sides]
        difference = (values[0] - values[1]) / (2 * step)
        found = along({name: gradient[name]}, {name: direction})[counted]
        error = np.abs(found - difference) / np.maximum(np.abs(difference), np.median(np.abs(values[0])) / size)
        assert np.percentile(error, 99) <= MOST, (name, np.percentile(error, 99))
        assert error.max() <= WORST, (name, error.max())


@cache
def asked() -> dict[str, jax.Array]:
    """The inputs of (22): 60 % of the margin, and weights."""
    weights = jnp.asarray(positive_definite(np.random.default_rng(12)))
    margin = central(inputs(), KAPPA["margin"] * natural_scale(inputs())).margin
    return {**inputs(), "margin": jnp.where(margin > 0, 0.6 * margin, 0.1), "effort_weights": weights}


def effort_unit(x: dict) -> jax.Array:
    """The square of the largest entry of a root of Q_0 in units of the largest forces."""
    root = jnp.swapaxes(jnp.linalg.cholesky(x["effort_weights"]), -1, -2)
    tangential = x["friction"] * x["max_force"]
    units = jnp.stack([tangential, tangential, x["max_force"]], -1)[..., None, :]
    return jnp.abs(root * units).max((-1, -2, -3)) ** 2


def test_margin():
    x = inputs()
    check(x, KAPPA["bounds"], natural_scale(x), True, ("margin",))


def test_forces_of_the_largest_disturbance():
    x = inputs()
    check(x, KAPPA["margin"], natural_scale(x), True, ("forces", "effort"))


def test_smoothed_largest_disturbance():
    x = inputs()
    check(x, 1e-2, natural_scale(x), False)


def test_least_effort():
    x = asked()
    check(x, KAPPA["effort"], effort_unit(x), True)


def test_forward_is_reverse():
    x = inputs()
    here = central(x, KAPPA["margin"] * natural_scale(x))
    solved = here.status == jg.Status.SOLVED
    cotangents = random_like({k: getattr(here, k) for k in OUTPUTS}, 5)
    cotangents = {k: jnp.where(solved.reshape(-1, *[1] * (v.ndim - 1)), v, 0) for k, v in cotangents.items()}
    change = random_like(x, 6)
    change["compliance"] = change["compliance"] + jnp.swapaxes(change["compliance"], -1, -2)
    forward = along(cotangents, {k: jnp.nan_to_num(v) for k, v in pushed(x, change).items()})
    gradient = pulled(x, cotangents, None)
    parts = np.stack([along({name: gradient[name]}, {name: change[name]}) for name in x])
    assert np.max(np.abs(forward - parts.sum(0)) / np.maximum(1, np.abs(parts).sum(0))) <= 1e-10
