"""The weighted pseudo-inverse G* (15) against NumPy, its derivatives, and grasps without full rank."""

from __future__ import annotations

import harness
import jax
import jax.numpy as jnp
import numpy as np
import problems
import pytest
from problems import sample
from test_identities import compliances

import jaxgrasp as jg

SAME = 1e-11
"""Of the largest entry, moments in units of the contacts' distance."""

DIRECTIONS = 3
KINDS = [None, "blocks", "full", "per direction"]


def ellipsoids(count: int, n_c: int = 4) -> tuple[jg.Contacts, np.ndarray]:
    """Grasps around ellipsoids of some centimetres, one contact in ten absent, and their lengths."""
    rng = np.random.default_rng(30)
    positions, frames = problems.ellipsoid_contacts(rng, count, n_c, "around")
    active = rng.random((count, n_c)) < 0.9
    active[:, :3] |= active.sum(-1, keepdims=True) < 3
    contacts = jg.Contacts.from_frames(0.05 * positions, frames, friction=0.5, max_force=2.0, active=active)
    squares = np.where(active, (0.05**2) * (positions**2).sum(-1), 0).sum(-1)
    return contacts, np.sqrt(squares / active.sum(-1))


def given(Q: np.ndarray | None, kind: str | None) -> jg.Compliance | jnp.ndarray | None:
    if Q is None:
        return None
    return jg.Compliance.per_direction(Q) if kind == "per direction" else jnp.asarray(Q)


def of_numpy(contacts: jg.Contacts, lane: int, Q: np.ndarray | None, length: float) -> np.ndarray:
    """G* (3 n_c, 6) of a lane for blocks or a full Q, by NumPy's pseudo-inverse."""
    there = np.repeat(np.asarray(contacts.active[lane]), 3)
    frames = np.asarray(contacts.frames[lane])
    moments = np.cross(np.asarray(contacts.positions[lane])[:, :, None], frames, axis=1)
    G = np.concatenate([frames, moments], 1).transpose(1, 0, 2).reshape(6, -1)[:, there]
    if Q is None:
        Q = np.eye(len(there))
    elif Q.ndim == 3:
        whole = np.zeros((len(there),) * 2)
        for i, block in enumerate(Q):
            whole[3 * i : 3 * i + 3, 3 * i : 3 * i + 3] = block
        Q = whole
    root = np.linalg.inv(np.linalg.cholesky(Q[there][:, there])).T
    units = np.repeat([1, 1 / length], 3)
    out = np.zeros((len(there), 6))
    out[there] = root @ np.linalg.pinv(units[:, None] * G @ root, rcond=1e-12) * units
    return out


@pytest.mark.parametrize("kind", KINDS)
def test_it_is_that_of_numpy(kind):
    count = 500
    contacts, lengths = ellipsoids(count)
    Q = None if kind is None else compliances(np.random.default_rng(31), count, 4, DIRECTIONS, kind)
    ours = np.asarray(jg.weighted_pseudo_inverse(contacts, given(Q, kind)))
    assert ours.shape == ((count, DIRECTIONS, 12, 6) if kind == "per direction" else (count, 12, 6))
    absent = ~np.repeat(np.asarray(contacts.active), 3, -1)
    assert absent.any() and not np.moveaxis(ours, -2, 1)[absent].any()
    for lane in range(count):
        every = [None] if Q is None else Q[lane] if kind == "per direction" else [Q[lane]]
        expected = np.stack([of_numpy(contacts, lane, q, lengths[lane]) for q in every]).reshape(ours[lane].shape)
        in_newtons = np.repeat([1, lengths[lane]], 3)
        assert np.abs((ours[lane] - expected) * in_newtons).max() <= SAME * np.abs(expected * in_newtons).max()


