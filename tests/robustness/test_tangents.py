"""Tangents by the rule of `frames_from_normals`: rounding does not choose them."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import problems
import pytest

import jaxgrasp as jg
from jaxgrasp.arrays import frames_from_normals

AWAY = 1e-12
"""How far normals are from an axis."""

SAME = {"float64": 1e-8, "float32": 1e-4}
"""Relative: rounded otherwise, few grasps need an iteration more or less, and the margin is as good as the gap."""

PRECISIONS = 1e-4
"""Relative: what margins in float32 are off, see `test_float32`."""

SINGULAR = np.array([[-0.08709980, side * 0.42670014, -0.90018921] for side in (1, -1)])
"""Where the tangents have no limit."""

SIX = jg.DisturbanceSet.forces(1.0)
AXES = np.concatenate([np.eye(3), -np.eye(3)])


def near_axes(count: int, away: float = AWAY) -> tuple[np.ndarray, ...]:
    """Rotations of objects, positions (count, 5, 3) and normals in the world, friction: normals near five axes each."""
    rng = np.random.default_rng(24)
    axes = AXES[rng.permuted(np.tile(np.arange(6), (count, 1)), axis=1)[:, :5]]
    positions = 0.03 * axes + 0.02 * rng.uniform(-1, 1, axes.shape) * (1 - np.abs(axes))
    friction, rotation = rng.uniform(0.4, 1, (count, 5)), problems.rotations(rng, count)
    normals = axes + away * rng.uniform(-1, 1, axes.shape)
    return rotation, *(np.einsum("lij,lcj->lci", rotation, x) for x in (positions, normals)), friction


def margin(rotation, positions, normals, friction):
    """Contacts are found in the world and turned into the object's frame; under `jit` that is rounded otherwise."""
    positions, normals = ((rotation[..., None, :, :] * x[..., None]).sum(-2) for x in (positions, normals))
    contacts = jg.Contacts.from_normals(positions, normals, friction=friction, max_force=5.0)
    return jg.largest_disturbance(contacts, SIX, cone_edges=4).margin


def assert_near(ours, expected, relative: float) -> None:
    expected = np.asarray(expected)
    assert np.median(expected) > 1
    np.testing.assert_allclose(ours, expected, rtol=relative, atol=relative)


@pytest.mark.parametrize(
    "count, single, precision",
    [
        (200, 10, "float64"),
        pytest.param(10_000, 10_000, "float64", marks=pytest.mark.thorough),
        pytest.param(10_000, 10_000, "float32", marks=pytest.mark.thorough),
    ],
)
def test_rounding_does_not_choose_tangents(count, single, precision):
    data = near_axes(count)
    own = [jnp.asarray(x, precision) for x in data]
    batch = margin(*own)
    assert_near(jax.jit(jax.vmap(margin))(*own), batch, SAME[precision])
    assert_near(jax.vmap(jax.jit(margin))(*own), batch, SAME[precision])
    for one in (margin, jax.jit(margin)):
        assert_near([one(*(x[lane] for x in own)) for lane in range(single)], batch[:single], SAME[precision])
    # At the axes themselves, and in the other precision.
    other = {"float64": "float32", "float32": "float64"}[precision]
    assert_near(margin(*(jnp.asarray(x, other) for x in data)), batch, PRECISIONS)
    exact = [jnp.asarray(x, precision) for x in near_axes(count, 0.0)]
    assert_near(margin(*exact), batch, SAME[precision])


def test_frames_are_smooth_rotations():
    rng = np.random.default_rng(25)
    normals = np.concatenate([problems.unit_vectors(rng, 4000), AXES, [[1, 0, -1], [1, 1, -1], [1e-9, 0, -1]]])
    normals /= np.linalg.norm(normals, axis=-1, keepdims=True)
    frames = np.asarray(frames_from_normals(normals))
    np.testing.assert_allclose(
        np.swapaxes(frames, -1, -2) @ frames, np.broadcast_to(np.eye(3), frames.shape), atol=1e-14
    )
    np.testing.assert_allclose(np.linalg.det(frames), 1, atol=1e-14)
    np.testing.assert_allclose(frames[..., 2], normals, atol=1e-15)
    near = frames_from_normals(normals + 1e-9 * rng.normal(size=normals.shape))
    far = np.linalg.norm(normals[:, None] - SINGULAR, axis=-1).min(-1) > 0.05
    np.testing.assert_allclose(np.asarray(near)[far], frames[far], atol=2e-7)


def test_frames_are_the_smallest_rotation_but_near_minus_z():
    normals = problems.unit_vectors(np.random.default_rng(26), 2000)
    normals = normals[normals[:, 2] > -np.sqrt(0.5)]
    frames = np.asarray(frames_from_normals(normals))
    x, y, z = normals.T
    axis, cosine = np.stack([-y, x, 0 * x], -1), z[:, None, None]
    cross = np.cross(axis[:, None], np.eye(3)).swapaxes(-1, -2)
    smallest = np.eye(3) + cross + cross @ cross / (1 + cosine)
    np.testing.assert_allclose(frames, smallest, atol=1e-14)
    np.testing.assert_array_equal(frames_from_normals(-np.eye(3)[2]), np.diag([-1.0, 1.0, -1.0]))


@pytest.mark.parametrize("precision", ["float64", "float32"])
def test_frames_are_finite_at_the_singular_directions(precision):
    rng, tolerance = np.random.default_rng(27), {"float64": 1e-14, "float32": 1e-6}[precision]
    for away in (1e-2, 1e-5, 1e-8, 1e-12, 1e-16, 0):
        normals = SINGULAR + away * rng.normal(size=(100, 2, 3))
        normals = jnp.asarray(normals, precision)
        frames = np.asarray(frames_from_normals(normals), float)
        assert np.abs(np.swapaxes(frames, -1, -2) @ frames - np.eye(3)).max() <= tolerance
        slopes = jax.grad(lambda n: frames_from_normals(n)[..., :2].sum())(normals)
        assert np.isfinite(slopes).all()


def test_derivatives_of_frames():
    rng = np.random.default_rng(28)
    low = [[0.0, 0.0, -1.0], [1.0, 1.0, -1.42], [0.1, 0.2, -1.0], [0.5, -0.6, -1.0], [1.0, 0.0, -1.0]]
    normals = jnp.asarray(np.concatenate([low, problems.unit_vectors(rng, 10)]))
    change = jnp.asarray(rng.normal(size=normals.shape))
    first = lambda n: jax.jvp(frames_from_normals, (n,), (change,))[1]  # noqa: E731
    for function in (frames_from_normals, first):
        found = jax.jit(lambda n, of=function: jax.jvp(of, (n,), (change,))[1])(normals)
        sides = [np.asarray(function(normals + sign * 1e-6 * change)) for sign in (1, -1)]
        np.testing.assert_allclose(found, (sides[0] - sides[1]) / 2e-6, rtol=1e-5, atol=1e-5)
