"""Disturbances from a file: a list of wrenches."""

from pathlib import Path

import numpy as np
from jaxtyping import Float

from jaxgrasp.candidates.reader import CandidateError
from jaxgrasp.storage import open_archive, read_array

# Each is looked at for every grasp in every step; a ball's surface is no rounder for more of them.
_MOST = 10_000


def read_wrenches(path: Path | str) -> Float[np.ndarray, "directions 6"]:
    """Reads disturbance wrenches, whose convex hull with the origin is the set of disturbances.

    Args:
        path: An `.npz` file with the field `wrenches`, or an `.npy` file: (n_d, 6), force in N and moment about the
            centre of mass in N m, in the object frame.

    Returns:
        The wrenches.

    Raises:
        CandidateError: The file cannot be read, or what it has is not finite numbers of that shape.
    """
    path = Path(path)
    if path.suffix == ".npy":
        field, wrenches = None, read_array(path)
    else:
        field = "wrenches"
        with open_archive(path) as archive:
            if field not in archive.headers:
                there = ", ".join(archive.headers) or "nothing"
                raise CandidateError(path, field, f"no such field (there is {there})", "wrenches (n_d, 6)")
            wrenches = archive.read([field])[field]
    if wrenches.dtype.kind not in "iuf" or wrenches.ndim != 2 or wrenches.shape[0] == 0 or wrenches.shape[1] != 6:
        raise CandidateError(path, field, f"dtype {wrenches.dtype}, shape {wrenches.shape}", "real numbers (n_d, 6)")
    if len(wrenches) > _MOST:
        raise CandidateError(path, field, f"{len(wrenches):,} wrenches", f"at most {_MOST:,}, corners of their hull")
    if not np.isfinite(wrenches).all():
        raise CandidateError(path, field, "NaN or infinite entries", "finite wrenches")
    return wrenches.astype(np.float64)
