"""Symmetric positive definite matrices of three rows, one for each block, spelt out; anything trails."""

import jax
import jax.numpy as jnp
from jax import lax


def cholesky(entries: list[jax.Array]) -> list[jax.Array]:
    """1/L00, L10, 1/L11, L20, L21, 1/L22 of a 3x3 matrix given by 00, 10, 11, 20, 21, 22; pivots are clamped."""
    a00, a10, a11, a20, a21, a22 = entries
    eps = jnp.finfo(a00.dtype).eps
    pivot = lambda value, diagonal: lax.rsqrt(jnp.maximum(value, eps * diagonal))
    i0 = pivot(a00, a00)
    l10, l20 = a10 * i0, a20 * i0
    i1 = pivot(a11 - l10 * l10, a11)
    l21 = (a21 - l20 * l10) * i1
    return [i0, l10, i1, l20, l21, pivot(a22 - l20 * l20 - l21 * l21, a22)]


def down(lower: list[jax.Array], rhs: jax.Array) -> jax.Array:
    """L^-1 rhs, (3, ..., n, *lanes)."""
    i0, l10, i1, l20, l21, i2 = lower
    a = rhs[0] * i0
    b = (rhs[1] - l10 * a) * i1
    return jnp.stack([a, b, (rhs[2] - l20 * a - l21 * b) * i2])


def back(lower: list[jax.Array], rhs: jax.Array) -> jax.Array:
    """(L L')^-1 rhs, (3, n, *lanes)."""
    i0, l10, i1, l20, l21, i2 = lower
    a, b, c = down(lower, rhs)
    c = c * i2
    b = (b - l21 * c) * i1
    return jnp.stack([(a - l10 * b - l20 * c) * i0, b, c])
