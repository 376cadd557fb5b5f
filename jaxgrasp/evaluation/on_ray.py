"""The same trials on a cluster: Ray gives grasps of one scene to workers, and does again what a lost one had.

Every node must see the hand's and the objects' files by the same paths.
"""

from collections.abc import Callable, Sequence
from dataclasses import fields
from os import PathLike
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from jaxgrasp.cluster import Cluster
from jaxgrasp.evaluation.evaluate import Evaluation, evaluate
from jaxgrasp.files import GraspSet
from jaxgrasp.files.objects import grouped
from jaxgrasp.simulation import Protocol

# Grasps of a task, at most: some ten seconds of a processor, beside which making the scene is little.
_TASK = 32
# Fields of an evaluation with a row for each grasp.
_ROWS = tuple(f.name for f in fields(Evaluation) if f.name not in ("protocol", "grasps", "said", "interrupted"))


class _Tried(NamedTuple):
    """The results of one task."""

    columns: dict[str, np.ndarray]
    skipped: list[str]
    failed: ValueError | None
    """The error of an object that is not to be passed over; None without one."""


def evaluate_on_ray(
    cluster: Cluster,
    grasps: GraspSet,
    *,
    hand: str | PathLike,
    object: str | PathLike | Sequence[str | PathLike],
    protocol: str | Protocol = "dexgraspbench-fc",
    servo_gain: float | None = None,
    progress: Callable[[int], None] | None = None,
    skipped: Callable[[ValueError], None] | None = None,
) -> Evaluation:
    """Tries grasps in C MuJoCo by a named protocol on a cluster.

    Args:
        cluster: Of `jaxgrasp.cluster.joined`.
        grasps: As for `evaluate`, like all that follow.
        hand: A name, or a file that all nodes see.
        object: Likewise.
        protocol: One of `jaxgrasp.simulation.PROTOCOLS`, by its name, or your own.
        servo_gain: N m/rad.
        progress: Called with the number of grasps done. KeyboardInterrupt from it ends the trials, and what was done is
            kept.
        skipped: Called with what is wrong with a scene; None raises it.

    Returns:
        What became of each grasp: what `evaluate` says.

    Raises:
        ValueError: Hand, object, protocol or grasps cannot be used.
        RuntimeError: A task failed for another reason than that its worker was lost.
    """
    ray = cluster.ray
    options = {"hand": _everywhere(hand), "protocol": protocol, "servo_gain": servo_gain}
    # What is wrong with the hand or the protocol is said before any task begins.
    none = evaluate(grasps.take(np.zeros(0, int)), object=object, **options)
    task = ray.remote(_tried).options(**cluster.each)
    rows_of: dict[Any, np.ndarray] = {}
    for group in grouped(grasps, object):
        for start in range(0, len(group.rows), _TASK):
            rows = group.rows[start : start + _TASK]
            given = {**options, "object": _everywhere(group.object)}
            rows_of[task.remote(grasps.take(rows), given, skipped is not None)] = rows
    report, tell = progress or (lambda _: None), skipped or (lambda _: None)
    found: dict[Any, _Tried] = {}
    waiting, interrupted, done = list(rows_of), False, 0
    told: dict[str, None] = {}
    try:
        while waiting:
            (finished, *_), waiting = ray.wait(waiting)
            found[finished] = result = ray.get(finished)
            if result.failed is not None:
                raise result.failed
            for line in result.skipped:
                if line not in told:
                    tell(ValueError(line))
            told |= dict.fromkeys(result.skipped)
            done += len(rows_of[finished])
            report(done)
    except KeyboardInterrupt:
        interrupted = True
    except ray.exceptions.RayError as error:
        raise RuntimeError(str(error).strip().splitlines()[0]) from error
    finally:
        for given_up in waiting:
            ray.cancel(given_up, force=True)
    rows = np.concatenate([np.zeros(0, int), *(rows_of[key] for key in found)])
    order = np.argsort(rows)
    columns = {name: [getattr(none, name), *(each.columns[name] for each in found.values())] for name in _ROWS}
    return Evaluation(
        protocol=none.protocol,
        grasps=grasps.take(rows[order]),
        **{name: np.concatenate(parts)[order] for name, parts in columns.items()},
        said=none.said,
        interrupted=interrupted,
    )


def _tried(grasps: GraspSet, options: dict[str, Any], pass_over: bool) -> _Tried:
    skipped: list[str] = []
    try:
        tell = (lambda error: skipped.append(str(error))) if pass_over else None
        found = evaluate(grasps, **options, workers=1, skipped=tell)
    except ValueError as error:
        # Ray would wrap it.
        return _Tried({}, skipped, error)
    return _Tried({name: getattr(found, name) for name in _ROWS}, skipped, None)


def _everywhere(path: str | PathLike) -> str:
    """A file by a path that means the same to every process; a name as it is."""
    return str(Path(path).absolute()) if Path(path).exists() else str(path)
