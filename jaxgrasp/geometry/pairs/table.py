"""Which function a pair of kinds takes."""

from collections.abc import Callable

import jax

from jaxgrasp.geometry.pairs.box_box import CORNERS, box_box
from jaxgrasp.geometry.pairs.capsule_box import capsule_box
from jaxgrasp.geometry.pairs.convex import convex
from jaxgrasp.geometry.pairs.geom import Body, Geom, Point, Touch, collected
from jaxgrasp.geometry.pairs.round_pairs import capsule_capsule, sphere_with
from jaxgrasp.geometry.pairs.surfaces import to_box, to_capsule, to_cylinder, to_ellipsoid, to_sphere
from jaxgrasp.lanes.fence import fences

_PAIRS: dict[tuple[str, str], tuple[int, Callable[[Body, Body], list[Point]]]] = {
    # One point, from the signed distance of the sphere's centre.
    ("sphere", "sphere"): (1, sphere_with(to_sphere)),
    ("sphere", "capsule"): (1, sphere_with(to_capsule)),
    ("sphere", "ellipsoid"): (1, sphere_with(to_ellipsoid)),
    ("sphere", "cylinder"): (1, sphere_with(to_cylinder)),
    ("sphere", "box"): (1, sphere_with(to_box)),
    # Two points where the capsule lies along the other.
    ("capsule", "capsule"): (2, capsule_capsule),
    ("capsule", "box"): (2, capsule_box),
    # Corners of a common outline or a crossing of edges, and the nearest point of boxes apart.
    ("box", "box"): (CORNERS + 1, box_box),
    # One point, found by search.
    ("sphere", "mesh"): (1, convex("sphere", "mesh")),
    ("capsule", "ellipsoid"): (1, convex("capsule", "ellipsoid")),
    ("capsule", "cylinder"): (1, convex("capsule", "cylinder")),
    ("capsule", "mesh"): (1, convex("capsule", "mesh")),
    ("ellipsoid", "ellipsoid"): (1, convex("ellipsoid", "ellipsoid")),
    ("ellipsoid", "cylinder"): (1, convex("ellipsoid", "cylinder")),
    ("ellipsoid", "box"): (1, convex("ellipsoid", "box")),
    ("ellipsoid", "mesh"): (1, convex("ellipsoid", "mesh")),
    ("cylinder", "cylinder"): (1, convex("cylinder", "cylinder")),
    ("cylinder", "box"): (1, convex("cylinder", "box")),
    ("cylinder", "mesh"): (1, convex("cylinder", "mesh")),
    ("box", "mesh"): (1, convex("box", "mesh")),
    ("mesh", "mesh"): (1, convex("mesh", "mesh")),
}


def slots(kind_a: str, kind_b: str) -> int:
    """How many points a pair can have.

    Raises:
        ValueError: the table has no such pair.
    """
    return _entry(kind_a, kind_b)[0]


def touch(kind_a: str, kind_b: str, a: Geom, b: Geom) -> Touch:
    """Where two geoms touch or come near.

    Differentiable with respect to positions and rotations, both ways, except where the points jump: where another
    corner, edge or face comes to be the nearest.

    Args:
        kind_a: one of `KINDS`.
        kind_b: one of `KINDS`.
        a: one geom a lane.
        b: the other geom of the same lane, in the same frame.

    Raises:
        ValueError: the table has no such pair.
    """
    _, function = _entry(kind_a, kind_b)
    swapped = (kind_a, kind_b) not in _PAIRS
    bodies = (Body.of(b), Body.of(a)) if swapped else (Body.of(a), Body.of(b))
    with fences(jax.default_backend() == "cpu"):
        found = collected(function(*bodies))
    return found._replace(normal=-found.normal) if swapped else found


def _entry(kind_a: str, kind_b: str) -> tuple[int, Callable[[Body, Body], list[Point]]]:
    for pair in ((kind_a, kind_b), (kind_b, kind_a)):
        if pair in _PAIRS:
            return _PAIRS[pair]
    known = ", ".join(f"{a}-{b}" for a, b in _PAIRS)
    raise ValueError(f"got the pair {kind_a}-{kind_b}, wanted one of {known}, in any order")
