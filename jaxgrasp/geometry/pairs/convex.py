"""Any two convex geoms: the direction that separates them most, and the two points that are nearest along it.

Every geom is a polyhedron (a point, a segment, a box, a hull) plus an ellipsoid, possibly flat (of ellipsoids, and a disc
of cylinders), plus a ball. For a unit direction d the separation is

    s(d) = min over b of d.b - max over a of d.a,

and the signed distance is its maximum over d. The search finds which corners of the polyhedra take part and about which
d. Then d and the points follow from those corners: in closed form for polyhedra, by Newton's method where there is an
ellipsoid, with derivatives of the last step alone, which are those of the solution.
"""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import Array, lax

from jaxgrasp.arrays import safe_divide
from jaxgrasp.geometry.pairs.geom import Geom, Touch, single
from jaxgrasp.geometry.pairs.search import Simplex, search
from jaxgrasp.geometry.pairs.supports import is_smooth, radius, roundness
from jaxgrasp.geometry.pairs.vectors import choose, cross, dot, norm, rotate, times, unit, unrotate

# Newton's steps without derivatives before the one with.
_STEPS = 5


def convex(kind_a: str, kind_b: str) -> Callable[[Geom, Geom], Touch]:
    """Touches of two convex geoms of the given kinds, one point."""

    def touch(a: Geom, b: Geom) -> Touch:
        direction, simplex = search(kind_a, kind_b, *jax.tree.map(lax.stop_gradient, (a, b)))
        return _solve(kind_a, kind_b, a, b, direction, simplex)

    return touch


class _Side(NamedTuple):
    """What of a geom takes part: a corner, edges from it, and the ellipsoid with matrix rotation diag(axes^2) rotation'."""

    corner: Array  # (3, *lanes), common frame
    edges: list[Array]  # each (3, *lanes), zero where there is none
    rotation: Array
    axes: Array | None  # (3, *lanes)

    def spread(self, d: Array) -> Array:
        """The ellipsoid's matrix times d."""
        return rotate(self.rotation, self.axes * self.axes * unrotate(self.rotation, d))


def _solve(kind_a: str, kind_b: str, a: Geom, b: Geom, direction: Array, simplex: Simplex) -> Touch:
    sides = (
        _side(kind_a, a, simplex.corners_a, simplex.weights, direction),
        _side(kind_b, b, simplex.corners_b, simplex.weights, direction),
    )
    between = sides[1].corner - sides[0].corner
    first, second, owners = _independent(sides)
    fixed = norm(second) > 0
    normal = unit(cross(first, second))
    flat = choose(dot(normal, direction) < 0, -normal, normal)
    d = choose(fixed, lax.stop_gradient(flat), direction)
    if is_smooth(kind_a) or is_smooth(kind_b):
        held = jax.tree.map(lax.stop_gradient, (between, first, sides))
        d = lax.fori_loop(0, _STEPS, lambda _, d: _newton(d, *held), d)
    d = choose(fixed, flat, _newton(d, between, first, sides))
    apart = between - _offset(sides, d)
    separation = dot(d, apart)
    # a's point and b's are corner + edges + ellipsoid's point; their difference is separation times d.
    shift = _along_edges(times(separation, d) - apart, first, second, owners)
    own_a, own_b = radius(kind_a, a), radius(kind_b, b)
    point = sides[0].corner + _bulge(sides[0], d) - shift
    middle = point + times(0.5 * (separation + own_a - own_b), d)
    return single(middle, d, separation - own_a - own_b)


def _side(kind: str, geom: Geom, corners: Array, weights: Array, direction: Array) -> _Side:
    """`corners` (3, 3, *lanes) are local, `weights` (3, *lanes) what they weigh in the nearest point."""
    heavy = (weights[0] >= weights[1]) & (weights[0] >= weights[2])
    middle = weights[1] >= weights[2]
    main = choose(heavy, corners[0], choose(middle, corners[1], corners[2]))
    taking = weights > _tolerance(weights.dtype)
    edges = [rotate(geom.rotation, choose(taking[i], corners[i] - main, 0)) for i in range(3)]
    axes = roundness(kind, geom)
    if kind == "cylinder":
        # On a cap every direction within it is an edge.
        local = unrotate(lax.stop_gradient(geom.rotation), direction)
        cap = local[0] ** 2 + local[1] ** 2 < _tolerance(weights.dtype) ** 2
        edges += [choose(cap, times(geom.size[0], geom.rotation[:, k]), 0) for k in range(2)]
        axes = choose(~cap, axes, 0)
    return _Side(geom.position + rotate(geom.rotation, main), edges, geom.rotation, axes)


