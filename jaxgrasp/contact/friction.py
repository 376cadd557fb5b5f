"""Coulomb's cone and its inscribed pyramid, and what torsional friction adds to both."""

import math

import numpy as np


def pyramid_facets(cone_edges: int) -> np.ndarray:
    """Facet rows of the friction pyramid for unit friction.

    Row k is (cos, sin, cos(pi / n_e)) at the angle pi (2 k + 1) / n_e. The edges stand at angles 2 pi k / n_e from t1,
    on Coulomb's cone |f_t| <= -mu f_n, so facet k has its normal halfway between two of them. For friction mu the rows
    of C in C f <= -d (1) are these with the last entry times mu. The pyramid is inscribed: what holds for it holds for
    the cone.

    Args:
        cone_edges: n_e, at least 3.

    Returns:
        (n_e, 3).

    Raises:
        ValueError: fewer than three edges.
    """
    if int(cone_edges) != cone_edges or cone_edges < 3:
        raise ValueError(f"cone_edges: got {cone_edges}, wanted an integer of at least 3")
    halfway = 2 * (2 * np.arange(cone_edges) + 1)
    cosines = [_cosine(angle, cone_edges) for angle in (halfway, halfway - cone_edges, np.full_like(halfway, 2))]
    return np.stack(cosines, -1)


def contact_facets(cone_edges: int, components: int) -> np.ndarray:
    """Facet rows of the inscribed polytope of a hard or a soft contact for unit friction.

    The force (f_t1, f_t2, f_n) of a soft contact comes with a moment m about the normal, here in newtons, tau = m mu /
    gamma: so the ellipsoid |f_t|^2 / mu^2 + m^2 / gamma^2 <= f_n^2 is the cone |(f_t, tau)| <= -mu f_n. The polytope
    has the n_e edges of the pyramid at tau = 0 and the two poles f_t = 0, all on the ellipsoid, and a facet for each
    pair of edge and pole: (cos, sin, cos(pi / n_e), +-cos(pi / n_e)).

    Args:
        cone_edges: n_e, at least 3.
        components: 3, a hard contact with the facets of the pyramid; or 4, a soft one.

    Returns:
        (n_e, 3); or (2 n_e, 4), first the facets of the pole tau > 0.

    Raises:
        ValueError: fewer than three edges.
    """
    facets = pyramid_facets(cone_edges)
    if components == 3:
        return facets
    return np.concatenate([np.concatenate([facets, sign * facets[:, 2:]], 1) for sign in (1, -1)])


def _cosine(angle: np.ndarray, cone_edges: int) -> np.ndarray:
    """Of angles counted in pi / (2 n_e); the same to the last bit, but for its sign, wherever it is so on paper."""
    angle = np.abs((angle + 2 * cone_edges) % (4 * cone_edges) - 2 * cone_edges)
    acute = np.minimum(angle, 2 * cone_edges - angle)
    return np.where(angle == acute, 1, -1) * np.sin(math.pi * (cone_edges - acute) / (2 * cone_edges))
