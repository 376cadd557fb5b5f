"""Two boxes: what the face of one cuts out of the other's, or where two edges cross.

The rules are MuJoCo's. Of the fifteen axes that may separate boxes, the six normals of faces and the nine products of
edges, the one with the largest separation counts. Where it is a face's, the face of the other box that looks at it
most is clipped to that face's outline, and every corner of what is left is a point. Where it is a product of edges,
the point is between these edges. Boxes that are apart get one point more: the nearest one, where that is none of
these.
"""

import jax.numpy as jnp
from jax import Array, lax

from jaxgrasp.arrays import fold, safe_divide
from jaxgrasp.geometry.pairs.convex import nearest
from jaxgrasp.geometry.pairs.geom import Body, Point
from jaxgrasp.geometry.pairs.vectors import (
    Rotation,
    Vector,
    choose,
    cross,
    dot,
    pick,
    rotate,
    unit,
    unrotate,
)
from jaxgrasp.lanes.fence import fenced

CORNERS = 8
"""An outline of four sides clipped by four sides has at most eight corners."""

# An axis between edges has to beat the faces' by this share of its own separation.
_BIAS = 1e-6
# Edges are parallel where the squared sine of their angle is below this.
_PARALLEL = 1e-16
# An edges' axis this near to the best face's (cosine) gives way to it unless it separates better by this share.
_SAME, _WORTH = 0.99, 0.05
# Boxes are apart where they are so by more than this, m; the nearest point is another where it is nearer by it.
_APART = 1e-9


def box_box(a: Body, b: Body) -> list[Point]:
    """Up to eight corners of a common outline, or one crossing of edges, and the nearest point of boxes apart."""
    apart, is_face, face, i, j = fenced(_axis)(a, b)
    outline = fenced(_outline)(a, b, face)
    crossing = fenced(_crossing)(a, b, i, j)
    first = choose(is_face, outline[0], crossing)
    # Between boxes apart, edges that end before they cross tell no distance; the nearest point does.
    first = first._replace(distance=jnp.where(~is_face & apart, jnp.inf, first.distance))
    rest = [point._replace(distance=jnp.where(is_face, point.distance, jnp.inf)) for point in outline[1:]]
    manifold = [first, *rest]
    closest = nearest("box", "box", a, b, apart)
    least = fold(jnp.minimum, [point.distance for point in manifold])
    new = apart & (closest.distance < least - _APART)
    return [*manifold, closest._replace(distance=jnp.where(new, closest.distance, jnp.inf))]


def _axis(a: Body, b: Body) -> tuple[Array, Array, Array, Array, Array]:
    """Whether the boxes are apart, whether the axis is a face's, that face (0 to 5, b's last), and the edges."""
    a, b = lax.stop_gradient((a, b))
    between = b.position - a.position
    turned = [[dot(a.rotation[i], b.rotation[j]) for j in range(3)] for i in range(3)]
    in_a, in_b = unrotate(a.rotation, between), unrotate(b.rotation, between)
    faces = []
    for i in range(3):
        reach = sum(jnp.abs(turned[i][j]) * b.size[j] for j in range(3))
        faces.append(jnp.abs(in_a[i]) - a.size[i] - reach)
    for j in range(3):
        reach = sum(jnp.abs(turned[i][j]) * a.size[i] for i in range(3))
        faces.append(jnp.abs(in_b[j]) - b.size[j] - reach)
    best, face = faces[0], jnp.zeros(between.x.shape, jnp.int32)
    for number, value in enumerate(faces[1:], 1):
        best, face = choose(value > best, (value, jnp.full_like(face, number)), (best, face))
    best_face, normal = best, pick([*a.rotation, *b.rotation], face)
    edge, aside = jnp.full_like(face, -1), jnp.zeros_like(best)
    for i in range(3):
        for j in range(3):
            value, cosine = fenced(_edge_separation)(a, b, i, j, normal)
            better = (value - _BIAS * jnp.abs(value) > best) & (value > best_face)
            best, edge, aside = choose(better, (value, jnp.full_like(edge, 3 * i + j), cosine), (best, edge, aside))
    alike = (aside > _SAME) & (best < best_face + _WORTH * jnp.abs(best_face))
    return best > _APART, (edge < 0) | alike, face, jnp.maximum(edge, 0) // 3, jnp.maximum(edge, 0) % 3


def _edge_separation(a: Body, b: Body, i: Array | int, j: Array | int, normal: Vector) -> tuple[Array, Array]:
    """Along the product of a's axis i and b's j, -inf where they are parallel; and its cosine with a normal."""
    product = cross(pick(list(a.rotation), jnp.asarray(i)), pick(list(b.rotation), jnp.asarray(j)))
    squared = dot(product, product)
    d = unit(product)
    reach = sum(jnp.abs(dot(body.rotation[k], d)) * body.size[k] for body in (a, b) for k in range(3))
    value = jnp.abs(dot(b.position - a.position, d)) - reach
    return jnp.where(squared < _PARALLEL, -jnp.inf, value), jnp.abs(dot(d, normal))


def _crossing(a: Body, b: Body, i: Array, j: Array) -> Point:
    """Between the edge of a along its axis i and that of b along its axis j which look at each other."""
    one, other = pick(list(a.rotation), i), pick(list(b.rotation), j)
    half_one, half_other = (pick([body.size[k] for k in range(3)], k) for body, k in ((a, i), (b, j)))
    axis = unit(cross(one, other))
    axis = choose(dot(axis, b.position - a.position) < 0, -axis, axis)
    start = a.position + rotate(a.rotation, _corner(a, axis, i))
    end = b.position + rotate(b.rotation, _corner(b, -axis, j))
    gap = end - start
    along, beyond, cosine = dot(one, gap), dot(other, gap), dot(one, other)
    s = safe_divide(along - cosine * beyond, 1 - cosine * cosine)
    s = jnp.clip(s, -half_one, half_one)
    t = jnp.clip(cosine * s - beyond, -half_other, half_other)
    s = jnp.clip(along + cosine * t, -half_one, half_one)
    p, q = start + one * s, end + other * t
    return Point((p + q) * 0.5, axis, dot(q - p, axis))


