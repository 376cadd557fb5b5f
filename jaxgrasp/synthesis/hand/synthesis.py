"""Synthesis with a real hand: from a scene to configurations whose grasps have large margins."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh, NamedSharding, PartitionSpec
from jax.typing import ArrayLike
from jaxtyping import Bool, Float, Int, PRNGKeyArray

from jaxgrasp.arrays import as_float
from jaxgrasp.disturbance import DisturbanceSet
from jaxgrasp.hands import HandObject
from jaxgrasp.hands.surroundings import Surroundings
from jaxgrasp.synthesis.hand.descent import CHUNK, State, advance
from jaxgrasp.synthesis.hand.energy import Task, Terms, Weights
from jaxgrasp.synthesis.hand.judgement import Judgement, Verdict, closed, judged, padded
from jaxgrasp.synthesis.hand.starts import random_starts

# Starts at a time: what is done of one batch is not lost with the next.
_BATCH = 1024
# Quantiles of the terms that are recorded.
QUANTILES = (0.1, 0.5, 0.9)


@dataclass(frozen=True, kw_only=True)
class HandSynthesis(Judgement):
    """Grasps of a hand, the good ones first, of these the one with the largest margin."""

    first_margin: Float[np.ndarray, " grasps"]
    """That of the random start of each, with its fingers closed and nothing else done."""
    first_verdict: Int[np.ndarray, " grasps"]
    """`Verdict` of that."""
    record: dict[str, Float[np.ndarray, "steps quantiles"]]
    """Of every term of the energy, as weighted, its quantiles `QUANTILES` over all starts before every step."""
    interrupted: bool
    """Whether it was stopped early; what there was then is here."""

    @property
    def good(self) -> Bool[np.ndarray, " grasps"]:
        """Which grasps have contacts enough, nothing inside anything, and a positive margin."""
        return self.verdict == Verdict.GOOD

    @property
    def first_good(self) -> Bool[np.ndarray, " grasps"]:
        """The same of the random starts whose fingers were only closed."""
        return self.first_verdict == Verdict.GOOD

    def diverse(self, count: int, distance: float = 0.01) -> Int[np.ndarray, " chosen"]:
        """The best good grasps that differ from each other.

        Args:
            count: How many at most.
            distance: Root mean square distance of two grasps' landmarks below which they count as the same, m.

        Returns:
            Their numbers, the best first; fewer than count where there are not as many.
        """
        chosen: list[int] = []
        for number in np.flatnonzero(self.good):
            away = self.landmarks[chosen] - self.landmarks[number]
            if len(chosen) < count and (np.sqrt((away**2).sum(-1).mean(-1)) >= distance).all():
                chosen.append(int(number))
        return np.array(chosen, int)

    def take(self, rows: Int[np.ndarray, " rows"]) -> "HandSynthesis":
        """Some of the grasps."""
        whole = {"record", "interrupted"}
        return HandSynthesis(
            **{f.name: getattr(self, f.name) if f.name in whole else getattr(self, f.name)[rows] for f in fields(self)}
        )


def synthesize_hand_grasps(
    hand: HandObject,
    key: PRNGKeyArray,
    *,
    disturbances: DisturbanceSet | None = None,
    links: Sequence[str] | None = None,
    gravity: ArrayLike | None = None,
    torque_limits: bool = False,
    weights: Weights | None = None,
    starts: int = 1024,
    steps: int = 200,
    min_contacts: int = 3,
    squeeze: float | None = None,
    progress: Callable[[int, int, dict[str, np.ndarray]], None] | None = None,
) -> HandSynthesis:
    """Find configurations of a hand whose grasps of an object withstand much, by gradient from random starts.

    The palm begins before random places of the object's surface. Pose and joint angles go down an energy: distances of
    links and object, penetration of hand and object and of the hand with itself, minus the margin (21) for contacts
    where links are nearest to the object. In the end the fingers are closed until they touch, and every grasp is judged
    as `jaxgrasp rank --scene` would, actuators and weight included.

    Args:
        hand: The hand and the object, one of which is free to be moved.
        key: Of the random numbers; the same one gives the same grasps.
        disturbances: The set D, without batch axes; None is the six unit forces.
        links: Names of the bodies that shall touch the object; None is the outermost one of every finger.
        gravity: In which the object's weight must be borne while the energy falls, m/s^2, world frame; None is the
            scene's. In the end the scene's counts.
        torque_limits: Whether the margin in the energy is the one that the actuators can produce; it costs many times
            as much. In the end it always is.
        weights: Of the terms; None is `Weights()`.
        starts: How many.
        steps: Of each.
        min_contacts: With fewer a grasp is not good.
        squeeze: The margin for which the commands are found by (22), or nine tenths of the grasp's own where that is
            less; None is as many as twice the object's weight has newtons. Soft servos give way under forces that
            cancel each other, and turn the object out of the grasp: more is not better.
        progress: Called every few steps with the numbers of steps done and to be done, over all batches of starts, and
            the record of the batch.

    Returns:
        HandSynthesis, all starts. Ctrl-C ends the descent early: what there is after the first steps is judged and
        returned.

    Raises:
        ValueError: Options that cannot be used, a hand that cannot close or cannot be moved.
    """
    checks = (
        ("starts", starts, starts >= 1, "at least 1"),
        ("steps", steps, steps >= 1, "at least 1"),
        ("min_contacts", min_contacts, min_contacts >= 1, "at least 1"),
        ("squeeze", squeeze, squeeze is None or 0 <= squeeze < np.inf, "a finite number, at least 0"),
    )
    for name, got, admissible, wanted in checks:
        if not admissible:
            raise ValueError(f"{name}: got {got}, wanted {wanted}")
    disturbances = DisturbanceSet.forces(1.0) if disturbances is None else disturbances
    if disturbances.batch_shape != ():
        raise ValueError(f"disturbances: got {disturbances.batch_shape}, wanted a set without batch axes")
    around = Surroundings.of(hand, links)
    task = Task(
        disturbances=disturbances,
        gravity=as_float("gravity", hand.model.opt.gravity if gravity is None else gravity, (3,)),
        weights=Weights() if weights is None else weights,
        steps=jnp.asarray(steps, float),
    )
    begin = random_starts(around, starts, np.random.default_rng(np.asarray(jax.random.key_data(key))))
    ends, record = _descend(around, begin, task, steps, torque_limits, progress)
    weight = hand.object_mass * float(np.linalg.norm(hand.model.opt.gravity))
    wanted = jnp.asarray(2 * weight if squeeze is None else squeeze, float)
    first, found = (
        judged(around, closed(around, qpos), disturbances, min_contacts, wanted) for qpos in (begin[: len(ends)], ends)
    )
    order = np.lexsort((-np.nan_to_num(found.margin, nan=-np.inf), found.verdict != Verdict.GOOD))
    return HandSynthesis(
        **{f.name: getattr(found, f.name)[order] for f in fields(Judgement)},
        first_margin=first.margin[order],
        first_verdict=first.verdict[order],
        record=record,
        interrupted=len(ends) < starts or len(record["distance"]) < steps,
    )


def _descend(
    around: Surroundings,
    begin: np.ndarray,
    task: Task,
    steps: int,
    torque_limits: bool,
    progress: Callable[[int, int, dict[str, np.ndarray]], None] | None,
) -> tuple[np.ndarray, dict[str, np.ndarray]]:
    """Where the starts end, of those that had taken some steps before Ctrl-C, and the record."""
    mesh = Mesh(np.array(jax.local_devices()), ("starts",))
    batches = -(-len(begin) // _BATCH)
    size = -(-len(begin) // batches // mesh.size) * mesh.size
    single = jax.tree.map(lambda x: jnp.asarray(x, jnp.float32), task)
    spread, shared = NamedSharding(mesh, PartitionSpec("starts")), NamedSharding(mesh, PartitionSpec())
    single = jax.device_put(single, shared)
    ends, courses = {}, {}
    try:
        for batch in range(batches):
            rows = padded(begin[batch * size : (batch + 1) * size], size)
            state = jax.device_put(State.from_starts(around, jnp.asarray(rows, jnp.float32)), spread)
            for number in range(0, steps, CHUNK):
                state, terms = advance(state, single, jnp.asarray(number), around, torque_limits, mesh)
                ends[batch] = np.asarray(state.qpos, float)
                courses.setdefault(batch, []).append(jax.tree.map(np.asarray, terms))
                if progress is not None:
                    done = batch * steps + min(number + CHUNK, steps)
                    progress(done, batches * steps, _recorded([courses[batch]], task.weights, steps))
    except KeyboardInterrupt:
        if not ends:
            raise
    found = np.concatenate(list(ends.values()))[: len(begin)]
    return _normalised(around, found), _recorded(list(courses.values()), task.weights, steps)


def _recorded(courses: list[list[Terms]], weights: Weights, steps: int) -> dict[str, np.ndarray]:
    """Quantiles of the weighted terms over the starts of all batches, as far as all of these have come."""
    whole = [jax.tree.map(lambda *parts: np.concatenate(parts)[:steps], *course) for course in courses]
    least = min(len(terms.distance) for terms in whole)
    return {
        name: float(getattr(weights, name))
        * np.quantile(np.concatenate([getattr(t, name)[:least] for t in whole], 1), QUANTILES, axis=1).T
        for name in Terms._fields
    }


def _normalised(around: Surroundings, qpos: np.ndarray) -> np.ndarray:
    """Single precision leaves quaternions' norms off by its rounding."""
    qpos, at = np.array(qpos, float), around.pose + 3
    qpos[:, at : at + 4] /= np.linalg.norm(qpos[:, at : at + 4], axis=-1, keepdims=True)
    return qpos
