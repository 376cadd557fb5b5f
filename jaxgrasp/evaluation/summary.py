"""What is to be said of many trials: shares with intervals, penetration, contact and diversity, object by object."""

import math
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from jaxgrasp.evaluation.evaluate import Evaluation
from jaxgrasp.files import GRASP, GraspSet
from jaxgrasp.simulation import DIVERGED, INSIDE, UNUSABLE

# Of a normal distribution, for 95 %.
_Z = 1.959964
_COMPONENTS = 5
ALL = "all"


@dataclass(frozen=True, kw_only=True)
class Summary:
    """Of the grasps of one object, or of all."""

    name: str
    grasps: int
    tried: int
    """How many say something: all but what diverged and what is no configuration."""
    held: int
    interval: tuple[float, float]
    """95 % interval of the share that holds, by Wilson."""
    inside: int
    """How many were not tried, for they penetrate."""
    diverged: int
    unusable: int
    penetration: float
    """Mean of all, m."""
    self_penetration: float
    contact_number: float
    contact_distance: float
    contact_consistency: float
    diversity: Float[np.ndarray, " components"]
    """See `diversity`."""


def summaries(found: Evaluation) -> list[Summary]:
    """One for each object, in the order in which they come up, and the last for all."""
    names = list(dict.fromkeys(found.object.tolist()))
    parts = [_summary(found, name, found.object == name) for name in names]
    return [*parts, _summary(found, ALL, np.ones(len(found), bool))] if len(parts) != 1 else parts


def wilson(successes: int, count: int) -> tuple[float, float]:
    """The 95 % interval of a share by Wilson's score; 0 to 1 where nothing was tried."""
    if not count:
        return 0.0, 1.0
    share, z = successes / count, _Z
    middle = (share + z * z / (2 * count)) / (1 + z * z / count)
    half = z / (1 + z * z / count) * math.sqrt(share * (1 - share) / count + z * z / (4 * count * count))
    return middle - half if successes else 0.0, middle + half if successes < count else 1.0


def diversity(grasps: GraspSet) -> Float[np.ndarray, " components"]:
    """Shares of the variance of grasps that their first principal components explain; the lower, the more diverse.

    Grasps are the base's position (m) and rotation vector (rad) in the object's frame, and the joints (rad), as in
    DexGraspBench.

    Returns:
        Cumulated, of up to five components; empty for fewer than two grasps.
    """
    base, joints = grasps.stages[GRASP].base, grasps.stages[GRASP].joints
    turn = _conjugated(grasps.object_pose[:, 3:])
    place = _turned(turn, base[:, :3] - grasps.object_pose[:, :3])
    rows = np.concatenate([place, _rotation_vectors(_product(turn, base[:, 3:])), joints], -1)
    rows = rows[np.isfinite(rows).all(-1)]
    if len(rows) < 2:
        return np.zeros(0)
    sizes = np.linalg.svd(rows - rows.mean(0), compute_uv=False) ** 2
    whole = sizes.sum()
    return np.cumsum(sizes)[:_COMPONENTS] / whole if whole > 0 else np.ones(1)


def _summary(found: Evaluation, name: str, chosen: np.ndarray) -> Summary:
    tried, held = int(found.tried[chosen].sum()), int(found.held[chosen].sum())
    mean = lambda values: float(np.nanmean(values[chosen])) if np.isfinite(values[chosen]).any() else math.nan
    known = chosen & (found.outcome != UNUSABLE)
    return Summary(
        name=name,
        grasps=int(chosen.sum()),
        tried=tried,
        held=held,
        interval=wilson(held, tried),
        inside=int((found.outcome[chosen] == INSIDE).sum()),
        diverged=int((found.outcome[chosen] == DIVERGED).sum()),
        unusable=int((found.outcome[chosen] == UNUSABLE).sum()),
        penetration=mean(found.penetration),
        self_penetration=mean(found.self_penetration),
        contact_number=float(found.contact_number[known].mean()) if known.any() else math.nan,
        contact_distance=mean(found.contact_distance),
        contact_consistency=mean(found.contact_consistency),
        diversity=diversity(found.grasps.take(chosen)),
    )


def _conjugated(quaternions: np.ndarray) -> np.ndarray:
    return quaternions * np.array([1.0, -1.0, -1.0, -1.0])


def _product(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Of quaternions (n, 4)."""
    scalar = a[:, :1] * b[:, :1] - (a[:, 1:] * b[:, 1:]).sum(-1, keepdims=True)
    return np.concatenate([scalar, a[:, :1] * b[:, 1:] + b[:, :1] * a[:, 1:] + np.cross(a[:, 1:], b[:, 1:])], -1)


def _turned(quaternions: np.ndarray, vectors: np.ndarray) -> np.ndarray:
    none = np.zeros((len(vectors), 1))
    return _product(_product(quaternions, np.concatenate([none, vectors], -1)), _conjugated(quaternions))[:, 1:]


def _rotation_vectors(quaternions: np.ndarray) -> np.ndarray:
    quaternions = np.where(quaternions[:, :1] < 0, -quaternions, quaternions)
    sine = np.linalg.norm(quaternions[:, 1:], axis=-1, keepdims=True)
    angle = 2 * np.arctan2(sine, quaternions[:, :1])
    return quaternions[:, 1:] * np.where(sine > 1e-12, angle / np.where(sine > 1e-12, sine, 1), 2.0)
