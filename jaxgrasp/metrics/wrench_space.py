"""The wrenches along the edges of the friction pyramids, which the field's metrics are made of, and their units."""

import functools
import math
from collections.abc import Callable
from dataclasses import field
from typing import NamedTuple, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Array, Float

from jaxgrasp.arrays import as_float, broadcast_batch, fold_last, safe_norm
from jaxgrasp.compiling import compiled, own_settings
from jaxgrasp.contact import Contacts
from jaxgrasp.contact.contacts import rotations
from jaxgrasp.records import record

T = TypeVar("T")


@record
class WrenchSpace:
    """The conventions on which every metric of wrenches depends: edges, unit of moments and point of reference.

    Forces and moments have different units, so any length of a wrench needs a choice. Compare metrics only where these
    are the same.
    """

    cone_edges: int = field(default=8, metadata={"static": True})
    """n_e, edges of each pyramid, at angles 2 pi k / n_e from t1 on Coulomb's cone; a soft contact has two more,
    of pure torsion +-gamma about its normal."""
    unit_edges: bool = field(default=False, metadata={"static": True})
    """Edges have norm 1 (as in FRoGGeR); else their normal component is 1 (as Ferrari and Canny have it)."""
    length: ArrayLike | None = None
    """(*batch,), m: moments are divided by it. None: the root-mean-square distance of the grasp's own contacts from the
    reference, so that no metric depends on the size of the whole. 1 leaves N m."""
    reference: ArrayLike | None = None
    """(*batch, 3), m, object frame: moments are about this point. None is the origin, the centre of mass."""


class Edges(NamedTuple):
    """Wrenches of all edges, harmless where they cannot be used."""

    wrenches: jax.Array
    """(*batch, n_c, n_e, 6), force and moment / length of a finger that pushes along the edge; zero where absent. Of
    soft contacts (*batch, n_c, n_e + 2, 6)."""
    present: jax.Array
    """(*batch, n_c), bool."""
    valid: jax.Array
    """(*batch,), bool; other grasps have no contact present."""
    grasp_map: jax.Array
    """(*batch, n_c, 6, k), blocks of G, moments / length; zero where absent. k = 3, or 4 with a column for the moment m
    as the force m mu / gamma."""
    length: jax.Array
    """(*batch,), m."""
    forces: jax.Array
    """(*batch, n_c, n_e, k), the edges in contact frames."""
    soft: jax.Array | None
    """(*batch, n_c), bool, which contacts bear moments; the last two edges of others do not count. None: hard ones."""

    @property
    def flat(self) -> jax.Array:
        """(*batch, n_c n_e, 6)."""
        contacts, edges = self.wrenches.shape[-3:-1]
        return self.wrenches.reshape(*self.valid.shape, contacts * edges, 6)

    @property
    def counted(self) -> jax.Array:
        """(*batch, n_c n_e), which of the flat ones are there."""
        if self.soft is None:
            return jnp.repeat(self.present, self.wrenches.shape[-2], -1)
        poles = jnp.stack([self.present & self.soft] * 2, -1)
        pyramid = jnp.stack([self.present] * (self.wrenches.shape[-2] - 2), -1)
        return jnp.concatenate([pyramid, poles], -1).reshape(*self.valid.shape, -1)


@own_settings()
def edge_wrenches(contacts: Contacts, space: WrenchSpace | None = None) -> Float[Array, "*batch contacts edges 6"]:
    """The wrenches by which fingers push along the edges of their friction pyramids.

    Args:
        contacts: the grasps.
        space: conventions; `WrenchSpace()` where None.

    Returns:
        (*batch, n_c, n_e, 6), of soft contacts (*batch, n_c, n_e + 2, 6), forces as multiples of the normal force (or
        of the whole, with `unit_edges`) and moments divided by the length; zero for absent contacts, NaN for grasps
        whose data are not admissible.

    Raises:
        ValueError: options or shapes that do not fit.
    """
    edges = edges_of(contacts, space)
    return jnp.where(edges.valid[..., None, None, None], edges.wrenches, jnp.nan)


def metric(function: Callable[[Contacts, WrenchSpace], T]) -> Callable[..., T]:
    """A metric of contacts in a space, checked, and compiled once for their shapes."""
    run = compiled(function)

    @functools.wraps(function)
    def call(contacts: Contacts, space: WrenchSpace | None = None) -> T:
        return run(contacts, checked(contacts, space))

    return call


def checked(contacts: Contacts, space: WrenchSpace | None) -> WrenchSpace:
    """The space, or the usual one.

    Raises:
        ValueError: these are no contacts, or a space without pyramids.
    """
    if not isinstance(contacts, Contacts):
        raise ValueError(f"contacts: got {type(contacts).__name__}, wanted jaxgrasp.Contacts")
    contacts.check_precision()
    space = space or WrenchSpace()
    if int(space.cone_edges) != space.cone_edges or space.cone_edges < 3:
        raise ValueError(f"cone_edges: got {space.cone_edges}, wanted an integer of at least 3")
    return space


def edges_of(contacts: Contacts, space: WrenchSpace | None = None) -> Edges:
    """See `edge_wrenches`; nothing here is NaN."""
    return _edges(contacts, checked(contacts, space))


