"""Which corners of two convex geoms are nearest, and the direction between them (no derivatives).

Apart, this is the distance algorithm of Gilbert, Johnson and Keerthi. Inside each other, b is first moved out along the
current direction, by a little more than the separation lacks, and the direction between the two then is the next one:
maximising s(d) + t d.d_k for a t > -s(d_k) never lowers s, so that s climbs to a maximum.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import Array, lax

from jaxgrasp.arrays import safe_divide
from jaxgrasp.geometry.pairs.geom import Geom
from jaxgrasp.geometry.pairs.supports import bulge, corner, is_smooth
from jaxgrasp.geometry.pairs.vectors import choose, cross, dot, norm, rotate, times, unit, unrotate

_CLIMBS = 12
_ROUNDS = 48


class Simplex(NamedTuple):
    """Up to three points of the set of all b - a, the nearest to the origin among their combinations."""

    points: Array  # (3, 3, *lanes), slot first, common frame
    corners_a: Array  # (3, 3, *lanes), the polyhedra's corners that they belong to, each in its geom's frame
    corners_b: Array
    weights: Array  # (3, *lanes), zero where a slot is empty


def search(kind_a: str, kind_b: str, a: Geom, b: Geom) -> tuple[Array, Simplex]:
    """The direction (3, *lanes) from a to b along which they are farthest apart, and the corners that are nearest."""
    sized = 1e-2 if is_smooth(kind_a) or is_smooth(kind_b) else 1e-4
    start = b.position - a.position
    length = norm(start)
    z = jnp.stack([jnp.zeros_like(length), jnp.zeros_like(length), jnp.ones_like(length)])
    d = choose(length > 0, unit(start), z)

    def support(d: Array, shift: Array) -> tuple[Array, Array, Array]:
        return _support(kind_a, kind_b, a, b, d, shift)

    def body(state: tuple) -> tuple:
        count, d, best, simplex, done = state
        here = dot(d, support(d, jnp.zeros_like(d))[0])
        out = jnp.maximum(-here, 0)
        moved = times(jnp.where(here > 0, 0, out + sized * (out + 0.01)), d)
        found = _nearest(support, d, moved)
        toward = unit(_combined(found))
        toward = choose(dot(toward, toward) > 0.5, toward, d)
        after = dot(toward, support(toward, jnp.zeros_like(d))[0])
        better = ~done & (after >= here)
        d = choose(better, toward, d)
        simplex = jax.tree.map(lambda new, old: _choose(better | (count == 0), new, old), found, simplex)
        done = done | (here > 0) | (after - here <= 1e-9 * (jnp.abs(here) + 1e-6))
        return count + 1, d, after, simplex, done

    empty = jnp.zeros((3, *d.shape), d.dtype)
    simplex = Simplex(empty, empty, empty, jnp.zeros_like(d))
    state = (0, d, jnp.zeros_like(length), simplex, jnp.zeros(length.shape, bool))
    state = lax.while_loop(lambda state: (state[0] < _CLIMBS) & ~jnp.all(state[4]), body, state)
    return state[1], state[3]


def _support(kind_a: str, kind_b: str, a: Geom, b: Geom, d: Array, shift: Array) -> tuple[Array, Array, Array]:
    """The least of b + shift - a along d, and the corners it belongs to."""
    toward_a, toward_b = unrotate(a.rotation, d), unrotate(b.rotation, -d)
    corner_a, corner_b = corner(kind_a, a, toward_a), corner(kind_b, b, toward_b)
    point_a = rotate(a.rotation, corner_a + bulge(kind_a, a, toward_a))
    point_b = rotate(b.rotation, corner_b + bulge(kind_b, b, toward_b))
    return b.position - a.position + shift + point_b - point_a, corner_a, corner_b


def _choose(condition: Array, a: Array, b: Array) -> Array:
    """Lane by lane, whatever axes lead."""
    return jnp.where(condition.reshape((1,) * (a.ndim - condition.ndim) + condition.shape), a, b)


def _combined(simplex: Simplex) -> Array:
    return sum(times(simplex.weights[i], simplex.points[i]) for i in range(3))


def _nearest(support, d: Array, shift: Array) -> Simplex:
    """The simplex that holds the point of b + shift - a nearest to the origin, which must be outside."""
    point, corner_a, corner_b = support(d, shift)
    zero = jnp.zeros_like(point)
    start = Simplex(
        jnp.stack([point, zero, zero]),
        jnp.stack([corner_a, zero, zero]),
        jnp.stack([corner_b, zero, zero]),
        jnp.stack([jnp.ones_like(d[0]), zero[0], zero[0]]),
    )
    small = 1e-10 if d.dtype == jnp.float64 else 1e-5

    def body(state: tuple) -> tuple:
        count, simplex, done = state
        nearest = _combined(simplex)
        squared = dot(nearest, nearest)
        new = support(unit(nearest), shift)
        done = done | (squared - dot(nearest, new[0]) <= small * squared)
        reduced, closer = _reduce(simplex, new, squared)
        simplex = jax.tree.map(lambda old, new: _choose(done, old, new), simplex, reduced)
        return count + 1, simplex, done | ~closer

    state = (0, start, jnp.zeros(d.shape[1:], bool))
    return lax.while_loop(lambda state: (state[0] < _ROUNDS) & ~jnp.all(state[2]), body, state)[1]


def _reduce(simplex: Simplex, new: tuple[Array, Array, Array], squared: Array) -> tuple[Simplex, Array]:
    """The nearest among the corners, edges and faces that the new point makes with the old ones."""
    old, point = simplex.points, new[0]
    present = simplex.weights > 0
    one, zero = jnp.ones_like(squared), jnp.zeros_like(squared)
    best, weights, place = dot(point, point), [one, zero, zero], jnp.zeros(squared.shape, jnp.int32)

    def offer(value: Array, allowed: Array, shares: list[Array], slot: int) -> None:
        nonlocal best, weights, place
        better = allowed & (value < best)
        best = jnp.where(better, value, best)
        weights = [jnp.where(better, share, weight) for share, weight in zip(shares, weights, strict=True)]
        place = jnp.where(better, slot, place)

    edges = [old[i] - point for i in range(3)]
    for i in range(3):
        share = safe_divide(-dot(point, edges[i]), dot(edges[i], edges[i]))
        foot = point + times(share, edges[i])
        shares = [zero, zero, zero]
        shares[i], shares[(i + 1) % 3] = share, 1 - share
        offer(dot(foot, foot), present[i] & (share > 0) & (share < 1), shares, (i + 1) % 3)
    for i, j, slot in ((0, 1, 2), (0, 2, 1), (1, 2, 0)):
        normal = cross(edges[i], edges[j])
        flat = dot(normal, normal)
        share_i = safe_divide(-dot(cross(point, edges[j]), normal), flat)
        share_j = safe_divide(-dot(cross(edges[i], point), normal), flat)
        shares = [zero, zero, zero]
        shares[i], shares[j], shares[slot] = share_i, share_j, 1 - share_i - share_j
        inside = present[i] & present[j] & (flat > 0) & (share_i > 0) & (share_j > 0) & (share_i + share_j < 1)
        offer(safe_divide(dot(normal, point) ** 2, flat), inside, shares, slot)

    def placed(old: Array, new: Array) -> Array:
        return jnp.stack([choose(place == i, new, old[i]) for i in range(3)])

    reduced = Simplex(
        placed(old, point), placed(simplex.corners_a, new[1]), placed(simplex.corners_b, new[2]), jnp.stack(weights)
    )
    return reduced, best < squared