def _independent(sides: tuple[_Side, _Side]) -> tuple[Array, Array, tuple[Array, Array]]:
    """Two edges that the direction is normal to, zero where there are none, and whether they are a's."""
    edges = [(edge, own) for side, own in zip(sides, (True, False), strict=True) for edge in side.edges]
    shape = edges[0][0].shape[1:]

    def best(score: Callable[[Array], Array], least: float | Array) -> tuple[Array, Array]:
        chosen, whose = jnp.zeros_like(edges[0][0]), jnp.zeros(shape, bool)
        top = jnp.broadcast_to(jnp.asarray(least, chosen.dtype), shape)
        for edge, own in edges:
            value = lax.stop_gradient(score(edge))
            better = value > top
            top = jnp.where(better, value, top)
            chosen, whose = choose(better, edge, chosen), jnp.where(better, own, whose)
        return chosen, whose

    first, first_own = best(lambda edge: dot(edge, edge), 0.0)
    along = unit(first)
    limit = _tolerance(first.dtype) ** 2
    second, second_own = best(lambda edge: safe_divide(norm(cross(along, edge)) ** 2, dot(edge, edge)), limit)
    return first, second, (first_own, second_own)


def _bulge(side: _Side, d: Array) -> Array:
    """The ellipsoid's farthest point along d."""
    if side.axes is None:
        return jnp.zeros_like(d)
    spread = side.spread(d)
    return safe_divide(spread, jnp.broadcast_to(_root(dot(d, spread))[None], d.shape))


def _offset(sides: tuple[_Side, _Side], d: Array) -> Array:
    """What the ellipsoids take from the difference of the corners."""
    return _bulge(sides[0], d) + _bulge(sides[1], d)


def _newton(d: Array, between: Array, edge: Array, sides: tuple[_Side, _Side]) -> Array:
    """A step towards the largest separation among directions normal to the edge."""
    edge = unit(edge)
    d = unit(d - times(dot(edge, d), edge))
    free = dot(edge, edge) < 0.5
    across = cross(d, choose(free, _least(d), edge))
    one = unit(across)
    two = cross(d, one)
    apart = between - _offset(sides, d)
    s = dot(d, apart)
    bends = [_bend(sides, d, one), _bend(sides, d, two)]
    k11, k12, k22 = s + dot(one, bends[0]), dot(one, bends[1]), s + dot(two, bends[1])
    g1, g2 = dot(one, apart), dot(two, apart)
    determinant = k11 * k22 - k12 * k12
    x = jnp.where(free, safe_divide(k22 * g1 - k12 * g2, determinant), safe_divide(g1, k11))
    y = jnp.where(free, safe_divide(k11 * g2 - k12 * g1, determinant), 0)
    return unit(d + times(x, one) + times(y, two))


def _bend(sides: tuple[_Side, _Side], d: Array, t: Array) -> Array:
    """How the ellipsoids' farthest points move as d moves along t."""
    total = jnp.zeros_like(d)
    for side in sides:
        if side.axes is not None:
            spread, moved = side.spread(d), side.spread(t)
            size = _root(dot(d, spread))
            wide = jnp.broadcast_to(size[None], d.shape)
            total = total + safe_divide(moved, wide) - safe_divide(times(dot(spread, t), spread), wide**3)
    return total


def _along_edges(wanted: Array, first: Array, second: Array, owners: tuple[Array, Array]) -> Array:
    """The part of `wanted`, a combination of the two edges, along those of a; (3, *lanes)."""
    xx, xy, yy = dot(first, first), dot(first, second), dot(second, second)
    u, v = dot(first, wanted), dot(second, wanted)
    both = yy > 0
    determinant = xx * yy - xy * xy
    x = jnp.where(both, safe_divide(u * yy - v * xy, determinant), safe_divide(u, xx))
    y = safe_divide(v * xx - u * xy, determinant)
    return times(jnp.where(owners[0], x, 0), first) + times(jnp.where(owners[1], y, 0), second)


def _least(d: Array) -> Array:
    """The axis that d is least along."""
    x, y, z = jnp.abs(d)
    is_x = (x <= y) & (x <= z)
    is_y = ~is_x & (y <= z)
    return jnp.stack([is_x, is_y, ~is_x & ~is_y]).astype(d.dtype)


def _root(x: Array) -> Array:
    """Square root with gradient 0 at 0."""
    positive = x > 0
    return jnp.where(positive, jnp.sqrt(jnp.where(positive, x, 1)), 0)


def _tolerance(dtype: jnp.dtype) -> float:
    """Below this, weights of corners, sines of angles between edges and those of tilted caps count as zero."""
    return 1e-6 if dtype == jnp.float64 else 2e-3
