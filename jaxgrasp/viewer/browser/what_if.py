"""A grasp as it is, or with other friction, another load or moved contacts: its margin, forces, and what ends it."""

from dataclasses import dataclass, replace
from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float

from jaxgrasp.contact import Contacts, required_wrench
from jaxgrasp.explanation import explain
from jaxgrasp.ranking.tiles import columns_of, contacts_of, load_of, task_of
from jaxgrasp.robustness import blocking_forces, largest_disturbance, least_effort
from jaxgrasp.solvers.status import Status
from jaxgrasp.viewer.browser.viewed import Viewed


@dataclass(frozen=True, kw_only=True)
class Change:
    """What is changed of a grasp."""

    friction: float = 1.0
    """Factor on the friction coefficients of all contacts."""

    load: float | None = None
    """The force that the grasp must supply against its load, N: along its own required wrench, which is scaled, or
    against a weight along -z where it has none. None is its own."""

    share: float = 0.75
    """The part of the margin for which the tightening forces hold."""

    shifts: Float[np.ndarray, "contacts 2"] | None = None
    """How far each contact is moved along its tangents t1 and t2, m; its normal, and what the hand can do there, stay.
    None moves none."""


@dataclass(frozen=True, kw_only=True)
class Answer:
    """What the programs say of one grasp; vectors are in the object's frame."""

    positions: Float[np.ndarray, "contacts 3"]
    """Contact positions about the centre of mass, m."""
    normals: Float[np.ndarray, "contacts 3"]
    """Outward normals."""
    friction: Float[np.ndarray, " contacts"]
    """Coulomb's coefficients."""
    max_force: Float[np.ndarray, " contacts"]
    """Largest normal forces, N."""
    active: Bool[np.ndarray, " contacts"]
    """False where a contact is absent."""
    load: Float[np.ndarray, "6"]
    """The wrench that the contacts must supply, N and N m."""
    margin: float
    """lambda of (21), multiples of the disturbances."""
    upper_bound: float
    """A certified upper bound of it."""
    status: Status
    """Of (21)."""
    forces: Float[np.ndarray, "contacts 3"]
    """Tightening forces f_0 of (22) on the object, N; NaN where there is no answer."""
    tightening_status: Status
    """Of (22)."""


@dataclass(frozen=True, kw_only=True)
class Reasons:
    """What ends the margin of one grasp."""

    words: tuple[str, ...]
    """The same in words, see `Explanation.words`."""
    binding: int | None
    """The contact with the largest part in it; None where no contact ends it, or the actuators do more than any."""
    direction: Float[np.ndarray, "6"]
    """The worst disturbance of the set, N and N m, object frame; NaN where there is none."""
    answers: Float[np.ndarray, "contacts 3"]
    """What the fingers add while it acts, N, object frame: blocking forces (15); NaN where there is none."""


def load_size(viewed: Viewed, row: int) -> float:
    """The force that a grasp must supply as it is, N."""
    return float(np.linalg.norm(_own_load(columns_of(viewed.candidates.take(np.array([row]))), viewed)[0, :3]))


def problem(viewed: Viewed, row: int, change: Change) -> tuple[Contacts, dict[str, Any]]:
    """The contacts (1, n_c) of a changed grasp, and the arguments of the programs beside contacts and disturbances.

    Args:
        viewed: The grasps.
        row: Which of them.
        change: What is changed.
    """
    columns = columns_of(viewed.candidates.take(np.array([row])))
    contacts, load = contacts_of(columns), _own_load(columns, viewed)
    if change.load is not None:
        size = np.linalg.norm(load[:, :3], axis=-1, keepdims=True)
        weight = np.asarray(required_wrench(change.load, gravity=jnp.array([0.0, 0.0, -1.0])))
        load = np.where(size > 0, load * change.load / np.where(size > 0, size, 1), weight)
    contacts = replace(contacts, friction=contacts.friction * change.friction)
    if change.shifts is not None:
        moved = jnp.einsum("nct,ncit->nci", jnp.asarray(change.shifts)[None], contacts.frames[..., :2])
        contacts = replace(contacts, positions=contacts.positions + moved)
    task = task_of(columns, None, viewed.cone_edges)
    return contacts, task | {"required_wrench": jnp.asarray(load)}


def answer(viewed: Viewed, row: int, change: Change) -> Answer:
    """Solves (21) and (22) for a changed grasp.

    Args:
        viewed: The grasps.
        row: Which of them.
        change: What is changed.
    """
    contacts, task = problem(viewed, row, change)
    best = largest_disturbance(contacts, viewed.disturbances, **task)
    # An infinite margin says that nothing disturbs the grasp: what remains to be asked is that it bears its load.
    unbounded = best.status == Status.UNBOUNDED
    wanted = jnp.where(unbounded, 0.0, jnp.maximum(best.margin, 0.0) * change.share)
    hold = least_effort(contacts, viewed.disturbances, wanted, **task)
    one = lambda x: np.asarray(x)[0]
    return Answer(
        positions=one(contacts.positions),
        normals=one(contacts.frames)[..., 2],
        friction=one(contacts.friction),
        max_force=one(contacts.max_force),
        active=one(contacts.active),
        load=one(task["required_wrench"]),
        margin=float(one(best.margin)) + 0.0,
        upper_bound=float(one(best.upper_bound)) + 0.0,
        status=Status(int(one(best.status))),
        forces=one(hold.forces_in_object_frame(contacts)),
        tightening_status=Status(int(one(hold.status))),
    )


def reasons(viewed: Viewed, row: int, change: Change) -> Reasons:
    """Explains the margin of a changed grasp.

    Args:
        viewed: The grasps.
        row: Which of them.
        change: What is changed.
    """
    contacts, task = problem(viewed, row, change)
    found = explain(contacts, viewed.disturbances, **task)
    # A margin of zero has its reason in words: there is no contact to name, and nothing to play.
    ended = int(found.zero[0]) < 0
    shares = np.asarray(found.slip + found.press)[0] * ended
    most = max(float(found.actuators[0]), 1e-6)
    added = blocking_forces(contacts, jnp.nan_to_num(found.direction)[:, None])[0, 0, :, :3]
    turned = np.asarray(jnp.einsum("cij,cj->ci", contacts.frames[0], added))
    direction = np.where(ended, np.asarray(found.direction)[0], np.nan)
    return Reasons(
        words=tuple(found.words(0)),
        binding=int(shares.argmax()) if shares.max() > most else None,
        direction=direction,
        answers=np.where(np.isfinite(direction).all(), turned, np.nan),
    )


def _own_load(columns: dict[str, np.ndarray], viewed: Viewed) -> Float[np.ndarray, "1 6"]:
    """The wrench that a grasp must supply as it is."""
    load = load_of(columns, viewed.gravity)
    return np.zeros((1, 6)) if load is None else np.asarray(load, float)
