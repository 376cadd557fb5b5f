"""A squeeze from the model alone: where servos must be sent so that the forces of (22) arrive at the object.

Servos have to go through the gap, through the softness of the contacts and through dry friction before they press. For
contact k with outward normal n_k, Jacobian J_k and gap g_k, let B be the actuators' columns on the joints, T^+ = (B')^+
the joints' motion with the lengths of the actuators, and m_k = n_k' J_k T^+.

1. Contacts. Of links that share a servo (a finger), one: that which touches after the least travel of the servos,
   max(g_k, 0) / |m_k|; a force planned on a link that never touches is missing elsewhere. Where (21) has no margin so,
   all links.
2. Forces. f of (22), without a load, at half the margin of (21), made so strong that the largest normal force is f_max,
   or less where an actuator reaches its limit. Without a load f is internal, so that it may be made stronger.
3. Way. Lengths c_1 = argmin sum_k w_k (m_k c + g_k + r_k)^2 + rho^2 |T^+ c|^2, w_k = f_n,k / f_max: through the gap g_k
   and as deep, r_k, as the contact must be to bear its force.
4. Press. u = B^+ (J'f - springs), and what dry friction takes beside: c_2 = K^-1 (u + sign(u) min(|u|, |B|' friction)).

The squeeze is q + T^+ (c_1 + c_2). Motors have no length to be sent to: their command is their effort.
"""

from collections.abc import Callable
from dataclasses import dataclass, fields

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, Int

from jaxgrasp.contact import Contacts
from jaxgrasp.contact.friction import pyramid_facets
from jaxgrasp.disturbance import DisturbanceSet
from jaxgrasp.hands.bodies import admissible_configurations
from jaxgrasp.hands.grasps import HandGrasps
from jaxgrasp.hands.hand_object import HandObject
from jaxgrasp.hands.softness import depths
from jaxgrasp.robustness import largest_disturbance, least_effort
from jaxgrasp.solvers import solve_qp
from jaxgrasp.solvers.status import Status

# Of the margin; the forces are scaled, so it hardly matters.
_SHARE = 0.5
# m/rad, a finger's radius: motion about an axis nearer to a contact slides along the surface rather than closing a gap.
_RADIUS = 1e-2
# m, with a margin below that of the solver's tolerance there is none; and a link that no servo moves touches if nearer.
_NO_MARGIN, _TOUCHING = 1e-6, 5e-4
# m per unit of a servo's motion: less is none.
_NO_LEVER = 1e-6
# Steps of normal force in which softness is tabulated, and contacts in steps of which few programs serve all.
_STEPS, _SLOTS = 41, 4
_EDGES = 8
# Grasps at a time.
_TILE, _LEAST_TILE = 256, 16
# Of singular values, and of efforts and lengths beside others.
_RANK, _NEXT_TO_NOTHING = 1e-9, 1e-9
# Of a force near half of f_max against balance, where there is no margin.
_EVEN = 0.3


@dataclass(frozen=True, kw_only=True)
class Squeezable:
    """What the rule needs of n grasps; of several scenes where the hand is the same."""

    positions: Float[np.ndarray, "n contacts 3"]
    """m, object frame about its centre of mass."""
    frames: Float[np.ndarray, "n contacts 3 3"]
    friction: Float[np.ndarray, "n contacts"]
    active: Bool[np.ndarray, "n contacts"]
    jacobian: Float[np.ndarray, "n contacts 3 joints"]
    """Contact frames; joints are those that follow none."""
    gap: Float[np.ndarray, "n contacts"]
    """m, negative where they penetrate."""
    softness: Float[np.ndarray, "n contacts forces"]
    """m, depths at which the contacts bear normal forces, evenly from 0 to f_max."""
    transmission: Float[np.ndarray, "n joints actuators"]
    limits: Float[np.ndarray, "n actuators 2"]
    """N m or N, at rest in the grasp; infinite where there are none."""
    lengths: Float[np.ndarray, "n actuators"]
    springs: Float[np.ndarray, "n joints"]
    dry: Float[np.ndarray, "n actuators"]
    """N m or N, what dry friction takes of each actuator's effort."""
    following: Float[np.ndarray, "n all joints"]
    """All joints' motion with those that follow none."""
    known: Bool[np.ndarray, " n"]
    """Whether the configuration is one."""
    object_position: Float[np.ndarray, "n 3"]
    """Of the object's centre of mass, m, world frame."""
    object_rotation: Float[np.ndarray, "n 3 3"]

    @classmethod
    def joined(cls, parts: "list[Squeezable]") -> "Squeezable":
        """Those of several scenes after each other."""
        return cls(**{each.name: np.concatenate([getattr(part, each.name) for part in parts]) for each in fields(cls)})


