"""Any two convex geoms: the direction that separates them most, and the two points that are nearest along it.

Every geom is a polyhedron (a point, a segment, a box, a hull) plus an ellipsoid (a disc for cylinders), plus a ball.
For a unit direction d the separation is

    s(d) = min over b of d.b - max over a of d.a,

and the signed distance is its maximum over d. The search finds which corners of the polyhedra take part and about
which d. Then d and the points follow from those corners: in closed form for polyhedra, by Newton's method where there
is an ellipsoid, with derivatives of the last step alone, which are those of the solution.
"""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import Array, lax

from jaxgrasp.arrays import safe_divide
from jaxgrasp.geometry.pairs.geom import Body, Point
from jaxgrasp.geometry.pairs.search import Simplex, search, supports
from jaxgrasp.geometry.pairs.supports import is_smooth, radius, roundness
from jaxgrasp.geometry.pairs.vectors import (
    Rotation,
    Vector,
    choose,
    cross,
    dot,
    each,
    least_along,
    pick,
    root,
    rotate,
    unit,
    unrotate,
    zeros,
)
from jaxgrasp.lanes.fence import fenced

# Newton's steps without derivatives before the one with.
_STEPS = 5
# Below this, weights of corners, sines of angles between edges and those of tilted caps count as zero.
_TOLERANCE = {jnp.dtype("float64"): 1e-6, jnp.dtype("float32"): 2e-3}


def convex(kind_a: str, kind_b: str) -> Callable[[Body, Body], list[Point]]:
    """Touches of two convex geoms of the given kinds, one point."""

    def touch(a: Body, b: Body) -> list[Point]:
        return [nearest(kind_a, kind_b, a, b, jnp.ones(a.position.x.shape, bool))]

    return touch


def nearest(kind_a: str, kind_b: str, a: Body, b: Body, wanted: Array) -> Point:
    """The point of two convex geoms; of lanes that are not wanted a meaningless one."""
    direction, simplex = search(kind_a, kind_b, lax.stop_gradient(a), lax.stop_gradient(b), wanted)
    solved = _solve(kind_a, kind_b, a, b, direction, simplex)
    # Corners that the search took for others give a direction along which the geoms are not as far apart as it says.
    found, true = (_along(kind_a, kind_b, a, b, lax.stop_gradient(d)) for d in (direction, solved.normal))
    limit = _TOLERANCE[direction.x.dtype] * (jnp.abs(found.distance) + 1e-3)
    sound = (jnp.abs(true.distance - solved.distance) <= limit) & (true.distance >= found.distance - limit)
    return choose(sound, solved, found)


def _along(kind_a: str, kind_b: str, a: Body, b: Body, d: Vector) -> Point:
    """The point of the farthest corners along a fixed direction."""
    between = supports(kind_a, kind_b, a, b, d)
    own_a, own_b = radius(kind_a, a), radius(kind_b, b)
    separation = dot(d, between.point)
    point = a.position + between.of_a + d * (0.5 * (separation + own_a - own_b))
    return Point(point, d, separation - own_a - own_b)


class _Side(NamedTuple):
    """What of a geom takes part: a corner, edges from it, and the ellipsoid of the given axes."""

    corner: Vector  # common frame
    edges: list[Vector]  # zero where there is none
    rotation: Rotation
    axes: Vector | None

    def spread(self, d: Vector) -> Vector:
        """The ellipsoid's matrix times d."""
        assert self.axes is not None
        return rotate(self.rotation, each(lambda s, x: s * s * x, self.axes, unrotate(self.rotation, d)))


_Sides = tuple[_Side, _Side]


def _solve(kind_a: str, kind_b: str, a: Body, b: Body, direction: Vector, simplex: Simplex) -> Point:
    sides = (
        _side(kind_a, a, [corner.a for corner in simplex.corners], simplex.weights, direction),
        _side(kind_b, b, [corner.b for corner in simplex.corners], simplex.weights, direction),
    )
    between = sides[1].corner - sides[0].corner
    first, second, owners = fenced(_independent)(sides)
    fixed = dot(second, second) > 0
    normal = unit(cross(first, second))
    flat = choose(dot(normal, direction) < 0, -normal, normal)
    if is_smooth(kind_a) or is_smooth(kind_b):
        held = jax.tree.map(lax.stop_gradient, (between, first, sides))
        d = lax.fori_loop(0, _STEPS, lambda _, d: _newton(d, *held), direction)
        free = fenced(_newton)(d, between, first, sides)
    else:
        free = _straight(between, first, direction)
    d = choose(fixed, flat, free)
    apart = between - _bulge(sides[0], d) - _bulge(sides[1], d)
    separation = dot(d, apart)
    # a's point and b's are corner + edges + ellipsoid's point; their difference is separation times d.
    shift = fenced(_along_edges)(d * separation - apart, first, second, owners)
    own_a, own_b = radius(kind_a, a), radius(kind_b, b)
    point = sides[0].corner + _bulge(sides[0], d) - shift
    return Point(point + d * (0.5 * (separation + own_a - own_b)), d, separation - own_a - own_b)


