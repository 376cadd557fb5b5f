"""From configurations of a hand to candidates that can be ranked."""

from collections.abc import Callable
from dataclasses import fields, replace

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, Int

from jaxgrasp.candidates import Candidates
from jaxgrasp.contact import Actuation, Contacts
from jaxgrasp.hands import HandObject

# Configurations at a time.
TILE = 1024
_CONTACTS = tuple(field.name for field in fields(Contacts))
# Fields of `Actuation` that are the same in all configurations where the transmission is constant.
_TRANSMISSION = {"transmission", "inverse", "unreached"}


def candidates_of(
    hand: HandObject,
    qpos: Float[np.ndarray, "batch nq"],
    *,
    source: str,
    limited: bool = True,
    columns: dict[str, np.ndarray] | None = None,
    engine: str | None = None,
    index: Int[np.ndarray, " batch"] | None = None,
    progress: Callable[[int], None] | None = None,
) -> Candidates:
    """Finds the contacts of a hand in many configurations, and what its actuators can do.

    Args:
        hand: The hand and the object.
        qpos: Configurations.
        source: Where they are from.
        limited: Whether the actuators' limits count; else every contact may push with its largest force.
        columns: What else travels along, arrays with a leading axis of N, by name.
        engine: What finds the contacts, see `HandObject.grasps`.
        index: Rows of the configurations in their source; None counts them.
        progress: Called after each tile with the number of configurations done.

    Returns:
        The candidates, with the columns `qpos`, `touching` (how many links touch), `left_out` (how many of these have
        no contact) and `penetration`, m.

    Raises:
        ValueError: A configuration has another length.
    """
    qpos = np.asarray(qpos, float)
    count = len(qpos)
    parts = []
    for first in range(0, count, TILE):
        # The last tile is filled up, so that one compilation serves all, and few serve small batches.
        rows = np.arange(first, first + min(TILE, 1 << (count - 1).bit_length())) % count
        # What is the same for all is kept once.
        stop = {name: 1 for name in _TRANSMISSION} if hand.constant_transmission else {}
        found = _columns(hand, qpos[rows], limited, engine)
        parts.append({name: np.asarray(x)[: stop.get(name, count - first)] for name, x in found.items()})
        if progress is not None:
            progress(min(first + TILE, count))
    found = {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}
    if hand.constant_transmission:
        found |= {
            name: np.broadcast_to(x[:1], (count, *x.shape[1:])) for name, x in found.items() if name in _TRANSMISSION
        }
    contacts = {name: found.pop(name) for name in _CONTACTS if name in found}
    own = {name: found.pop(name) for name in ("touching", "left_out", "penetration")} | {"qpos": qpos}
    return Candidates(
        **contacts,
        mass=np.full(count, hand.object_mass),
        hand=found,
        columns=own | (columns or {}),
        sources=(source,),
        source=np.zeros(count, int),
        index=np.arange(count) if index is None else index,
    )


def kept(candidates: Candidates, min_contacts: int, max_penetration: float) -> Bool[np.ndarray, " batch"]:
    """Which candidates have contacts enough and are not too deep in the object; those not admissible are kept.

    Args:
        candidates: Of `candidates_of`.
        min_contacts: How many contacts must touch.
        max_penetration: How deep hand and object may be in each other, m.
    """
    known = np.isfinite(candidates.hand["required_wrench"]).all(-1)
    fine = (candidates.columns["touching"] >= min_contacts) & (candidates.columns["penetration"] <= max_penetration)
    return fine | ~known


def trimmed(candidates: Candidates) -> Candidates:
    """The candidates without contact slots that none of them uses, in steps of four, so that few programs serve all."""
    most = int(candidates.active.sum(-1).max(initial=1))
    count = min(candidates.num_contacts, -(-most // 4) * 4)
    # Contacts of hands come in order, those that touch first.
    own = {name: getattr(candidates, name) for name in _CONTACTS}
    own = {name: None if column is None else column[:, :count] for name, column in own.items()}
    if "jacobian" in candidates.hand:
        own["hand"] = candidates.hand | {"jacobian": candidates.hand["jacobian"][:, :count]}
    return replace(candidates, **own)


def _columns(hand: HandObject, qpos: np.ndarray, limited: bool, engine: str | None) -> dict[str, jax.Array]:
    grasps = hand.grasps(qpos, engine, actuation=limited)
    columns = {name: getattr(grasps.contacts, name) for name in _CONTACTS}
    columns |= {name: getattr(grasps, name) for name in ("touching", "left_out", "penetration", "required_wrench")}
    if limited and grasps.actuation is not None:
        assert grasps.spring_efforts is not None
        actuation = {f.name: getattr(grasps.actuation, f.name) for f in fields(Actuation)}
        idle, one = (hand.controls(grasps, jnp.full_like(grasps.spring_efforts, effort)) for effort in (0, 1))
        columns |= actuation | {"idle_controls": idle, "controls_per_effort": one - idle}
    return {name: column for name, column in columns.items() if column is not None}
