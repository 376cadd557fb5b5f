"""Grasps as all formats become them: one record, whatever file they came from.

Every pose is a position, m, and a unit quaternion with w first, and says how a frame stands in the world. The base is
the world of the hand's file, not its first body; the object's frame is that of its file. What a file says in other
frames, orders or units is turned where it is read.
"""

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float, Shaped

from jaxgrasp.files.joint_names import renamed
from jaxgrasp.storage import FileError

GRASP = "grasp"
"""Name of the stage that every set has."""
STANDING = (0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0)
"""The pose of what stands in its parent's frame."""


@dataclass(frozen=True)
class HandPoses:
    """One stage of many grasps."""

    base: Float[np.ndarray, "batch 7"]
    """Pose of the frame of the hand file's world in the world, m and w first."""
    joints: Float[np.ndarray, "batch joints"]
    """Positions of the joints, rad or m."""

    @property
    def qpos(self) -> Float[np.ndarray, "batch width"]:
        """Both beside each other, as most files have them: (N, 7 + n)."""
        return np.concatenate([self.base, self.joints], -1)


@dataclass(frozen=True)
class GraspSet:
    """N grasps of one hand."""

    stages: dict[str, HandPoses]
    """Configurations by stage: always "grasp", and "pregrasp", "squeeze" and others where files have them."""
    joint_names: tuple[str, ...] | None
    """Names of the joints, in the order of the columns; None is the order of the hand's file."""
    object_pose: Float[np.ndarray, "batch 7"]
    """Pose of the object's frame in the world, m and w first."""
    object_scale: Float[np.ndarray, " batch"]
    """Factor on the lengths of the object's file; NaN where a file does not say it."""
    object_name: Shaped[np.ndarray, " batch"]
    """What the file calls the object, text; empty where it does not."""
    source: Shaped[np.ndarray, " batch"]
    """FILE:ROW that each came from, text."""
    columns: dict[str, np.ndarray]
    """Whatever else files say of each grasp, (N, ...), by name."""
    notes: tuple[str, ...] = ()
    """What was assumed where files do not say it, or left out, a line each."""

    def __len__(self) -> int:
        """Returns how many grasps there are."""
        return len(self.object_pose)

    def take(self, rows: np.ndarray) -> "GraspSet":
        """The grasps of some rows.

        Args:
            rows: Numbers or a mask.
        """
        return replace(
            self,
            stages={name: HandPoses(s.base[rows], s.joints[rows]) for name, s in self.stages.items()},
            object_pose=self.object_pose[rows],
            object_scale=self.object_scale[rows],
            object_name=self.object_name[rows],
            source=self.source[rows],
            columns={name: column[rows] for name, column in self.columns.items()},
        )

    def with_scale(self, scale: float | None) -> "GraspSet":
        """The same grasps with one scale for all; None keeps the files' own.

        Raises:
            FileError: None is given, and a file does not say it.
        """
        if scale is not None:
            return replace(self, object_scale=np.full(len(self), float(scale)))
        unsaid = np.flatnonzero(np.isnan(self.object_scale))
        if len(unsaid):
            file = str(self.source[unsaid[0]]).rpartition(":")[0]
            raise FileError(
                file, "object_scale", "no scale of the object, which this format does not say", "with_scale (--scale)"
            )
        return self

    def for_hand(self, names: Sequence[str]) -> "GraspSet":
        """The same grasps with the names that a hand gives their joints, and where there are all in its order.

        Args:
            names: Of the hand's joints, in the order of its file.

        Raises:
            FileError: The hand does not have these joints.
        """
        file, count = self.source[0].rpartition(":")[0], self.stages[GRASP].joints.shape[1]
        listed = ", ".join(names)
        if self.joint_names is None:
            if count != len(names):
                got = f"{count} joints without names"
                raise FileError(file, "joints", got, f"{len(names)}, those of the hand: {listed}")
            return replace(self, joint_names=tuple(names))
        try:
            own = renamed(self.joint_names, names)
        except LookupError as error:
            raise FileError(file, "joints", repr(error.args[0]), f"some of the hand's: {listed}") from error
        order = [own.index(name) for name in names if name in own]
        stages = {name: HandPoses(stage.base, stage.joints[:, order]) for name, stage in self.stages.items()}
        return replace(self, stages=stages, joint_names=tuple(own[k] for k in order))

    def unnamed(self) -> "GraspSet":
        """The same grasps without names of joints: their order is then taken for that of the hand's file."""
        return replace(self, joint_names=None)

    def joints_by_name(self, stage: str = GRASP) -> "dict[str, np.ndarray] | np.ndarray":
        """The joints of a stage as `Scene.qpos` takes them: by name, or as an array where the order is the hand's."""
        joints = self.stages[stage].joints
        return joints if self.joint_names is None else dict(zip(self.joint_names, joints.T, strict=True))


