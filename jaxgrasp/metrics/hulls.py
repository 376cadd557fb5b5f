"""Metrics of one grasp by the convex hull of its wrenches, exact but for rounding."""

import itertools
import math

import numpy as np

from jaxgrasp.contact import Contacts
from jaxgrasp.metrics.largest_ball import Norm, check_norm
from jaxgrasp.metrics.wrench_space import WrenchSpace, edges_of, one_hull, only_one

# Points of a Linf wrench space of which Qhull makes a hull within some ten seconds and a gigabyte: 6,561, of four
# contacts with eight edges, took 9 s and 0.6 GB.
_MOST_POINTS = 10_000
# A smaller ball, in units of the longest wrench, is Qhull's rounding of a facet through the origin.
_SMALLEST_BALL = 1e-10


def ferrari_canny(contacts: Contacts, norm: Norm = "L1", space: WrenchSpace | None = None) -> float:
    """The radius of the largest ball about the origin in the grasp wrench space.

    Ferrari and Canny, "Planning optimal grasps" (ICRA 1992): the smallest wrench that the fingers cannot exert while
    their normal forces sum up to at most 1 (L1: the hull of all edge wrenches and the origin) or are each at most 1
    (Linf: the Minkowski sum of each finger's hull). The unit of moments and their reference are those of `space`.

    Args:
        contacts: one grasp.
        norm: "L1", or "Linf", whose hull has up to (1 + n_e)^n_c points.
        space: conventions; `WrenchSpace()` where None.

    Returns:
        The radius, per unit of normal force; exactly 0 without force closure; NaN for data that are not admissible.

    Raises:
        ValueError: a batch, options that do not fit, or more points than Qhull can take.
        ImportError: SciPy is missing.
    """
    only_one(contacts, "ferrari_canny_bound takes batches")
    edges = edges_of(contacts, space)
    if not edges.valid:
        return math.nan
    check_norm(norm)
    groups = [np.asarray(w) for w, there in zip(edges.wrenches, edges.present, strict=True) if there]
    points = _flat(groups) if norm == "L1" or not groups else _sums(groups)
    hull = one_hull(points)
    radius = 0.0 if hull is None else float(-hull.equations[:, -1].max())
    return radius if radius > _SMALLEST_BALL * np.linalg.norm(points, axis=-1).max() else 0.0


def wrench_space_volume(contacts: Contacts, space: WrenchSpace | None = None) -> float:
    """The volume of the grasp wrench space whose normal forces sum up to at most 1.

    Miller and Allen, "Examples of 3D grasp quality computations" (ICRA 1999): the volume of the hull of all edge
    wrenches and the origin, moments as `space` has them. It is positive without force closure, too.

    Args:
        contacts: one grasp.
        space: conventions; `WrenchSpace()` where None.

    Returns:
        The volume, in units of force and moment / length; 0 where the wrenches do not span the space; NaN for data that
        are not admissible.

    Raises:
        ValueError: a batch, or options that do not fit.
        ImportError: SciPy is missing.
    """
    only_one(contacts, "call it for each of them")
    edges = edges_of(contacts, space)
    if not edges.valid:
        return math.nan
    hull = one_hull(_flat([np.asarray(w) for w in edges.wrenches]))
    return 0.0 if hull is None else float(hull.volume)


def _flat(groups: list[np.ndarray]) -> np.ndarray:
    return np.concatenate([np.zeros((1, 6)), *groups])


def _sums(groups: list[np.ndarray]) -> np.ndarray:
    count = math.prod(1 + len(group) for group in groups)
    if count > _MOST_POINTS:
        # As many edges as leave the hull small enough.
        fitting = math.floor(_MOST_POINTS ** (1 / len(groups)) + 1e-9) - 1
        fewer = f"cone_edges={fitting} (--cone-edges {fitting}), or " if fitting >= 3 else ""
        raise ValueError(
            f"cone_edges: got {len(groups)} contacts with {len(groups[0])} edges each, {count:,} points of the Linf "
            f"wrench space; wanted at most {_MOST_POINTS:,}: {fewer}ferrari_canny_bound with the norm Linf "
            "(--metric ferrari_canny_linf_bound), which takes any number"
        )
    choices = itertools.product(*[_flat([group]) for group in groups])
    return np.array([np.sum(choice, 0) for choice in choices]).reshape(-1, 6)
