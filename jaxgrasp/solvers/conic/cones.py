"""Orthants and second-order cones, as the algebra that interior-point methods ask of them.

Points of many cones are arrays (d, ..., *lanes). For orthants every entry is a cone of its own; for second-order cones
{s_0 >= |(s_1, .., s_d-1)|} every place behind the leading axis is one. All operations run along the lanes.

Scaling is Nesterov's and Todd's: the symmetric W with W^-1 s = W z = lambda. Determinants of second-order cones are
products (s_0 - |s_1|)(s_0 + |s_1|), which do not cancel near the boundary.

Source: Vandenberghe (2010), "The CVXOPT linear and quadratic cone program solvers".
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp

from jaxgrasp.arrays import fold


class Scaling(NamedTuple):
    """The scaling W at a pair (s, z) of points of one kind of cone.

    point: (d, ..., *lanes), sqrt(s / z) for orthants; for second-order cones the unit-determinant w of
        W = size (2 w w' - J)^(1/2).
    size: (..., *lanes), of second-order cones; None for orthants.
    value: (d, ..., *lanes), lambda.
    root: (..., *lanes), square root of lambda's determinant; None for orthants.
    """

    point: jax.Array
    size: jax.Array | None
    value: jax.Array
    root: jax.Array | None


def scaling(second_order: bool, s: jax.Array, z: jax.Array) -> Scaling:
    """Compute Nesterov's and Todd's scaling of interior points s and z."""
    if not second_order:
        return Scaling(jnp.sqrt(s / z), None, jnp.sqrt(s * z), None)
    root_s, root_z = jnp.sqrt(_determinant(s)), jnp.sqrt(_determinant(z))
    unit_s, unit_z = s / root_s, z / root_z
    gamma = jnp.sqrt(0.5 * (1 + fold(jnp.add, unit_s * unit_z)))
    point = (unit_s + reflect(unit_z)) / (2 * gamma)
    # Put w back on the hyperboloid w_0^2 - |w_1|^2 = 1, which rounding leaves.
    point = jnp.concatenate([jnp.sqrt(1 + fold(jnp.add, point[1:] ** 2))[None], point[1:]])
    scaled = Scaling(point, jnp.sqrt(root_s / root_z), s, None)
    return scaled._replace(value=stretch(scaled, z), root=jnp.sqrt(root_s * root_z))


def stretch(w: Scaling, v: jax.Array) -> jax.Array:
    """Compute W v."""
    return w.point * v if w.size is None else w.size * _turn(w.point, v)


def shrink(w: Scaling, v: jax.Array) -> jax.Array:
    """Compute W^-1 v."""
    return v / w.point if w.size is None else _turn(reflect(w.point), v) / w.size


def weigh(w: Scaling, v: jax.Array) -> jax.Array:
    """Compute W^-2 v."""
    if w.size is None:
        return v / (w.point * w.point)
    turned = reflect(w.point)
    return (2 * turned * fold(jnp.add, turned * v) - reflect(v)) / (w.size * w.size)


def product(second_order: bool, u: jax.Array, v: jax.Array) -> jax.Array:
    """Compute the Jordan product u o v."""
    if not second_order:
        return u * v
    return jnp.concatenate([fold(jnp.add, u * v)[None], u[0] * v[1:] + v[0] * u[1:]])


def quotient(w: Scaling, v: jax.Array) -> jax.Array:
    """Solve lambda o u = v for u."""
    if w.root is None:
        return v / w.value
    head, tail, square = w.value[0], w.value[1:], w.root * w.root
    first = (head * v[0] - fold(jnp.add, tail * v[1:])) / square
    return jnp.concatenate([first[None], (v[1:] - first * tail) / head])


def identity_like(second_order: bool, v: jax.Array) -> jax.Array:
    """Make the identity of the Jordan product, shaped like v."""
    if not second_order:
        return jnp.ones_like(v)
    return jnp.concatenate([jnp.ones_like(v[:1]), jnp.zeros_like(v[1:])])


def overshoot(w: Scaling, d: jax.Array) -> jax.Array:
    """Compute 1 / (the step along d from lambda to the boundary), at most 0 where no step reaches it.

    The leading axis has length d for orthants and 1 for second-order cones.
    """
    if w.root is None:
        return -d / w.value
    unit = w.value / w.root
    first = unit[0] * d[0] - fold(jnp.add, unit[1:] * d[1:])
    rest = d[1:] - (d[0] + first) / (unit[0] + 1) * unit[1:]
    return ((jnp.sqrt(fold(jnp.add, rest * rest)) - first) / w.root)[None]


def reflect(v: jax.Array) -> jax.Array:
    """Compute J v = (v_0, -v_1)."""
    return jnp.concatenate([v[:1], -v[1:]])


def _determinant(v: jax.Array) -> jax.Array:
    """Compute v_0^2 - |v_1|^2 as a product, which does not cancel."""
    length = jnp.sqrt(fold(jnp.add, v[1:] * v[1:]))
    # Points are interior in exact arithmetic; rounding may put them on the boundary.
    return jnp.maximum(v[0] - length, jnp.finfo(v.dtype).eps * v[0]) * (v[0] + length)


def _turn(w: jax.Array, v: jax.Array) -> jax.Array:
    """Compute (2 w w' - J)^(1/2) v for w of unit determinant."""
    inner = fold(jnp.add, w[1:] * v[1:])
    return jnp.concatenate([(w[0] * v[0] + inner)[None], v[1:] + (v[0] + inner / (1 + w[0])) * w[1:]])
