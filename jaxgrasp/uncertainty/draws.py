"""Draws of what is not known, shared by all grasps, and grasps as they are with them."""

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxgrasp.arrays import fold
from jaxgrasp.contact.contacts import Contacts
from jaxgrasp.uncertainty.spec import QUANTITIES, Distribution, Samples, Uncertainty

LEAST_SHARE = 1e-3
"""No largest force becomes less than this share of itself."""
# Numbers that all contacts have in common are drawn as those of a contact that no grasp has.
_COMMON = 1 << 20

Draws = dict[str, jax.Array]
"""The deviations of quantities by name, (*samples, *shape) each."""


class Drawn(NamedTuple):
    """Grasps with deviations."""

    contacts: Contacts
    """The contacts."""
    required_wrench: Float[Array, "*batch 6"] | None
    """b, N and N m."""
    clipped: Float[Array, "*batch"]
    """1 where a value would have left what is admissible, else 0."""


def draw(uncertainty: Uncertainty, n_c: int, count: int, seed: jax.Array, dtype: jnp.dtype) -> Draws:
    """Draw the deviations of all samples: (count, *shape) by the names of their quantities.

    A contact has the same numbers however many others there are, and a sample has however many follow.

    Args:
        uncertainty: the distributions.
        n_c: the number of contacts.
        count: the number of samples.
        seed: an integer.
        dtype: that of the grasps.

    Raises:
        ValueError: a distribution does not fit the number of contacts.
    """
    key, found = jax.random.key(seed), {}
    for number, (name, quantity) in enumerate(QUANTITIES.items()):
        given, shape = getattr(uncertainty, name), quantity.shape(n_c)
        if given is None:
            continue
        given = jax.tree.map(lambda x: x.astype(dtype), given)
        if isinstance(given, Samples):
            found[name] = _spread_samples(name, given, shape)
            continue
        own = jax.random.fold_in(key, number)
        numbers_of = partial(_numbers_of, own, (count, *quantity.components), dtype)
        if not quantity.of_contacts:
            numbers = numbers_of(0)
        else:
            numbers = jnp.stack([numbers_of(contact) for contact in range(n_c)], 1)
            if given.between_contacts is not None:
                share = given.between_contacts
                numbers = jnp.sqrt(share) * numbers_of(_COMMON)[:, None] + jnp.sqrt(1 - share) * numbers
        if given.root is not None:
            numbers = _correlated(name, numbers, given.root)
        _check_shape(name, given, shape)
        found[name] = jnp.broadcast_to(given.deviations(numbers), (count, *shape))
    return found


def _numbers_of(key: jax.Array, shape: tuple[int, ...], dtype: jnp.dtype, contact: int) -> jax.Array:
    """Standard normal numbers of one contact, or of the grasp."""
    return jax.random.normal(jax.random.fold_in(key, contact), shape, dtype)


def apply(contacts: Contacts, wrench: jax.Array | None, draws: Draws) -> Drawn:
    """The grasps with the deviations of draws, which broadcast to the grasps' batch.

    Args:
        contacts: the grasps.
        wrench: b (*batch, 6); None is zero.
        draws: (*batch, *shape) by the names of quantities.
    """
    positions, frames = contacts.positions, contacts.frames
    friction, max_force = contacts.friction, contacts.max_force
    clipped = jnp.zeros(contacts.batch_shape, bool)
    if "position" in draws:
        positions = positions + _times(frames, draws["position"])
    if "center_of_mass" in draws:
        positions = positions - draws["center_of_mass"][..., None, :]
    if "normal" in draws:
        turns = _turns(draws["normal"])
        frames = jnp.stack([_times(frames, turns[..., column]) for column in range(3)], -1)
    if "friction" in draws:
        wanted = friction + draws["friction"]
        clipped |= ((wanted < 0) & contacts.active).any(-1)
        # What was negative from the beginning stays the grasp's own INVALID_INPUT.
        friction = jnp.where(friction < 0, friction, jnp.maximum(wanted, 0))
    if "max_force" in draws:
        clipped |= ((draws["max_force"] < LEAST_SHARE - 1) & contacts.active).any(-1)
        max_force = max_force * jnp.maximum(1 + draws["max_force"], LEAST_SHARE)
    if wrench is not None and "mass" in draws:
        clipped |= draws["mass"] < -1
        wrench = wrench * jnp.maximum(1 + draws["mass"], 0)[..., None]
    if "load" in draws:
        wrench = draws["load"] if wrench is None else wrench + draws["load"]
    drawn = Contacts.from_frames(
        positions,
        frames,
        friction=friction,
        max_force=max_force,
        active=contacts.active,
        torsional_friction=contacts.torsional_friction,
    )
    return Drawn(drawn, wrench, clipped.astype(positions.dtype))