@compiled
def _edges(contacts: Contacts, space: WrenchSpace) -> Edges:
    dtype = contacts.positions.dtype
    about = as_float("reference", np.zeros(3) if space.reference is None else space.reference, (3,)).astype(dtype)
    unit = as_float("length", 1.0 if space.length is None else space.length, ()).astype(dtype)
    own = len(contacts.batch_shape)
    batch = broadcast_batch(contacts=contacts.batch_shape, reference=about.shape[:-1], length=unit.shape)
    contacts = jax.tree.map(lambda x: jnp.broadcast_to(x, (*batch, *x.shape[own:])), contacts)
    usable = jnp.isfinite(about).all(-1) & (unit > 0) & jnp.isfinite(unit)
    valid = (_sound(contacts) | ~contacts.active).all(-1) & usable
    present = contacts.active & valid[..., None]
    arms = jnp.where(present[..., None], contacts.positions - about[..., None, :], 0)
    frames = jnp.where(present[..., None, None], contacts.frames, 0)
    friction = jnp.where(present, contacts.friction, 0)
    length = jnp.broadcast_to(jnp.where(usable, unit, 1), batch)
    if space.length is None:
        count = jnp.maximum(present.sum(-1, dtype=dtype), 1)
        length = safe_norm(arms.reshape(*batch, 3 * contacts.n_c)) / jnp.sqrt(count)
        length = jnp.where(length > 0, length, 1)
    moments = jnp.cross(arms[..., None, :], jnp.swapaxes(frames, -1, -2)) / length[..., None, None, None]
    blocks = jnp.concatenate([frames, jnp.swapaxes(moments, -1, -2)], -2)
    soft = None
    if contacts.torsional_friction is not None:
        assert contacts.torsional_arms is not None
        lever = jnp.where(present, contacts.torsional_arms, 0) / length[..., None]
        soft = lever > 0
        turn = lever[..., None] * frames[..., 2]
        blocks = jnp.concatenate([blocks, jnp.concatenate([0 * turn, turn], -1)[..., None]], -1)
    angles = 2 * math.pi * np.arange(space.cone_edges) / space.cone_edges
    circle = jnp.asarray(np.stack([np.cos(angles), np.sin(angles)], -1), dtype)
    tangential = friction[..., None, None] * circle
    forces = jnp.concatenate([tangential, -jnp.ones_like(tangential[..., :1])], -1)
    if soft is not None:
        twist = jnp.where(soft, friction, 0)[..., None, None] * jnp.array([[1.0], [-1.0]], dtype)
        push = jnp.where(soft, -1.0, 0.0).astype(dtype)[..., None, None] * jnp.array([[0.0, 0, 1]], dtype)
        poles = jnp.concatenate([jnp.broadcast_to(push, (*twist.shape[:-1], 3)), twist], -1)
        forces = jnp.concatenate([forces, jnp.zeros_like(forces[..., :1])], -1)
        forces = jnp.concatenate([forces, poles], -2)
    if space.unit_edges:
        forces = forces / jnp.sqrt(1 + friction * friction)[..., None, None]
    blocks = jnp.where(present[..., None, None], blocks, 0)
    wrenches = fold_last(jnp.add, blocks[..., None, :, :] * forces[..., None, :])
    return Edges(wrenches, present, valid, blocks, length, forces, soft)


def hidden(edges: Edges, value: jax.Array) -> jax.Array:
    """NaN for the grasps whose data are not admissible."""
    return jnp.where(edges.valid, value, jnp.nan)


def only_one(contacts: Contacts, other: str) -> None:
    """Refuses batches.

    Args:
        contacts: what came.
        other: what to use in place of the function that calls this.

    Raises:
        ValueError: there are batch axes.
    """
    if isinstance(contacts, Contacts) and contacts.batch_shape:
        raise ValueError(
            f"contacts: got the batch shape {contacts.batch_shape}, wanted one grasp, since convex hulls are made one "
            f"at a time; {other}"
        )


def one_hull(points: np.ndarray):
    """Qhull's convex hull of points (n, 6), or None where they do not span the space.

    Raises:
        ImportError: SciPy is missing.
    """
    try:
        from scipy.spatial import ConvexHull, QhullError
    except ImportError as error:
        raise ImportError("convex hulls need SciPy, which is not installed: pip install scipy") from error
    singular = np.linalg.svd(points - points.mean(0), compute_uv=False)
    if len(points) < 7 or singular[5] <= 1e-9 * singular[0]:
        return None
    try:
        return ConvexHull(points)
    except QhullError:
        return None


def _sound(contacts: Contacts) -> jax.Array:
    lanes = jnp.moveaxis(contacts.frames, (-3, -2, -1), (0, 1, 2))
    sound = jnp.isfinite(contacts.positions).all(-1) & jnp.moveaxis(rotations(lanes), 0, -1)
    sound &= (contacts.friction >= 0) & jnp.isfinite(contacts.friction)
    if contacts.torsional_friction is not None:
        sound &= (contacts.torsional_friction >= 0) & jnp.isfinite(contacts.torsional_friction)
    return sound & (contacts.max_force > 0) & jnp.isfinite(contacts.max_force)
