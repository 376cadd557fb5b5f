"""What touches, and what is said of a touch."""

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jax import Array

from jaxgrasp.geometry.pairs.vectors import Rotation, Vector

KINDS = ("sphere", "capsule", "ellipsoid", "cylinder", "box", "mesh")


class Hull(NamedTuple):
    """A convex polyhedron by its corners, the same for all lanes, in the geom's frame."""

    vertices: Array
    """(vertices, 3), m."""

    @classmethod
    def from_faces(cls, vertices: np.ndarray, faces: np.ndarray) -> "Hull":
        """The hull of a mesh, from the hull's own faces.

        Args:
            vertices: (vertices, 3), m.
            faces: (faces, 3), indices of the faces' corners; vertices that no face has are left out.

        Raises:
            ValueError: other shapes, no solid, not finite, or indices out of range.
        """
        vertices, faces = np.asarray(vertices, float), np.asarray(faces)
        if vertices.ndim != 2 or vertices.shape[1:] != (3,) or faces.ndim != 2 or faces.shape[1:] != (3,):
            raise ValueError(f"got vertices {vertices.shape} and faces {faces.shape}, wanted (V, 3) and (F, 3)")
        if len(faces) < 4 or faces.dtype.kind not in "iu" or faces.min() < 0 or faces.max() >= len(vertices):
            raise ValueError(f"faces: got {len(faces)}, wanted at least 4 of indices from 0 to {len(vertices) - 1}")
        if not np.isfinite(vertices).all():
            raise ValueError("vertices: got some that are not finite, wanted finite ones")
        return cls(vertices=jnp.asarray(vertices[np.unique(faces)]))


class Geom(NamedTuple):
    """One geom a lane; lanes trail."""

    position: Array
    """(3, *lanes), of the geom's frame in a frame common to both geoms, m."""
    rotation: Array
    """(3, 3, *lanes), columns are the geom's axes in the common frame."""
    size: Array
    """(3, *lanes), m: sphere (radius, _, _), capsule and cylinder (radius, half length along z, _), ellipsoid
    semi-axes, box half extents; of a mesh not used. A capsule's half length is without the half balls."""
    hull: Hull | None = None
    """Of a mesh."""


class Touch(NamedTuple):
    """Points where two geoms a and b touch or come near; k slots a pair; lanes trail."""

    position: Array
    """(k, 3, *lanes), midway between the two surfaces, common frame, m."""
    normal: Array
    """(k, 3, *lanes), unit, from a to b."""
    distance: Array
    """(k, *lanes), of the surfaces along the normal, m: negative inside each other, +inf in slots without a point."""


class Body(NamedTuple):
    """A `Geom` by components."""

    position: Vector
    rotation: Rotation
    size: Vector
    hull: Hull | None

    @classmethod
    def of(cls, geom: Geom) -> "Body":
        """The geom's arrays, taken apart."""
        x, y, z = (Vector.unstacked(geom.rotation[:, i]) for i in range(3))
        return cls(Vector.unstacked(geom.position), (x, y, z), Vector.unstacked(geom.size), geom.hull)


class Point(NamedTuple):
    """One slot of a `Touch` by components."""

    position: Vector
    normal: Vector
    distance: Array


def collected(points: list[Point]) -> Touch:
    """The slots of a touch."""
    return Touch(
        jnp.stack([point.position.stacked() for point in points]),
        jnp.stack([point.normal.stacked() for point in points]),
        jnp.stack([point.distance for point in points]),
    )