@pytest.mark.parametrize("kind", KINDS)
def test_derivatives(kind):
    rng = np.random.default_rng(32)
    contacts, _ = ellipsoids(8)
    Q = np.ones(1) if kind is None else compliances(rng, 8, 4, DIRECTIONS, kind)

    @jax.jit
    def inverse(positions, frames, Q):
        grasps = jg.Contacts.from_frames(positions, frames, friction=0.5, max_force=2.0, active=contacts.active)
        if kind is None:
            return jg.weighted_pseudo_inverse(grasps)
        return jg.weighted_pseudo_inverse(grasps, jg.Compliance.per_direction(Q) if kind == "per direction" else Q)

    x = (contacts.positions, contacts.frames, jnp.asarray(Q))
    weights = jnp.asarray(rng.normal(size=inverse(*x).shape))
    total = lambda *x: jnp.sum(inverse(*x) * weights)  # noqa: E731
    found = jax.jit(jax.grad(total, argnums=range(3)))(*x)
    for i in range(2 if kind is None else 3):
        change = rng.normal(size=x[i].shape)
        if i == 2:
            change = change + np.swapaxes(change, -1, -2)
        # Frames stay rotations to the accuracy that is asked of them.
        step = {0: 1e-7, 1: 1e-7, 2: 1e-6}[i]
        sides = [total(*x[:i], x[i] + sign * step * change, *x[i + 1 :]) for sign in (1, -1)]
        difference = (sides[0] - sides[1]) / (2 * step)
        assert abs(jnp.sum(found[i] * change) - difference) <= 1e-5 * abs(difference)


@pytest.mark.parametrize("kind", KINDS)
def test_blocking_forces_are_minus_it_without_full_rank_too(kind):
    batch = sample(families=("around", "light load"), count=6)
    contacts = harness.contacts_of(batch)
    # Of every second grasp two contacts alone: G has rank 5.
    few = np.asarray(contacts.active).copy()
    few[::2, 2:] = False
    contacts = jg.Contacts.from_frames(
        contacts.positions, contacts.frames, friction=contacts.friction, max_force=contacts.max_force, active=few
    )
    rng = np.random.default_rng(33)
    count = DIRECTIONS if kind == "per direction" else 1
    wrenches = rng.normal(size=(len(batch), count, 6)) * np.repeat([1.0, 0.05], 3)
    Q = None if kind is None else compliances(rng, len(batch), 4, DIRECTIONS, kind)
    inverse = np.asarray(jg.weighted_pseudo_inverse(contacts, given(Q, kind)))
    inverse = inverse if kind == "per direction" else inverse[:, None]
    forces = np.asarray(jg.blocking_forces(contacts, wrenches, given(Q, kind))).reshape(len(batch), count, 12)
    expected = -np.einsum("ldre,lde->ldr", inverse, wrenches)
    np.testing.assert_allclose(forces, expected, atol=1e-12 * np.abs(expected).max())


def test_jit_vmap_and_single():
    contacts, _ = ellipsoids(6)
    whole = np.asarray(jg.weighted_pseudo_inverse(contacts))
    size = np.abs(whole).max()
    np.testing.assert_allclose(
        jax.jit(jax.vmap(jg.weighted_pseudo_inverse))(contacts), whole, rtol=0, atol=1e-12 * size
    )
    one = jax.tree.map(lambda x: x[3], contacts)
    np.testing.assert_allclose(jg.weighted_pseudo_inverse(one), whole[3], rtol=0, atol=1e-12 * size)
    Q = jnp.eye(12) * jnp.arange(1.0, 4.0)[:, None, None]
    shared = jg.weighted_pseudo_inverse(one, jg.Compliance.per_direction(Q))
    assert shared.shape == (3, 12, 6)
    # A multiple of Q changes nothing.
    np.testing.assert_allclose(shared, np.broadcast_to(whole[3], shared.shape), rtol=0, atol=1e-12 * size)


def test_what_is_not_admissible_is_nan():
    contacts, _ = ellipsoids(3)
    Q = np.tile(np.eye(3), (3, 4, 1, 1))
    Q[1, int(np.argmax(contacts.active[1]))] *= -1
    found = np.asarray(jg.weighted_pseudo_inverse(contacts, Q))
    np.testing.assert_array_equal(np.isnan(found).all((-1, -2)), [False, True, False])
    assert np.isfinite(found[::2]).all()
    with pytest.raises(ValueError, match="compliance: got shape"):
        jg.weighted_pseudo_inverse(contacts, np.eye(5))
    with pytest.raises(ValueError, match="contacts: got"):
        jg.weighted_pseudo_inverse(None, jg.Compliance.per_direction(np.ones((2, 12, 12))))