@dataclass(frozen=True, kw_only=True)
class Squeezes:
    """Of n grasps."""

    joints: Float[np.ndarray, "n all"]
    """How far each of the hand's joints is sent beyond the grasp, rad or m; NaN where nothing is near."""
    controls: Float[np.ndarray, "n actuators"]
    """Commands of the actuators for that."""
    points: Float[np.ndarray, "n contacts 3"]
    """Of the contacts, m, world frame; NaN where there is none."""
    forces: Float[np.ndarray, "n contacts 3"]
    """That the fingers are to exert on the object there, N, world frame; 0 for contacts that take no part."""
    torques: Float[np.ndarray, "n joints"]
    """J'f, N m or N."""
    margin: Float[np.ndarray, " n"]
    """(21), with the contacts that take part; NaN where there is no configuration."""
    effort: Float[np.ndarray, " n"]
    """1/2 f'f, N^2."""
    status: Int[np.ndarray, " n"]
    """`Status` of (21)."""


def squeezable(hand: HandObject, qpos: Float[np.ndarray, "n nq"], grasps: HandGrasps | None = None) -> Squeezable:
    """Finds what the rule needs of grasps of one scene.

    Args:
        hand: The hand and the object.
        qpos: Their configurations.
        grasps: Of these, where they are known already.

    Raises:
        ValueError: Nothing acts on the hand.
    """
    grasps = hand.grasps(qpos, "mujoco") if grasps is None else grasps
    own, model = hand._actuators, hand.model
    if grasps.actuation is None or not len(own.numbers):
        raise ValueError("hand: it has no actuators; wanted some, or a servo gain (--servo-gain)")
    known = admissible_configurations(model, qpos, np)
    contacts, actuation = jax.tree.map(np.asarray, (grasps.contacts, grasps.actuation))
    active = contacts.active & known[:, None]
    transmission = actuation.transmission[..., : len(own.numbers)]
    joints = np.where(known[:, None], qpos, model.qpos0)[:, model.jnt_qposadr[hand.joints]]
    following = hand.couplings.velocities(joints, np)
    shift = np.asarray(grasps.spring_efforts)[:, : len(own.numbers)]
    lower, upper = (side[:, : len(own.numbers)] - shift for side in (actuation.lower, actuation.upper))
    inside = lambda x: np.where(known.reshape(-1, *[1] * (x.ndim - 1)), x, 0)
    return Squeezable(
        positions=inside(contacts.positions),
        frames=np.where(active[..., None, None], contacts.frames, np.eye(3)),
        friction=contacts.friction,
        active=active,
        # Moments about the normals take no part: hard fingers squeeze.
        jacobian=inside(actuation.jacobian[..., :3, :]),
        gap=np.where(active, np.asarray(grasps.distances), 0),
        softness=depths(hand, np.asarray(grasps.links), np.linspace(0, hand.max_force, _STEPS)),
        transmission=transmission,
        limits=np.stack([lower, upper], -1),
        lengths=np.asarray(grasps.actuator_lengths),
        springs=np.asarray(grasps.spring_torques),
        dry=_dry(transmission, following, hand._mechanics.passive.friction),
        following=following,
        known=known,
        object_position=np.asarray(grasps.object_position),
        object_rotation=np.asarray(grasps.object_rotation),
    )


