"""Triangle meshes from files, and the grids of their signed distances."""

import functools
import struct
import warnings
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from jaxtyping import Float, Int

from jaxgrasp.geometry.grid import DistanceGrid
from jaxgrasp.geometry.mesh_files import BYTE, TRIANGLE, read_triangles
from jaxgrasp.geometry.mesh_repair import Parts, mended
from jaxgrasp.geometry.outer_surface import outer_surface
from jaxgrasp.geometry.triangle_tree import TriangleTree
from jaxgrasp.geometry.triangles import signed_distances
from jaxgrasp.storage import FileError, allowance, open_regular, printable, reason_of

MESH_ENDINGS = (".stl", ".obj", ".ply")
# Nodes beyond the mesh on every side: the spline's support, and room for points on their way back to the surface.
_MARGIN = 4
# Nodes nearer to the surface than 1.5 sqrt(3) spacings take part in look-ups on it; the rest is for those beside it.
_BAND = 3.5
# Nodes of the grid by which volume and centre of what is not closed are found.
_SOLID_NODES = 100_000
# Extents between which objects for hands are, m; others are likely in millimetres, or in metres taken for these.
_SMALLEST, _LARGEST, _PER_MILLI = 1e-3, 10.0, 1e-3


class MeshError(ValueError):
    """A mesh cannot be used. The message is one line: file, what came, what is wanted."""

    def __init__(self, message: str):
        """Makes it one line, whatever the file is called."""
        super().__init__(printable(message))