def _corner(body: Body, d: Vector, k: Array) -> Vector:
    """The middle of the edge along axis k that is farthest along d, body's frame."""
    local = unrotate(body.rotation, d)
    halves = [jnp.where(local[m] >= 0, body.size[m], -body.size[m]) for m in range(3)]
    return Vector(*(jnp.where(k == m, 0, half) for m, half in enumerate(halves)))


def _outline(a: Body, b: Body, face: Array) -> list[Point]:
    """Corners of what a face (0 to 5, b's last) cuts out of the other box's face that looks at it."""
    mine = face < 3
    reference, other = choose(mine, (a[:3], b[:3]), (b[:3], a[:3]))
    axes, size = _turned(reference, face % 3)
    offset = unrotate(axes, other[0] - reference[0])
    toward = jnp.where(offset.z >= 0, 1, -1).astype(offset.x.dtype)
    # Within the face x and y, above it z.
    cosines = [jnp.abs(dot(axes[2], other[1][k])) for k in range(3)]
    number = jnp.where(cosines[1] > cosines[0], 1, 0)
    number = jnp.where(cosines[2] > jnp.maximum(cosines[0], cosines[1]), 2, number)
    its_axes, its_size = _turned(other, number)
    u, v, w = (unrotate(axes, column) * half for column, half in zip(its_axes, _parts(its_size), strict=True))
    w = choose(toward * w.z > 0, -w, w)
    u, v, middle = (Vector(p.x, p.y, toward * p.z) for p in (u, v, offset + w))
    middle = Vector(middle.x, middle.y, middle.z - size.z)
    corners = fenced(_clipped)(u, v, middle, size)
    normal = axes[2] * toward
    outward = choose(mine, normal, -normal)
    points = []
    for corner, present in corners:
        height = toward * (size.z + 0.5 * corner.z)
        position = reference[0] + rotate(axes, Vector(corner.x, corner.y, height))
        points.append(Point(position, outward, jnp.where(present, corner.z, jnp.inf)))
    return points


def _turned(box: tuple[Vector, Rotation, Vector], number: Array) -> tuple[Rotation, Vector]:
    """Axes and half extents of a box in cyclic order, the one of the given number last."""
    columns, halves = list(box[1]), _parts(box[2])
    x, y, z = (pick([columns[(k + shift) % 3] for k in range(3)], number) for shift in (1, 2, 3))
    size = Vector(*(pick([halves[(k + shift) % 3] for k in range(3)], number) for shift in (1, 2, 3)))
    return (x, y, z), size


def _parts(a: Vector) -> list[Array]:
    return [a.x, a.y, a.z]


def _clipped(u: Vector, v: Vector, middle: Vector, size: Vector) -> list[tuple[Vector, Array]]:
    """Corners of a parallelogram middle +- u +- v within |x|, |y| <= size, eight slots, and which hold one.

    They are the two ends of what is left of each of its sides, and the outline's corners that it covers.
    """
    found = []
    for side, way in ((u, v), (v, -u), (-u, -v), (-v, u)):
        start, along = middle + side - way, way * 2
        enter, leave = jnp.zeros_like(start.x), jnp.ones_like(start.x)
        for p, rate, half in ((start.x, along.x, size.x), (start.y, along.y, size.y)):
            moving = rate != 0
            safe = jnp.where(moving, rate, 1)
            ends = (half - p) / safe, (-half - p) / safe
            within = jnp.abs(p) <= half
            enter = jnp.maximum(enter, jnp.where(moving, jnp.minimum(*ends), jnp.where(within, 0, jnp.inf)))
            leave = jnp.minimum(leave, jnp.where(moving, jnp.maximum(*ends), jnp.where(within, 1, -jnp.inf)))
        left = enter < leave
        safe_enter, safe_leave = jnp.where(left, enter, 0), jnp.where(left, leave, 0)
        found.append((start + along * safe_enter, left))
        # The end of a side is where the next one starts.
        found.append((start + along * safe_leave, left & (leave < 1)))
    determinant = u.x * v.y - u.y * v.x
    inverse = safe_divide(jnp.ones_like(determinant), determinant)
    for sign_x, sign_y in ((1, 1), (-1, 1), (-1, -1), (1, -1)):
        x, y = sign_x * size.x - middle.x, sign_y * size.y - middle.y
        s, t = (x * v.y - y * v.x) * inverse, (y * u.x - x * u.y) * inverse
        corner = Vector(sign_x * size.x, sign_y * size.y, middle.z + s * u.z + t * v.z)
        found.append((corner, (jnp.abs(s) < 1) & (jnp.abs(t) < 1)))
    return _compact(found)


def _compact(found: list[tuple[Vector, Array]]) -> list[tuple[Vector, Array]]:
    """The first eight that are there."""
    ranks, count = [], jnp.zeros(found[0][1].shape, jnp.int32)
    for _, present in found:
        ranks.append(jnp.where(present, count, -1))
        count = count + jnp.where(present, 1, 0)
    slots = []
    for slot in range(CORNERS):
        chosen = found[0][0]
        for (corner, _), rank in zip(found[1:], ranks[1:], strict=True):
            chosen = choose(rank == slot, corner, chosen)
        slots.append((chosen, count > slot))
    return slots