def squeezes(
    hand: HandObject,
    given: Squeezable,
    closing: Float[np.ndarray, "n all"] | None = None,
    *,
    progress: Callable[[int], None] | None = None,
) -> Squeezes:
    """Squeezes by the rule.

    Args:
        hand: The hand, of any of the scenes.
        given: What is known of the grasps.
        closing: How the joints go on closing where nothing is near, rad or m; None does not move them.
        progress: Called with the number of grasps done. KeyboardInterrupt from it ends the work.

    Returns:
        Of all grasps, or after KeyboardInterrupt of the first ones.
    """
    count = len(given.known)
    used = max(1, int(given.active.sum(-1).max(initial=1)))
    slots = min(given.active.shape[1], -(-used // _SLOTS) * _SLOTS)
    size = min(_TILE, -(-count // _LEAST_TILE) * _LEAST_TILE)
    parts = []
    for first in range(0, count, size):
        # The last tile is filled up, so that one compilation serves all.
        rows = np.arange(first, first + size) % count
        own = Squeezable(**{each.name: getattr(given, each.name)[rows] for each in fields(Squeezable)})
        found = _squeezes(hand, _trimmed(own, slots), None if closing is None else closing[rows])
        parts.append({each.name: getattr(found, each.name)[: count - first] for each in fields(Squeezes)})
        try:
            if progress is not None:
                progress(min(first + size, count))
        except KeyboardInterrupt:
            break
    return Squeezes(**{name: np.concatenate([part[name] for part in parts]) for name in parts[0]})


_OF_CONTACTS = ("positions", "frames", "friction", "active", "jacobian", "gap", "softness")


def _trimmed(given: Squeezable, slots: int) -> Squeezable:
    """Without slots that no grasp uses: contacts come in order, those that touch first."""
    cut = {name: getattr(given, name)[:, :slots] for name in _OF_CONTACTS}
    return Squeezable(**{each.name: cut.get(each.name, getattr(given, each.name)) for each in fields(Squeezable)})


def _squeezes(hand: HandObject, given: Squeezable, closing: np.ndarray | None) -> Squeezes:
    chosen, forces, margin, status = _forces(hand, given)
    forces = _scales(hand, given, forces)[:, None, None] * forces
    joints, controls = pressed(hand, given, forces)
    near = np.asarray(np.any(chosen, -1))
    if closing is not None:
        joints = np.where(near[:, None], joints, closing)
    lost = np.flatnonzero(~given.known if closing is not None else ~(near & given.known))
    joints[lost], controls[lost] = np.nan, np.nan
    margin, status = np.where(given.known, margin, np.nan), np.where(given.known, status, Status.INVALID_INPUT)
    points = np.einsum("nij,nkj->nki", given.object_rotation, given.positions) + given.object_position[:, None]
    return Squeezes(
        joints=joints,
        controls=controls,
        points=np.where(given.active[..., None], points, np.nan),
        forces=np.einsum("nab,nkbc,nkc->nka", given.object_rotation, given.frames, forces),
        torques=_torques(given, forces),
        margin=margin,
        effort=0.5 * (forces**2).sum((-1, -2)),
        status=status,
    )


def pressed(
    hand: HandObject, given: Squeezable, forces: Float[np.ndarray, "n contacts 3"]
) -> tuple[Float[np.ndarray, "n all"], Float[np.ndarray, "n actuators"]]:
    """Steps 3 and 4: what makes forces arrive.

    Args:
        hand: The hand.
        given: What is known of the grasps.
        forces: f on the object, N, contact frames.

    Returns:
        How far each of the hand's joints is sent beyond the grasp, rad or m, and commands of the actuators for that.
    """
    servo = hand._actuators.slope < 0
    back = _back(hand, given)
    motion = _motion(given, back)
    weight = (-forces[..., 2] / hand.max_force).clip(0)
    # Way: each contact as deep as it must be to bear its force.
    depth = _at_levels(given.softness, weight)
    slack = _RADIUS**2 * np.einsum("nvu,nvw->nuw", back, back) + _NEXT_TO_NOTHING * np.eye(len(servo))
    normal = np.einsum("nku,nk,nkw->nuw", motion, weight, motion) + slack
    way = np.linalg.solve(normal, -np.einsum("nku,nk->nu", motion, weight * (given.gap + depth))[..., None])[..., 0]
    # Press: through the joints' dry friction.
    effort = np.einsum("nuv,nv->nu", _inverse(given), _torques(given, forces) - given.springs)
    effort = effort + np.sign(effort) * np.minimum(np.abs(effort), given.dry)
    lengths = np.where(servo, way + effort / np.where(servo, -hand._actuators.slope, 1), 0)
    joints = np.einsum("njv,nvu,nu->nj", given.following, back, lengths)
    command = lambda force, at: np.asarray(hand._actuators.command_for(jnp.asarray(force), jnp.asarray(at)))
    controls = np.where(servo, command(0 * effort, given.lengths + lengths), command(effort, given.lengths))
    return joints, controls


def _back(hand: HandObject, given: Squeezable) -> np.ndarray:
    """T^+ (n, joints, actuators); lengths of motors are nothing that they can be sent to."""
    servos = np.where(hand._actuators.slope < 0, given.transmission, 0)
    return np.linalg.pinv(np.swapaxes(servos, -1, -2), _RANK)


def _motion(given: Squeezable, back: np.ndarray) -> np.ndarray:
    """m_k (n, contacts, actuators)."""
    return np.einsum("nkv,nvu->nku", given.jacobian[:, :, 2], back)


def _inverse(given: Squeezable) -> np.ndarray:
    return np.linalg.pinv(given.transmission, _RANK)


def _torques(given: Squeezable, forces: np.ndarray) -> np.ndarray:
    return np.einsum("nkav,nka->nv", given.jacobian, forces)


def _at_levels(softness: np.ndarray, share: np.ndarray) -> np.ndarray:
    """Depths at shares of f_max, (n, contacts); beyond it those of f_max."""
    levels = share.clip(0, 1) * (softness.shape[-1] - 1)
    low = np.minimum(levels.astype(int), softness.shape[-1] - 2)
    begin, end = (np.take_along_axis(softness, (low + k)[..., None], -1)[..., 0] for k in (0, 1))
    return begin + (levels - low) * (end - begin)


def _forces(hand: HandObject, given: Squeezable) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Steps 1 and 2: contacts that take part, forces (contact frames, N), margins and statuses."""
    motion = _motion(given, _back(hand, given))
    pushes = DisturbanceSet.forces(1.0)
    forces, chosen = np.zeros(given.positions.shape), given.active.copy()
    margin, status = np.zeros(len(chosen)), np.zeros(len(chosen), int)
    for active in (given.active, first_to_touch(motion, given.gap, given.active)):
        contacts = Contacts.from_frames(
            given.positions, given.frames, friction=given.friction, max_force=hand.max_force, active=active
        )
        best = largest_disturbance(contacts, pushes)
        found, code = np.nan_to_num(np.asarray(best.margin)), np.asarray(best.status)
        answer = np.asarray(least_effort(contacts, pushes, _SHARE * found.clip(0)).forces)
        # The first choice, all links, counts where the second one has no margin.
        better = (found > _NO_MARGIN) & np.isfinite(answer).all((-1, -2))
        better |= active is given.active
        margin, status = np.where(better, found.clip(0), margin), np.where(better, code, status)
        fine = better & (found > _NO_MARGIN)
        forces = np.where(fine[:, None, None], np.where(active[..., None], answer, 0), forces)
        chosen = np.where(fine[:, None], active, chosen)
    without = margin <= _NO_MARGIN
    if without.any():
        forces = np.where(without[:, None, None], _nearest_to_balance(hand, given), forces)
    return chosen, forces, margin, status


def first_to_touch(
    motion: Float[np.ndarray, "n contacts actuators"],
    gap: Float[np.ndarray, "n contacts"],
    active: Bool[np.ndarray, "n contacts"],
) -> Bool[np.ndarray, "n contacts"]:
    """Of each finger's contacts the one that touches after the least travel, the outermost of those that touch already.

    A finger is what shares servos. A link that no servo moves counts where it touches.

    Args:
        motion: m_k, of the contacts along their normals with the lengths of the servos.
        gap: m.
        active: Which contacts there are.
    """
    lever, moved = np.linalg.norm(motion, axis=-1), np.abs(motion) > _NO_LEVER * 1e-3
    keep = active & (lever <= _NO_LEVER) & (gap < _TOUCHING)
    for row in range(len(gap)):
        left = np.flatnonzero(active[row] & (lever[row] > _NO_LEVER)).tolist()
        while left:
            finger = [k for k in left if (moved[row, k] & moved[row, left[0]]).any()]
            travel = gap[row, finger].clip(0) / lever[row, finger]
            keep[row, finger[int(np.lexsort((-lever[row, finger], travel))[0])]] = True
            left = [k for k in left if k not in finger]
    return keep


def _scales(hand: HandObject, given: Squeezable, forces: np.ndarray) -> np.ndarray:
    """How much stronger forces are made, (n,): until a contact bears f_max, or an actuator its limit."""
    strongest = (-forces[..., 2]).max(-1)
    scale = np.where(strongest > 0, hand.max_force / np.where(strongest > 0, strongest, 1), 0)
    effort = np.einsum("nuv,nv->nu", _inverse(given), _torques(given, forces))
    room = np.where(effort > 0, given.limits[..., 1], given.limits[..., 0])
    pulls = np.abs(effort) > _NEXT_TO_NOTHING
    most = np.where(pulls, room / np.where(pulls, effort, 1), np.inf).min(-1, initial=np.inf).clip(0)
    return np.minimum(scale, most)


def _nearest_to_balance(hand: HandObject, given: Squeezable) -> np.ndarray:
    """Forces in the pyramids that come nearest to balance, each near half of f_max."""
    count, slots = given.active.shape
    use = given.active[..., None, None]
    turned = np.where(use, given.frames, 0)
    size = np.linalg.norm(given.positions, axis=-1)
    size = np.where(given.active, size, 0).sum(-1) / given.active.sum(-1).clip(1)
    moments = np.cross(given.positions[..., None, :], np.swapaxes(turned, -1, -2)).swapaxes(-1, -2)
    moments = moments / np.where(size > 0, size, 1)[:, None, None, None]
    G = np.concatenate([turned, moments], -2).transpose(0, 2, 1, 3).reshape(count, 6, 3 * slots)
    pick = np.zeros((slots, 3 * slots))
    pick[np.arange(slots), 3 * np.arange(slots) + 2] = _EVEN
    P = np.swapaxes(G, -1, -2) @ G + pick.T @ pick + 1e-9 * np.eye(3 * slots)
    q = np.broadcast_to(_EVEN * hand.max_force / 2 * pick.sum(0), (count, 3 * slots))
    facets = pyramid_facets(_EDGES) * np.stack([np.ones_like(given.friction)] * 2 + [given.friction], -1)[:, :, None]
    cones = np.einsum("cd,ncea->nceda", np.eye(slots), facets).reshape(count, -1, 3 * slots)
    found = np.asarray(solve_qp(P, q, G=cones, h=np.zeros(cones.shape[:2])).x).reshape(count, slots, 3)
    return np.where(given.active[..., None], np.nan_to_num(found), 0)


def _dry(transmission: np.ndarray, following: np.ndarray, friction: np.ndarray) -> np.ndarray:
    """|B|' of the friction of joints, and of those that follow them, (n, actuators)."""
    own = np.einsum("njv,j->nv", np.abs(following), friction)
    return np.einsum("nvu,nv->nu", np.abs(transmission), own)
