"""Shapes by their signed distances: primitives, unions, triangle meshes, and what lies on their surfaces."""

from jaxgrasp.geometry.combined import Placed, SmoothUnion
from jaxgrasp.geometry.convex_pieces import convex_pieces, convexity
from jaxgrasp.geometry.grid import DistanceGrid
from jaxgrasp.geometry.mesh import Mesh, MeshError
from jaxgrasp.geometry.primitives import Box, Capsule, Cylinder, Ellipsoid, Sphere, Superquadric
from jaxgrasp.geometry.shape import Shape
from jaxgrasp.geometry.surface import centroid, normals, project, sample_surface

__all__ = [
    "Box",
    "Capsule",
    "Cylinder",
    "DistanceGrid",
    "Ellipsoid",
    "Mesh",
    "MeshError",
    "Placed",
    "Shape",
    "SmoothUnion",
    "Sphere",
    "Superquadric",
    "centroid",
    "convex_pieces",
    "convexity",
    "normals",
    "project",
    "sample_surface",
]
