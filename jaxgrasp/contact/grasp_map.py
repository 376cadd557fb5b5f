"""The grasp map (5) and the wrench that the grasp must supply, (2)-(3)."""

import functools
from collections.abc import Sequence

import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Array, Float

from jaxgrasp.arrays import as_float, broadcast_batch
from jaxgrasp.compiling import own_settings
from jaxgrasp.contact.contacts import Contacts


def grasp_columns(positions: jax.Array, frames: jax.Array, arms: jax.Array | None = None) -> jax.Array:
    """The blocks [R_i; p_i x R_i] of G, components leading; for soft contacts with a column [0; arm n].

    Args:
        positions: (3, ...), m.
        frames: (3, 3, ...), columns t1, t2, n.
        arms: (...), m: moments about the normals per newton of the fourth component; None for hard contacts.

    Returns:
        (6, 3, ...), (6, 4, ...) for soft contacts.
    """
    moments = jnp.stack([jnp.stack(_cross(positions, frames[:, a])) for a in range(3)], 1)
    columns = jnp.concatenate([frames, moments], 0)
    if arms is None:
        return columns
    torsion = jnp.concatenate([jnp.zeros_like(frames[:, 2]), arms * frames[:, 2]])
    return jnp.concatenate([columns, torsion[:, None]], 1)


@own_settings()
def grasp_map(contacts: Contacts) -> Float[Array, "*batch 6 vars"]:
    """G (5): the wrench about the centre of mass is G f for contact forces f in contact frames.

    Args:
        contacts: the grasps; the columns of absent contacts are zero.

    Returns:
        (*batch, 6, 3 n_c); rows force (N), moment (N m), object frame. With torsional friction (*batch, 6, 4 n_c): each
        contact has a fourth column, for its moment about the normal in N m; zero where the coefficient is.
    """
    positions = jnp.moveaxis(contacts.positions, -1, 0)
    frames = jnp.moveaxis(contacts.frames, (-2, -1), (0, 1))
    torsional = contacts.torsional_friction
    soft = None if torsional is None else (torsional > 0).astype(positions.dtype)
    blocks = jnp.where(contacts.active, grasp_columns(positions, frames, soft), 0)
    blocks = jnp.moveaxis(blocks, (0, 1), (-3, -1))
    return blocks.reshape(*contacts.batch_shape, 6, contacts.components * contacts.n_c)


@own_settings()
def required_wrench(
    mass: ArrayLike,
    gravity: ArrayLike | Sequence[float] = (0.0, 0.0, -9.81),
    inertia: ArrayLike | None = None,
    twist: ArrayLike | None = None,
    acceleration: ArrayLike | None = None,
) -> Float[Array, "*batch 6"]:
    """The wrench that the fingers must supply: b = M (dV/dt - g) + N V, from the equation of motion (2).

    With the twist V = (v, w) of the centre of mass in the object frame, N V = (m w x v, w x I w) (3). Known external
    wrenches are subtracted from the result by the caller.

    Args:
        mass: (*batch,), kg.
        gravity: (*batch, 3), m/s^2, in the object frame.
        inertia: (*batch, 3, 3), kg m^2, about the centre of mass; needed where the object turns.
        twist: (*batch, 6), linear m/s and angular rad/s velocity, object frame; None is rest.
        acceleration: (*batch, 6), the componentwise d(twist)/dt in the object frame; None is zero.

    Returns:
        (*batch, 6), force (N) and moment (N m).

    Raises:
        ValueError: shapes that do not fit, or a motion without inertia.
    """
    if inertia is None and (twist is not None or acceleration is not None):
        raise ValueError("inertia: got None, wanted (*batch, 3, 3) because twist or acceleration is given")
    # Arrays say in which precision, numbers and lists adapt.
    given = [getattr(x, "dtype", int) for x in (mass, gravity, inertia, twist, acceleration)]
    given = [dtype for dtype in given if jnp.issubdtype(dtype, jnp.floating)]
    dtype = functools.reduce(jnp.promote_types, given) if given else jnp.result_type(float)
    array = lambda name, x, event: as_float(name, np.zeros(event) if x is None else x, event).astype(dtype)
    m = array("mass", mass, ())
    g = array("gravity", gravity, (3,))
    body = array("inertia", inertia, (3, 3))
    velocity = array("twist", twist, (6,))
    rate = array("acceleration", acceleration, (6,))
    batch = broadcast_batch(
        mass=m.shape,
        gravity=g.shape[:-1],
        inertia=body.shape[:-2],
        twist=velocity.shape[:-1],
        acceleration=rate.shape[:-1],
    )
    v, w = velocity[..., :3], velocity[..., 3:]
    turn = lambda x: jnp.einsum("...ij,...j->...i", body, x)
    force = m[..., None] * (rate[..., :3] - g + jnp.cross(w, v))
    moment = turn(rate[..., 3:]) + jnp.cross(w, turn(w))
    return jnp.concatenate([jnp.broadcast_to(force, (*batch, 3)), jnp.broadcast_to(moment, (*batch, 3))], -1)


def _cross(a: jax.Array, b: jax.Array) -> list[jax.Array]:
    return [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]]
