"""Shape vocabulary, gradient-safe elementary functions, and frames from normals.

Shapes are written batch first: `*batch` is any number of leading axes. Inside kernels the batch is one trailing axis,
"lanes".
"""

from collections.abc import Callable, Iterable, Sequence
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike

from jaxgrasp import process
from jaxgrasp.compiling import by_size, compiled


def as_float(name: str, value: ArrayLike | Sequence[float], event: tuple[int | str, ...]) -> jax.Array:
    """Convert to an array in JAX's floating precision and check that its trailing axes are `event`.

    Args:
        name: the argument's name, for the error.
        value: the caller's argument.
        event: the trailing shape that is wanted; a string stands for any size.

    Raises:
        ValueError: the value has no real numbers, or another trailing shape.
    """
    process.check()
    try:
        array = placed(value)
    except TypeError:
        raise ValueError(f"{name}: got {type(value).__name__}, wanted an array of real numbers") from None
    if jnp.issubdtype(array.dtype, jnp.complexfloating) or array.dtype == object:
        raise ValueError(f"{name}: got dtype {array.dtype}, wanted real numbers")
    if not jnp.issubdtype(array.dtype, jnp.floating):
        array = array.astype(jnp.result_type(float))
    got = array.shape[len(array.shape) - len(event) :] if array.ndim >= len(event) else None
    if got is None or any(isinstance(want, int) and want != have for want, have in zip(event, got, strict=True)):
        wanted = ", ".join(["*batch", *map(str, event)])
        raise ValueError(f"{name}: got shape {array.shape}, wanted ({wanted})")
    return array


def placed(value: ArrayLike | Sequence[float]) -> jax.Array:
    """Convert to an array of JAX as `jnp.asarray` does, but compile nothing.

    `jnp.asarray` compiles a program for every shape of a NumPy array.
    """
    if type(value) is np.ndarray and jax.sharding.get_abstract_mesh().empty:
        return jax.device_put(value)
    return jnp.asarray(value)


def literal(values: np.ndarray, dtype: jnp.dtype) -> jax.Array:
    """Write a small constant array into the program, entry by entry.

    JAX would hand a NumPy array to the compiled program as one more argument.
    """
    if values.ndim == 0:
        return jnp.full((), float(values), dtype)
    return jnp.stack([literal(v, dtype) for v in values])


def broadcast_batch(**batches: tuple[int, ...]) -> tuple[int, ...]:
    """Find the common batch shape of several arguments.

    Raises:
        ValueError: the shapes do not broadcast; the message names each argument.
    """
    try:
        return jnp.broadcast_shapes(*batches.values())
    except ValueError:
        listed = ", ".join(f"{name} {shape}" for name, shape in batches.items())
        raise ValueError(
            f"batch shapes do not broadcast: got {listed}; wanted leading axes that agree or are 1"
        ) from None


def safe_divide(numerator: jax.Array, denominator: jax.Array) -> jax.Array:
    """Divide, with quotient 0 and gradient 0 where the denominator is 0."""
    positive = denominator != 0
    # The inner where keeps the division finite: else the gradient of the branch not taken would be NaN.
    return jnp.where(positive, numerator / jnp.where(positive, denominator, 1), 0)


def safe_norm(x: jax.Array, axis: int = -1) -> jax.Array:
    """Compute the Euclidean norm, with gradient 0 at 0."""
    # Not a reduction: XLA's CPU backend hands large ones to a library, which a tile cannot call.
    squares = fold(jnp.add, jnp.moveaxis(x * x, axis, 0))
    positive = squares > 0
    return jnp.where(positive, jnp.sqrt(jnp.where(positive, squares, 1)), 0)


