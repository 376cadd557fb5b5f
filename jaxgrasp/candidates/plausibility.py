"""Whether the numbers of candidates can be meant as they came: units and directions that others write differently."""

import numpy as np
from jaxtyping import Bool, Float

from jaxgrasp.candidates.candidates import Candidates

# Of each source at most so many grasps are looked at.
_LOOKED_AT = 10_000
# Where nothing else is known, a grasp's contacts are this far from their middle, m: half the breadth of what one holds.
_USUAL_SIZE = 0.05
_LARGEST_SIZE, _SMALLEST_SIZE = 1.0, 1e-3
_UNITS = {1e-2: "centimetres", 1e-3: "millimetres", 1e-6: "micrometres"}
# Of what one holds by hand the centre of mass is nearer than this, m.
_FARTHEST_MIDDLE = 0.3
_LARGEST_FRICTION = 3.0
# Every normal of a convex object points away from the middle of the contacts, which is inside. Handles, rims and the
# insides of cups are exceptions: of recorded grasps a sixth, where the object is a banana.
_MOST_INWARD = 0.3


def doubtful_conventions(candidates: Candidates) -> list[str]:
    """Find units and directions that can hardly be meant: nothing of it is refused or changed.

    Asked are whether normals point inwards or frames have another axis along them, whether positions are in other units
    than metres or far from the centre of mass, and whether friction is an angle or a percentage.

    Args:
        candidates: Grasps by their contacts, of one file or several.

    Returns:
        One line for each source that has something doubtful: its name, what is doubtful, and the likely remedy.
    """
    lines = []
    for number, name in enumerate(candidates.sources):
        rows = np.flatnonzero(candidates.source == number)
        some = candidates.take(rows[:: max(1, len(rows) // _LOOKED_AT)])
        # Arithmetic on what is not finite is that grasp's own affair.
        with np.errstate(invalid="ignore", over="ignore"):
            doubts = [*_doubts_of_positions(some), *_doubts_of_normals(some), *_doubts_of_friction(some)]
        if doubts:
            lines.append(f"{name}: {'; '.join(doubts)}")
    return lines


def _doubts_of_positions(candidates: Candidates) -> list[str]:
    present, middle, arms = _arms(candidates)
    size = np.sqrt(_mean((arms**2).sum(-1), present))
    size = size[np.isfinite(size) & (size > 0)]
    if not len(size):
        return []
    usual, away = np.median(size), np.linalg.norm(middle, axis=-1)
    if usual > _LARGEST_SIZE or usual < _SMALLEST_SIZE:
        factors = list(_UNITS) if usual > _LARGEST_SIZE else [1e2, 1e3, 1e6]
        factor = min(factors, key=lambda f: abs(np.log(f * usual / _USUAL_SIZE)))
        unit = f"{_UNITS[factor]}, " if factor in _UNITS else ""
        return [
            f"positions are {usual:.3g} m from the middle of their grasp; wanted metres: likely {unit}"
            f"multiply by {factor:g}"
        ]
    distance = np.nanmedian(away)
    if distance > _FARTHEST_MIDDLE:
        found = (
            f"grasps are {distance:.3g} m from the origin, and their contacts {usual:.3g} m from each other's middle"
        )
        center = candidates.columns.get("center_of_mass")
        # Files without the column have NaN there.
        off = np.empty(0) if center is None else np.linalg.norm(middle - center, axis=-1)
        if np.isfinite(off).any() and np.nanmedian(off) < distance / 3:
            return [f"{found}; wanted positions about the centre of mass: subtract the column center_of_mass"]
        if distance > _LARGEST_SIZE:
            return [f"{found}; wanted positions about the centre of mass"]
    return []


def _doubts_of_normals(candidates: Candidates) -> list[str]:
    present, _, arms = _arms(candidates)
    if candidates.frames is None:
        others = {"multiply outward_normals by -1": -candidates.normals}
    else:
        # Other conventions of a frame: the normal is another column, or a row, or points inwards.
        others = {
            f"the normal as third column, which is {word}{kind} {axis + 1} now": sign * frames[..., axis]
            for sign, word in ((1, ""), (-1, "the negative of "))
            for kind, frames in (("column", candidates.frames), ("row", candidates.frames.swapaxes(-1, -2)))
            for axis in range(3)
        }
    inward = _inward(arms, candidates.normals, present)
    shares = {remedy: _inward(arms, normals, present) for remedy, normals in others.items()}
    best = min(shares, key=lambda remedy: shares[remedy])
    # Rows read as columns may be outward by chance as often as those of an object with a handle.
    if inward <= _MOST_INWARD and not (inward > _MOST_INWARD / 2 and shares[best] < inward / 4):
        return []
    remedy = f": likely {best}" if shares[best] < min(_MOST_INWARD, inward / 2) else ""
    return [f"{inward:.0%} of the normals point into the object; wanted outward ones{remedy}"]


def _doubts_of_friction(candidates: Candidates) -> list[str]:
    high = candidates.friction[candidates.active & (candidates.friction > _LARGEST_FRICTION)]
    if not len(high):
        return []
    usual = np.median(high)
    angle = f"degrees, whose tangent is {np.tan(np.radians(usual)):.3g}, or " if usual < 90 else ""
    return [f"friction is {usual:.3g}; wanted a coefficient: likely {angle}per cent, multiply by 0.01"]


def _arms(
    candidates: Candidates,
) -> tuple[Bool[np.ndarray, "batch contacts"], Float[np.ndarray, "batch 3"], Float[np.ndarray, "batch contacts 3"]]:
    """Which contacts are there, the middle of each grasp's, and where they are about it (about the origin if alone)."""
    present = candidates.active & np.isfinite(candidates.positions).all(-1)
    positions = np.where(present[..., None], candidates.positions, 0)
    middle = np.stack([_mean(positions[..., axis], present) for axis in range(3)], -1)
    center = np.where(present.sum(1) > 1, 1.0, 0.0)[:, None] * np.nan_to_num(middle)
    return present, middle, positions - center[:, None]


def _mean(values: np.ndarray, present: np.ndarray) -> np.ndarray:
    """The mean over the contacts that are there, NaN without any."""
    count = present.sum(1)
    return np.where(count > 0, (values * present).sum(1) / np.maximum(count, 1), np.nan)


def _inward(arms: np.ndarray, normals: np.ndarray, present: np.ndarray) -> float:
    """The share of normals that point towards the middle."""
    along = (arms * normals).sum(-1)[present & np.isfinite(normals).all(-1)]
    return float(np.mean(along < 0)) if len(along) else 0.0