def _side(kind: str, body: Body, corners: list[Vector], weights: tuple[Array, ...], direction: Vector) -> _Side:
    """`corners` are local, `weights` what they weigh in the nearest point."""
    limit = _TOLERANCE[direction.x.dtype]
    zero = zeros(direction.x)
    main, edges = corners[0], []
    if kind not in ("sphere", "ellipsoid"):
        slots = list(zip(corners, weights, strict=True))
        first = (weights[0] >= weights[1]) & (weights[0] >= weights[2])
        last = ~first & (weights[2] > weights[1])
        main = choose(first, corners[0], choose(last, corners[2], corners[1]))
        for corner, weight in (choose(first, slots[1], slots[0]), choose(last, slots[1], slots[2])):
            edges.append(rotate(body.rotation, choose(weight > limit, corner - main, zero)))
    axes = roundness(kind, body)
    if kind == "cylinder":
        # On a cap every direction within it is an edge.
        local = unrotate(jax.tree.map(lax.stop_gradient, body.rotation), direction)
        cap = local.x**2 + local.y**2 < limit**2
        edges += [choose(cap, body.rotation[k] * body.size[0], zero) for k in range(2)]
        axes = choose(cap, zero, axes)
    return _Side(body.position + rotate(body.rotation, main), edges, body.rotation, axes)


def _independent(sides: _Sides) -> tuple[Vector, Vector, tuple[Array, Array]]:
    """Two edges that the direction is normal to, zero where there are none, and whether they are a's."""
    edges, like = [*sides[0].edges, *sides[1].edges], sides[0].corner.x

    def best(score: Callable[[Vector], Array], least: float) -> tuple[Vector, Array]:
        top, number = jnp.full_like(like, least), jnp.zeros(like.shape, jnp.int32)
        for i, edge in enumerate(edges, 1):
            value = lax.stop_gradient(score(edge))
            number = jnp.where(value > top, i, number)
            top = jnp.maximum(value, top)
        chosen = pick([zeros(like), *edges], number)
        return chosen, (number > 0) & (number <= len(sides[0].edges))

    def sine(edge: Vector) -> Array:
        across = cross(along, edge)
        return safe_divide(dot(across, across), dot(edge, edge))

    first, first_own = best(lambda edge: dot(edge, edge), 0.0)
    along = unit(first)
    second, second_own = best(sine, _TOLERANCE[along.x.dtype] ** 2)
    return first, second, (first_own, second_own)


def _bulge(side: _Side, d: Vector) -> Vector:
    """The ellipsoid's farthest point along d."""
    if side.axes is None:
        return zeros(d.x)
    spread = side.spread(d)
    return spread * safe_divide(jnp.ones_like(d.x), root(dot(d, spread)))


def _straight(between: Vector, edge: Vector, direction: Vector) -> Vector:
    """Between two corners, or a corner and an edge."""
    edge = unit(edge)
    d = unit(between - edge * dot(edge, between))
    return choose(dot(d, direction) < 0, -d, d)


def _newton(d: Vector, between: Vector, edge: Vector, sides: _Sides) -> Vector:
    """A step towards the largest separation among directions normal to the edge."""
    edge = unit(edge)
    d = unit(d - edge * dot(edge, d))
    free = dot(edge, edge) < 0.5
    one = unit(cross(d, choose(free, least_along(d), edge)))
    two = cross(d, one)
    apart = between - _bulge(sides[0], d) - _bulge(sides[1], d)
    s = dot(d, apart)
    bends = [_bend(sides, d, one), _bend(sides, d, two)]
    k11, k12, k22 = s + dot(one, bends[0]), dot(one, bends[1]), s + dot(two, bends[1])
    g1, g2 = dot(one, apart), dot(two, apart)
    determinant = k11 * k22 - k12 * k12
    x = jnp.where(free, safe_divide(k22 * g1 - k12 * g2, determinant), safe_divide(g1, k11))
    y = jnp.where(free, safe_divide(k11 * g2 - k12 * g1, determinant), 0)
    return unit(d + one * x + two * y)


def _bend(sides: _Sides, d: Vector, t: Vector) -> Vector:
    """How the ellipsoids' farthest points move as d moves along t."""
    total = zeros(d.x)
    for side in sides:
        if side.axes is not None:
            spread = side.spread(d)
            inverse = safe_divide(jnp.ones_like(d.x), root(dot(d, spread)))
            total = total + side.spread(t) * inverse - spread * (dot(spread, t) * inverse**3)
    return total


def _along_edges(wanted: Vector, first: Vector, second: Vector, owners: tuple[Array, Array]) -> Vector:
    """The part of `wanted`, a combination of the two edges, along those of a."""
    xx, xy, yy = dot(first, first), dot(first, second), dot(second, second)
    u, v = dot(first, wanted), dot(second, wanted)
    determinant = xx * yy - xy * xy
    x = jnp.where(yy > 0, safe_divide(u * yy - v * xy, determinant), safe_divide(u, xx))
    y = safe_divide(v * xx - u * xy, determinant)
    return first * jnp.where(owners[0], x, 0) + second * jnp.where(owners[1], y, 0)