@partial(compiled, pace=by_size)
def frames_from_normals(normals: jax.Array) -> jax.Array:
    """Make contact frames (t1, t2, n): the x and y axes turned by the smallest rotation that takes z to n.

    Within 45 degrees of -z, where that rule ends in a direction from which rounding would choose, the tangents turn
    about n besides, and are (-x, y) at n = -z. No field of tangents is continuous on the whole sphere. This one is
    twice differentiable but at two directions that no common solid has as a normal: 25.8 degrees from -z, n =
    (-0.0871, +-0.4267, -0.9002); there it is the smallest rotation that takes -z to n, of (-x, y).

    Margins of coarse friction pyramids depend on the tangents, so take more edges or give frames of your own where
    these matter.

    Args:
        normals: (*batch, 3), any positive length.

    Returns:
        (*batch, 3, 3), columns t1, t2, n; NaN for a normal that is zero or not finite.
    """
    largest = jnp.max(jnp.abs(normals), -1, keepdims=True)
    usable = (largest > 0) & jnp.isfinite(largest)
    # Unusable normals become z here and NaN only at the end: derivatives would carry NaN to every lane.
    safe = jnp.where(usable, normals, jnp.array([0, 0, 1], normals.dtype))
    # Dividing by the largest entry first keeps tiny and huge normals from under- and overflowing.
    scaled = safe / jax.lax.stop_gradient(jnp.where(usable, largest, 1))
    n = scaled / safe_norm(scaled)[..., None]
    x, y, z = n[..., 0], n[..., 1], n[..., 2]
    # The smallest rotation, of (x, y) from z or of (-x, y) from -z.
    sign = jnp.where(-z > _LOW, -1, 1)
    along_x, along_y = x / (1 + sign * z), y / (1 + sign * z)
    t1 = jnp.stack([sign * (1 - x * along_x), -sign * x * along_y, -x], -1)
    t2 = jnp.stack([-x * along_y, 1 - y * along_y, -sign * y], -1)
    cosine, sine = (value[..., None] for value in _turn_near_minus_z(x, y, z))
    frames = jnp.stack([cosine * t1 - sine * t2, sine * t1 + cosine * t2, n], -1)
    return jnp.where(usable[..., None], frames, jnp.nan)


# Normals with -z above this are less than 45 degrees from -z.
_LOW = 0.5**0.5


@jax.custom_jvp
def _turn_near_minus_z(x: jax.Array, y: jax.Array, z: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Cosine and sine of the angle between the tangents and the smallest rotation from -z; 1 and 0 away from -z.

    With w = x + i y the smallest rotation from z is that from -z turned by the argument of w^2, which goes around twice
    about -z. The angle is the argument of u + i v = w^2 + 0.32 h w + 0.64 h^2, where h rises from 0 at 45 degrees from
    -z, with two derivatives, to 2 at -z: the zero at w = 0 becomes two, where w / h = -0.16 +- 0.784 i. The tangents
    hardly turn at -z.
    """
    h = _rise(z)[0]
    u, v = x * x - y * y + 0.32 * h * x + 0.64 * h * h, y * (2 * x + 0.32 * h)
    square = u * u + v * v
    turned = (-z > _LOW) & (square > 0)
    scale = 1 / jnp.sqrt(jnp.where(turned, square, 1))
    return jnp.where(turned, u * scale, 1), jnp.where(turned, v * scale, 0)


# JAX's own takes twice as long: the angle varies by (u dv - v du) / (u^2 + v^2), and cosine and sine by it.
@_turn_near_minus_z.defjvp
def _turn_near_minus_z_jvp(primals: tuple, tangents: tuple) -> tuple[tuple, tuple]:
    x, y, z = primals
    h, slope = _rise(z)
    cosine, sine = _turn_near_minus_z(x, y, z)
    u, v = x * x - y * y + 0.32 * h * x + 0.64 * h * h, y * (2 * x + 0.32 * h)
    square = u * u + v * v
    turned = (-z > _LOW) & (square > 0)
    inverse = jnp.where(turned, 1 / jnp.where(turned, square, 1), 0)
    along = 2 * x + 0.32 * h
    by_x, by_y = inverse * (2 * u * y - v * along), inverse * (u * along + 2 * v * y)
    by_z = inverse * slope * (0.32 * u * y - v * (0.32 * x + 1.28 * h))
    angle = by_x * tangents[0] + by_y * tangents[1] + by_z * tangents[2]
    return (cosine, sine), (-sine * angle, cosine * angle)


def _rise(z: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Compute a function of z that is 0 above -`_LOW` and 2 at -1, twice differentiable, and its derivative."""
    share = jnp.clip((-z - _LOW) / (1 - _LOW), 0, 1)
    slope = jnp.where(share > 0, -3 * share**2 * (1 - z) / (1 - _LOW) - share**3, 0)
    return share**3 * (1 - z), slope


def fold(op: Callable[[jax.Array, jax.Array], jax.Array], parts: Iterable[jax.Array]) -> jax.Array:
    """Combine arrays, or the entries along a leading axis, with a binary operation, pairwise.

    This unrolls the reduction, so that XLA's CPU code for it runs along the trailing lanes, in full vectors.
    """
    parts = list(parts)
    while len(parts) > 1:
        parts = [op(*parts[i : i + 2]) if i + 1 < len(parts) else parts[i] for i in range(0, len(parts), 2)]
    return parts[0]


def fold_last(op: Callable[[jax.Array, jax.Array], jax.Array], x: jax.Array, axes: int = 1) -> jax.Array:
    """Apply `fold` along the last axes of x, which are short: XLA's CPU backend fuses it with its surroundings."""
    for _ in range(axes):
        x = fold(op, [x[..., k] for k in range(x.shape[-1])])
    return x