def turn_jacobian(jacobian: jax.Array, angles: jax.Array) -> jax.Array:
    """The same motion of contact points, (..., n_c, k, n_v), in contact frames that are turned by angles."""
    turns = _turns(angles)[..., None]
    rows = [fold(jnp.add, [turns[..., b, a, :] * jacobian[..., b, :] for b in range(3)]) for a in range(3)]
    # Moments about normals.
    rows += [jnp.broadcast_to(jacobian[..., k, :], rows[0].shape) for k in range(3, jacobian.shape[-2])]
    return jnp.stack(rows, -2)


def _times(frames: jax.Array, vectors: jax.Array) -> jax.Array:
    """The products of matrices (..., 3, 3) and vectors (..., 3), spelt out: XLA's are calls of a library."""
    return fold(jnp.add, [frames[..., a] * vectors[..., a : a + 1] for a in range(3)])


def _turns(angles: jax.Array) -> jax.Array:
    """The rotations exp([a, b, 0]x) about t1 and t2, (..., 3, 3), by angles (..., 2), rad."""
    a, b = angles[..., 0], angles[..., 1]
    square = a**2 + b**2
    # sin(x) / x and (1 - cos(x)) / x^2, whose derivatives at zero JAX does not know.
    small = square < 1e-6
    angle = jnp.sqrt(jnp.where(small, 1, square))
    sine = jnp.where(small, 1 - square / 6 + square**2 / 120, jnp.sin(angle) / angle)
    versine = jnp.where(small, 0.5 - square / 24 + square**2 / 720, (1 - jnp.cos(angle)) / angle**2)
    rows = [
        [1 - versine * b**2, versine * a * b, sine * b],
        [versine * a * b, 1 - versine * a**2, -sine * a],
        [-sine * b, sine * a, 1 - versine * square],
    ]
    return jnp.stack([jnp.stack(row, -1) for row in rows], -2)


def _correlated(name: str, numbers: jax.Array, root: jax.Array) -> jax.Array:
    """Numbers (count, *shape) with the correlation matrix of a root."""
    flat = numbers.reshape(len(numbers), -1)
    if root.shape != (flat.shape[1],) * 2:
        raise ValueError(
            f"{name}: got a correlation matrix of shape {root.shape}, wanted {(flat.shape[1],) * 2}, all components of "
            f"{name} {numbers.shape[1:]}"
        )
    return (flat @ root.T).reshape(numbers.shape)


def _check_shape(name: str, given: Distribution, shape: tuple[int, ...]) -> None:
    parts = {"spread": given.spread, "mean": given.mean}
    if given.bounds is not None:
        parts |= dict(zip(("lower", "upper"), given.bounds, strict=True))
    for part, value in parts.items():
        try:
            fits = jnp.broadcast_shapes(value.shape, shape) == shape
        except ValueError:
            fits = False
        if not fits:
            raise ValueError(f"{name}: got a {part} of shape {value.shape}, wanted one that broadcasts to {shape}")


def _spread_samples(name: str, given: Samples, shape: tuple[int, ...]) -> jax.Array:
    values = given.values
    if values.ndim == 1:
        values = values.reshape(-1, *[1] * len(shape))
    elif values.shape[1:] != shape:
        raise ValueError(f"{name}: got samples of shape {values.shape}, wanted (samples,) or (samples, *{shape})")
    return jnp.broadcast_to(values, (len(values), *shape))