@dataclass(frozen=True, kw_only=True)
class Mesh:
    """Triangles, counterclockwise seen from outside, in NumPy."""

    vertices: Float[np.ndarray, "vertices 3"]
    """m."""
    faces: Int[np.ndarray, "triangles 3"]
    """Indices of the corners."""
    is_closed: bool = False
    """Whether it is known to be one part without holes; volume and centroid then follow from the triangles alone."""
    parts: Parts | None = field(default=None, repr=False)
    """The parts of triangles that hang together; None takes all of them for one part."""

    @classmethod
    def from_arrays(cls, vertices: np.ndarray, faces: np.ndarray) -> "Mesh":
        """A mesh of given triangles.

        Those that disagree with their neighbours, and parts that are inside out, are turned; triangles that are there
        twice, and parts without area, are left out. So are strays, parts with hardly any volume beside all others, with
        a warning. Holes get lids.

        Args:
            vertices: (vertices, 3), m.
            faces: (triangles, 3), indices.

        Raises:
            MeshError: not a mesh: other shapes, nothing in it, not finite, indices out of range, flat, or with one side
                alone.
        """
        vertices, faces = np.asarray(vertices, float), np.asarray(faces)
        if vertices.ndim != 2 or vertices.shape[1:] != (3,) or faces.ndim != 2 or faces.shape[1:] != (3,):
            raise MeshError(f"got vertices {vertices.shape} and faces {faces.shape}, wanted (V, 3) and (F, 3)")
        if len(faces) == 0:
            raise MeshError("got no triangles, wanted a surface")
        if faces.dtype.kind not in "iu" or faces.min() < 0 or faces.max() >= len(vertices):
            raise MeshError(f"got faces that are no indices of the {len(vertices)} vertices, wanted 0 to V - 1")
        if not np.isfinite(vertices).all():
            raise MeshError("got vertices that are not finite, wanted finite ones")
        try:
            vertices, faces, parts, is_closed, strays = mended(vertices, faces)
        except ValueError as error:
            raise MeshError(str(error)) from None
        if strays:
            warnings.warn(f"jaxgrasp: left out {strays} stray triangles beside the object", stacklevel=2)
        mesh = cls(vertices=vertices, faces=faces, is_closed=is_closed, parts=parts)
        volume = float(_tetrahedra(mesh.triangles)[0].sum())
        if not abs(volume) > 1e-9 * np.ptp(mesh.triangles, axis=(0, 1)).max() ** 3:
            raise MeshError(f"got a surface around {volume:.3g} m^3, wanted one around a solid")
        return mesh

    @classmethod
    def from_file(cls, path: Path | str, scale: float = 1.0) -> "Mesh":
        """Reads a mesh, `.stl`, `.obj` or `.ply`; all its parts become one.

        An extent that no object for a hand has gets a warning with the scale that is likely.

        Args:
            path: the file.
            scale: metres per unit of the file.

        Raises:
            MeshError: absent, of another kind, damaged, or not a mesh.
        """
        path = Path(path)
        if path.suffix.lower() not in MESH_ENDINGS:
            raise MeshError(f"{path}: got the ending {path.suffix!r}, wanted one of {', '.join(MESH_ENDINGS)}")
        kind = path.suffix[1:].lower()
        try:
            with open_regular(path, "an intact mesh", cost=BYTE) as stream:
                vertices, faces = read_triangles(stream.read(), kind, allowance() // TRIANGLE)
        except FileError as error:
            raise MeshError(str(error)) from error
        except (ValueError, LookupError, OverflowError, struct.error, Warning) as error:
            raise MeshError(f"{path}: got damaged data ({reason_of(error)}), wanted an intact mesh") from error
        try:
            mesh = cls.from_arrays(scale * vertices, faces)
        except MeshError as error:
            raise MeshError(f"{path}: {error}") from None
        extent = float(np.ptp(mesh.triangles, axis=(0, 1)).max())
        if not _SMALLEST <= extent <= _LARGEST:
            factor = scale * (_PER_MILLI if extent > _LARGEST else 1 / _PER_MILLI)
            warnings.warn(
                printable(f"jaxgrasp: {path}: got an object {extent:g} m wide; its scale is likely {factor:g}"),
                stacklevel=2,
            )
        return mesh

    @property
    def triangles(self) -> Float[np.ndarray, "triangles 3 3"]:
        """Corners of the triangles, m."""
        return self.vertices[self.faces]

    @property
    def volume(self) -> float:
        """Volume of the solid that the signed distances describe, less the cavities in it, m^3."""
        return self._solid[0]

    @property
    def centroid(self) -> Float[np.ndarray, "3"]:
        """Centre of the solid's volume, its centre of mass where it is of one material, m.

        Raises:
            MeshError: too many triangles are long or overlap.
        """
        return self._solid[1]

    def signed_distance(self, points: Float[np.ndarray, "points 3"]) -> Float[np.ndarray, " points"]:
        """Exact signed distances to the outer surface, see `triangles.signed_distances` and `outer_surface`.

        What a finger cannot touch is no surface: walls of closed cavities, parts within others, and where they overlap.

        Raises:
            MeshError: too many triangles are long or overlap.
        """
        return _distances(self._tree, points)

    def to_grid(
        self, nodes: int = 200_000, progress: Callable[[int, int], None] = lambda done, total: None
    ) -> DistanceGrid:
        """The mesh as a shape: its signed distances on a grid, smoothly interpolated.

        Args:
            nodes: how many nodes the grid may have; what is thinner than two of its spacings is lost.
            progress: called with how many distances are found, and how many there are to find as far as is known.

        Raises:
            ValueError: fewer than 1,000 nodes.
            MeshError: too many triangles are long or overlap.
        """
        if nodes < 1000:
            raise ValueError(f"nodes: got {nodes}, wanted at least 1000")
        origin, spacing, counts = self._nodes(nodes)
        corners = self.triangles.reshape(-1, 3)
        lower, upper = corners.min(0), corners.max(0)
        values = _samples(self._tree, origin, spacing, counts, progress)
        return DistanceGrid.from_samples(values, origin=origin, spacing=spacing, lower=lower, upper=upper)

    def deviation(self, points: Float[np.ndarray, "points 3"]) -> Float[np.ndarray, " points"]:
        """How far points that should lie on the surface are off it, m."""
        return np.abs(self.signed_distance(points))

    @functools.cached_property
    def _solid(self) -> tuple[float, np.ndarray]:
        """Volume and centre: with holes, or of parts that may overlap, by what share of each cell is inside."""
        if self.is_closed:
            volumes, centres = _tetrahedra(self.triangles)
            return float(volumes.sum()), volumes @ centres / volumes.sum()
        origin, spacing, counts = self._nodes(_SOLID_NODES)
        share = np.clip(0.5 - _samples(self._tree, origin, spacing, counts) / spacing, 0, 1)
        place = [(share.sum(tuple({0, 1, 2} - {k})) * np.arange(counts[k])).sum() / share.sum() for k in range(3)]
        volume, centre = float(share.sum() * spacing**3), origin + spacing * np.array(place)
        if self.parts is None:
            return volume, centre
        empty, centres = _tetrahedra(self.triangles[(self.parts.volume < 0)[self.parts.of]])
        return volume + float(empty.sum()), (volume * centre + empty @ centres) / (volume + empty.sum())

    def _nodes(self, nodes: int) -> tuple[np.ndarray, float, np.ndarray]:
        """Origin, spacing and counts of a grid around the mesh with about so many nodes."""
        corners = self.triangles.reshape(-1, 3)
        lower, upper = corners.min(0), corners.max(0)
        spacing = _spacing(upper - lower, nodes)
        counts = 2 * (np.floor((upper - lower) / spacing).astype(int) // 2 + _MARGIN) + 1
        return 0.5 * (lower + upper - spacing * (counts - 1)), spacing, counts

    @functools.cached_property
    def _tree(self) -> TriangleTree:
        """The triangles of the outer surface."""
        if self.parts is None or self.is_closed:
            return TriangleTree(self.vertices, self.faces)
        try:
            return TriangleTree(*outer_surface(self.vertices, self.faces, self.parts))
        except ValueError as error:
            raise MeshError(str(error)) from None


def _distances(
    tree: TriangleTree, points: Float[np.ndarray, "points 3"], progress: Callable[[int], None] = lambda done: None
) -> Float[np.ndarray, " points"]:
    try:
        return signed_distances(tree, np.asarray(points, float), progress)
    except ValueError as error:
        raise MeshError(str(error)) from None


def _samples(
    tree: TriangleTree,
    origin: np.ndarray,
    spacing: float,
    counts: np.ndarray,
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> np.ndarray:
    """Signed distances at the nodes of a grid: exact near the surface, elsewhere between those of every other node.

    The counts are odd.
    """
    indices = np.indices(tuple(counts))
    even = (indices % 2 == 0).all(0)

    def exact(where: np.ndarray, before: int = 0) -> np.ndarray:
        points = origin + spacing * indices[:, where].T
        return _distances(tree, points, lambda done: progress(before + done, before + len(points)))

    values = exact(even).reshape(counts // 2 + 1)
    for axis in range(3):
        ahead = np.moveaxis(values, axis, 0)
        finer = np.empty((2 * len(ahead) - 1, *ahead.shape[1:]))
        finer[::2], finer[1::2] = ahead, 0.5 * (ahead[:-1] + ahead[1:])
        values = np.moveaxis(finer, 0, axis)
    near = ~even & (np.abs(values) < _BAND * spacing)
    values[near] = exact(near, int(even.sum()))
    return values


def _tetrahedra(triangles: Float[np.ndarray, "triangles 3 3"]) -> tuple[np.ndarray, np.ndarray]:
    """Signed volumes and centres of the tetrahedra between triangles and a point amid them."""
    amid = triangles.mean((0, 1)) if len(triangles) else np.zeros(3)
    corners = triangles - amid
    volumes = np.einsum("fi,fi->f", corners[:, 0], np.cross(corners[:, 1], corners[:, 2])) / 6
    return volumes, corners.sum(1) / 4 + amid


def _spacing(extents: np.ndarray, nodes: int) -> float:
    """The spacing with which a grid around a box of these extents has about so many nodes."""
    low, high = 0.0, float(extents.max())
    for _ in range(60):
        middle = 0.5 * (low + high)
        fits = np.prod(extents / middle + 2 * _MARGIN) <= nodes
        low, high = (low, middle) if fits else (middle, high)
    return high
