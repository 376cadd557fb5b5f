"""The volume of one grasp's wrench space, by its convex hull."""

import math

import numpy as np

from jaxgrasp.contact import Contacts
from jaxgrasp.metrics.wrench_space import WrenchSpace, edges_of, one_hull, only_one


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
    hull = one_hull(np.concatenate([np.zeros((1, 6)), edges.flat]))
    return 0.0 if hull is None else float(hull.volume)