def concatenate(parts: Sequence[GraspSet]) -> GraspSet:
    """Puts grasps of several files after each other.

    Joints come in the order of the first part. Stages that a part lacks are left out; columns that it lacks, or has
    fewer entries of, are filled with NaN or empty text.

    Args:
        parts: At least one.

    Raises:
        FileError: Parts have other joints than the first one.
    """
    first, *others = parts
    if not others:
        return first
    parts = [first, *(in_order_of(first, part) for part in others)]
    having = Counter(name for part in parts for name in part.stages)
    shared = [name for name in first.stages if having[name] == len(parts)]
    some = {name: count for name, count in having.items() if count < len(parts)}
    absent = [f"{name} is left out: {count:,} of {len(parts):,} files have it" for name, count in some.items()]
    columns = list(dict.fromkeys(name for part in parts for name in part.columns))
    return GraspSet(
        stages={
            name: HandPoses(
                np.concatenate([part.stages[name].base for part in parts]),
                np.concatenate([part.stages[name].joints for part in parts]),
            )
            for name in shared
        },
        joint_names=first.joint_names,
        object_pose=np.concatenate([part.object_pose for part in parts]),
        object_scale=np.concatenate([part.object_scale for part in parts]),
        object_name=np.concatenate([part.object_name for part in parts]),
        source=np.concatenate([part.source for part in parts]),
        columns={name: joined for name in columns if (joined := _joined(name, parts)) is not None},
        notes=tuple(dict.fromkeys([*(note for part in parts for note in part.notes), *absent])),
    )


def in_order_of(first: GraspSet, part: GraspSet) -> GraspSet:
    """The grasps of a part with their joints in the order of another one's.

    Raises:
        FileError: It has other joints.
    """
    ours, theirs = first.joint_names, part.joint_names
    widths = [x.stages[GRASP].joints.shape[1] for x in (first, part)]
    file, other = (x.source[0].rpartition(":")[0] for x in (part, first))
    if ours is None and theirs is None:
        if widths[0] != widths[1]:
            raise FileError(file, "joints", f"{widths[1]} beside {widths[0]} of {other}", "files of one hand")
        return part
    if ours is None or theirs is None or sorted(ours) != sorted(theirs):
        missing = [name for name in ours or () if name not in (theirs or ())]
        got = f"names other than those of {other}" if ours and theirs else f"no names beside those of {other}"
        if ours is None:
            got = f"names, and {other} has none"
        if theirs and missing:
            got = f"no joint {missing[0]!r}, which {other} has"
        raise FileError(file, "joint_names", got, "files of one hand")
    if ours == theirs:
        return part
    order = [theirs.index(name) for name in ours]
    stages = {name: HandPoses(stage.base, stage.joints[:, order]) for name, stage in part.stages.items()}
    return replace(part, stages=stages, joint_names=ours)


def _joined(name: str, parts: Sequence[GraspSet]) -> np.ndarray | None:
    """A column of all parts; None where they do not go together."""
    present = [part.columns[name] for part in parts if name in part.columns]
    text = {column.dtype.kind == "U" for column in present}
    if len(text) > 1 or len({column.ndim for column in present}) > 1:
        return None
    whole = len(present) == len(parts) and len({column.shape[1:] for column in present}) == 1
    if whole:
        return np.concatenate(present)
    shape = tuple(np.max([column.shape[1:] for column in present], axis=0).astype(int)) if present[0].ndim > 1 else ()
    kind = np.result_type(*present) if text == {True} else np.float64
    out = np.full((sum(map(len, parts)), *shape), "" if text == {True} else np.nan, kind)
    start = 0
    for part in parts:
        if name in part.columns:
            column = part.columns[name]
            places = (slice(start, start + len(part)), *(slice(0, size) for size in column.shape[1:]))
            out[places] = column
        start += len(part)
    return out
