"""Meshes taken apart into convex pieces, as collision engines want them."""

from jaxgrasp.geometry.mesh import Mesh, MeshError


def convexity(mesh: Mesh) -> float:
    """The share of its convex hull that a mesh fills: 1 for one that is convex.

    Raises:
        MeshError: It has no hull.
    """
    from scipy.spatial import ConvexHull, QhullError

    try:
        return min(1.0, mesh.volume / ConvexHull(mesh.triangles.reshape(-1, 3)).volume)
    except QhullError:
        raise MeshError("got a surface without a convex hull, wanted one around a solid") from None


def convex_pieces(mesh: Mesh, threshold: float = 0.05, *, most: int | None = None, seed: int = 0) -> list[Mesh]:
    """Take a mesh apart into convex pieces, by CoACD (Wei and others 2022).

    Args:
        mesh: any mesh; one that is not closed is closed first, in voxels.
        threshold: how concave a piece may be, as CoACD measures it, of the mesh's size: 0.01 (many pieces) to 1.
        most: how many pieces there may be; None for as many as it takes.
        seed: of the search for cuts.

    Returns:
        The pieces, closed and convex, in the frame of the mesh, m.

    Raises:
        ImportError: CoACD, of the extra `pieces`, is not installed.
        ValueError: an option that is out of range.
    """
    if not 0.01 <= threshold <= 1:
        raise ValueError(f"threshold: got {threshold}, wanted 0.01 to 1")
    if most is not None and most < 1:
        raise ValueError(f"most: got {most}, wanted at least 1")
    try:
        import coacd  # pyright: ignore[reportMissingImports]
    except ImportError as error:
        raise ImportError("coacd is not installed; wanted pip install 'jaxgrasp[pieces]'") from error
    coacd.set_log_level("error")
    given = coacd.Mesh(mesh.vertices, mesh.faces)
    found = coacd.run_coacd(given, threshold=threshold, max_convex_hull=most or -1, seed=seed)
    return [Mesh.from_arrays(vertices, faces) for vertices, faces in found]
