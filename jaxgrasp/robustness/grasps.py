"""From the public, batch-first arguments to the lanes that the kernels work on, with every check of the data."""

import functools
import math
from dataclasses import dataclass, replace
from typing import Any

import jax
import jax.numpy as jnp
from jax import lax

from jaxgrasp import linalg
from jaxgrasp.arrays import fold
from jaxgrasp.compiling import compiled
from jaxgrasp.contact.compliance import Compliance, inverse_root, is_full
from jaxgrasp.contact.contacts import Contacts, rotations
from jaxgrasp.contact.grasp_map import grasp_columns
from jaxgrasp.disturbance.terms import Term
from jaxgrasp.kernels import usable
from jaxgrasp.lanes.differentiable import BatchedFunction, Lanes, differentiable
from jaxgrasp.lanes.direct import cut
from jaxgrasp.lanes.tiles import LOOSE_TILE, TILE
from jaxgrasp.robustness.actuators import Actuated, admit_actuation, clip_limits, stack_rows, usable_actuation
from jaxgrasp.robustness.auditing import audited
from jaxgrasp.robustness.interface.arguments import Arguments, GraspData, Inputs, Options, lay_out
from jaxgrasp.robustness.interface.sizes import fill_to_known_size


@jax.tree_util.register_dataclass
@dataclass(frozen=True, kw_only=True)
class Grasps:
    """Grasps in lanes (the trailing axis), made safe: what is absent or not admissible is replaced by harmless data.

    Moments are divided by `length`, so that all wrench components are forces.
    """

    valid: jax.Array
    """(*lanes), bool: all data of the lane are admissible; the others have no contact present."""
    present: jax.Array
    """(n, *lanes), 1 where a contact is there, else 0."""
    rough: jax.Array
    """(n, *lanes), 1 where a contact that is there has friction, else 0; see `admit` for those that have none."""
    turning: jax.Array | None
    """(n, *lanes), 1 where a contact bears a moment about its normal, else 0; None for hard contacts."""
    friction: jax.Array
    """(n, *lanes); 1 where there is none."""
    max_force: jax.Array
    """(n, *lanes), N."""
    length: jax.Array
    """(*lanes), root-mean-square distance of the contacts from the centre of mass, m; 1 where that is zero."""
    units: jax.Array
    """(6, *lanes), what turns wrenches in N and N m to newtons: 1 and 1 / length."""
    columns: jax.Array
    """(6, k, n, *lanes), the blocks of G; zero where absent, and for tangents of contacts without friction. k = 3, or 4
    for soft contacts, whose moments are in newtons, see `Contacts.torsional_arms`."""
    lined: jax.Array
    """bool (*lanes), all contacts are on one line, exactly: two of them always are. G has rank 5 at most."""
    wrench: jax.Array
    """(6, *lanes), b, N."""
    reserve: jax.Array | None
    """d, N: (*lanes), one value a grasp, (n, *lanes), a contact, or (n_e, n, *lanes), a row; zero where absent. None
    where there is none."""
    terms: tuple[Term, ...]
    """The disturbance set, moments in N m; leaves may have lanes of size 1."""
    extents: tuple[jax.Array, ...]
    """The largest |w_i| of every term of the disturbance set, (6, *lanes) each, N and N m."""
    compliance: jax.Array | None
    """Q of each vertex of the disturbance set, or one for all, along the leading axis: blocks (n, 3, 3, *lanes) or full
    (3 n, 3 n, *lanes), the identity for absent contacts; None for Q = I."""
    inverse_root: jax.Array | None
    """M with M M' = Q^-1, see `inverse_root`; None for Q = I."""
    vertex_inverse_roots: jax.Array | None
    """M for each vertex of the disturbance set, along the leading axis."""
    weight_roots: jax.Array | None
    """R with R'R = Q_0, (k, k, n, *lanes) for blocks or (k n, k n, *lanes) for a full Q_0; None for Q_0 = I."""
    options: Options
    """The options of the call, lanes trailing, made safe as well."""
    actuated: Actuated | None
    """The hand's actuators; None where the fingers can push at will."""

    @property
    def transmits(self) -> jax.Array:
        """(k, n, *lanes), 1 where a contact transmits force along t1, t2 and n, and a moment about n, else 0."""
        turning = [] if self.turning is None else [self.turning]
        return jnp.stack([self.rough, self.rough, self.present, *turning])

    @property
    def rows(self) -> jax.Array:
        """(6 + r, k, n, *lanes), the blocks of G, and of N'J' where actuators do not reach every joint direction."""
        return stack_rows(self.columns, self.actuated)

    @property
    def reserves_nothing(self) -> jax.Array:
        """Whether d = 0 in every row, (*lanes)."""
        if self.reserve is None:
            return jnp.ones_like(self.valid)
        zero = self.reserve == 0
        for _ in range(zero.ndim - self.length.ndim):
            zero = fold(jnp.logical_and, zero)
        return zero

    def row_reserves(self, unit: jax.Array, cone_edges: int) -> jax.Array:
        """Give every row its d in units (n, *lanes), N, of its contact: (n_e, n, *lanes), zero where absent."""
        assert self.reserve is not None
        reserve = jnp.where(self.present > 0, self.reserve / unit, 0)
        return jnp.broadcast_to(reserve, (cone_edges, *self.present.shape))

    @property
    def full_weights(self) -> bool:
        """Whether Q_0 is one full matrix."""
        weights = self.options.effort_weights
        return weights is not None and is_full(weights, len(self.present))


def over_grasps(function: BatchedFunction, data: GraspData, options: Options | None = None) -> Any:
    """Check shapes, run a function over all grasps of a batch, audit its results and give them the batch's shape.

    The function takes `Grasps`. It is compiled once for its value and for the shapes, which `sizes` keeps few.

    Args:
        function: what to run; it compares by value.
        data: the grasps.
        options: what is asked for; None is nothing beyond the grasps.

    Raises:
        ValueError: shapes that do not fit.
    """
    options = options or Options()
    fill = fill_to_known_size(function, data, options)
    if fill is None:
        return audited(function, _run(function, data, options), data, options)
    out = _run(function, fill.data, fill.options)
    return cut(audited(function, out, fill.data, fill.options, fill.count), fill.count)


@functools.partial(compiled, static_argnums=(0,), pace=lambda *_: "brief" if usable() else "fast")
def _run(function: BatchedFunction, data: GraspData, options: Options) -> Any:
    """Run the function over the lanes."""
    arguments = lay_out(data, options)
    # Roots of Q take loops over columns, which compact tiles do without.
    compact = function.tile is None and data.compliance is None and options.effort_weights is None
    n, components = data.contacts.n_c, data.contacts.components
    # Soft contacts have twice as many facets.
    rows = n * (function.rows * (components - 2) + 1)
    if data.actuation is not None:
        # The equality rows are what is largest; up to twice as many values were seen to compile.
        joints, actuators = data.actuation.transmission.shape[-2:]
        rows = max(rows, math.ceil((6 + joints) * (components * n + actuators) * TILE / 12_000))
    lanes = Lanes(admit, arguments.shared, rows, compact, function.tile or LOOSE_TILE)
    out = differentiable(function, lanes, arguments.inputs)
    return jax.tree.map(lambda x: x.reshape(*arguments.batch, *x.shape[1:]), out)


def admit_all(arguments: Arguments) -> Grasps:
    """The grasps of public arguments, outside of any kernel."""
    last = lambda x, shared: x[..., None] if shared else jnp.moveaxis(x, 0, -1)
    return admit(jax.tree.map(last, arguments.inputs, arguments.shared))


def admit(inputs: Inputs) -> Grasps:
    """Check the data of every lane, lanes trailing, and replace what cannot be used.

    A contact without friction transmits its normal force alone: its tangents get no columns in G and none in Q and Q_0.
    Its friction becomes 1: with tangential forces that do nothing, the rows of its pyramid then say that it does not
    pull, cos(pi / n_e) f_n <= -d, and not 0 <= -d.
    """
    data, contacts = inputs.data, inputs.data.contacts
    positions, frames, active = contacts.positions, contacts.frames, contacts.active
    load = data.required_wrench
    assert load is not None
    valid = _usable_contacts(contacts)
    rough = active & (contacts.friction > 0)
    arms = contacts.torsional_arms
    turning = None if arms is None else active & (arms > 0)
    parts = [rough, rough, jnp.broadcast_to(active, rough.shape)]
    transmits = jnp.stack(parts if turning is None else [*parts, turning], 1)
    compliance, root, vertex_roots, usable = _roots_of_compliance(data.compliance, transmits)
    valid &= usable
    weights, weight_roots, usable = _roots_of_weights(inputs.options.effort_weights, transmits, valid)
    valid &= usable
    valid &= jnp.isfinite(load).all(0)
    if data.cone_margin is not None:
        valid &= _usable_reserve(data.cone_margin, active)
    for extent in inputs.extents:
        valid &= (jnp.isfinite(extent) & (extent >= 0)).all(0)
    if data.actuation is not None:
        valid &= usable_actuation(data.actuation, active)
    options, valid = _admit_options(inputs.options, valid)

    # A choice of units: nothing that is reported in newtons and metres depends on it.
    length, usable = _length(positions, active & valid, load, inputs.extents)
    valid &= usable
    length = jnp.where(valid, length, 1)
    present, rough = active & valid, rough & valid
    positions = jnp.where(present, jnp.moveaxis(positions, 1, 0), 0)
    frames = jnp.where(jnp.stack([rough, rough, present]), jnp.moveaxis(frames, (1, 2), (0, 1)), 0)
    units = jnp.stack([jnp.ones_like(length)] * 3 + [1 / length] * 3)
    wrench = jnp.where(valid, load, 0)
    friction, max_force = jnp.where(rough, contacts.friction, 1), jnp.where(present, contacts.max_force, 1)
    lined = _lined(positions, present)
    if arms is not None:
        lined &= (jnp.where(present, arms, 0) == 0).all(0)
        arms = jnp.where(present, arms, 0) / length
    actuated = None
    if data.actuation is not None:
        actuated = admit_actuation(data.actuation, transmits & valid, valid, length)
        actuated = clip_limits(actuated, friction, jnp.where(present, max_force, 0))
    return Grasps(
        valid=valid,
        present=present.astype(positions.dtype),
        rough=rough.astype(positions.dtype),
        turning=None if turning is None else (turning & valid).astype(positions.dtype),
        friction=friction,
        max_force=max_force,
        length=length,
        units=units,
        columns=grasp_columns(positions / length, frames, arms),
        lined=lined,
        wrench=wrench * units,
        reserve=None if data.cone_margin is None else _admit_reserve(data.cone_margin, present, valid),
        terms=data.disturbances.terms,
        extents=inputs.extents,
        compliance=compliance,
        inverse_root=root,
        vertex_inverse_roots=vertex_roots,
        weight_roots=weight_roots,
        options=replace(options, effort_weights=weights),
        actuated=actuated,
    )


def _usable_contacts(contacts: Contacts) -> jax.Array:
    """Whether the data of every contact that is there are admissible, (*lanes)."""
    usable = jnp.isfinite(contacts.positions).all(1) & rotations(contacts.frames)
    usable &= (contacts.friction >= 0) & jnp.isfinite(contacts.friction)
    usable &= (contacts.max_force > 0) & jnp.isfinite(contacts.max_force)
    if contacts.torsional_friction is not None:
        usable &= (contacts.torsional_friction >= 0) & jnp.isfinite(contacts.torsional_friction)
    return (usable | ~contacts.active).all(0)


def _usable_reserve(reserve: jax.Array, active: jax.Array) -> jax.Array:
    """Whether d is finite and not negative, where contacts are there, (*lanes)."""
    usable = (reserve >= 0) & jnp.isfinite(reserve)
    if usable.ndim < active.ndim:
        return usable
    usable = fold(jnp.logical_and, jnp.moveaxis(usable, 1, 0)) if usable.ndim > active.ndim else usable
    return (usable | ~active).all(0)


def _admit_reserve(reserve: jax.Array, present: jax.Array, valid: jax.Array) -> jax.Array:
    """Lay out d as in `Grasps`, from (*lanes), (n, *lanes) or (n, n_e, *lanes)."""
    if reserve.ndim < present.ndim:
        return jnp.where(valid, reserve, 0)
    return jnp.where(present, jnp.moveaxis(reserve, 1, 0) if reserve.ndim > present.ndim else reserve, 0)


def _roots_of_compliance(
    compliance: jax.Array | Compliance | None, transmits: jax.Array
) -> tuple[jax.Array | None, jax.Array | None, jax.Array | None, jax.Array]:
    """Q, M with M M' = Q^-1, the same of every vertex of the set, and whether Q is positive definite, (*lanes)."""
    n = transmits.shape[0]
    if compliance is None:
        return None, None, None, jnp.array(True)
    definite = lambda Q, usable: jnp.where(usable, Q, jnp.eye(Q.shape[-2], dtype=Q.dtype)[..., None])
    if not isinstance(compliance, Compliance):
        masked = _masked(compliance, transmits)
        root, usable = inverse_root(masked, n)
        return definite(masked, usable)[None], root, None, usable
    # One Q a direction: the directions trail the lanes while the roots are taken.
    last = jnp.moveaxis(compliance.per_vertex, 0, -1)
    masked = _masked(last, transmits[..., None])
    roots, usable = inverse_root(masked, n)
    assert roots is not None and masked is not None
    usable = usable.all(-1)
    return definite(jnp.moveaxis(masked, -1, 0), usable), None, jnp.moveaxis(roots, -1, 0), usable


def _roots_of_weights(
    weights: jax.Array | None, transmits: jax.Array, valid: jax.Array
) -> tuple[jax.Array | None, jax.Array | None, jax.Array]:
    """Q_0, the identity for absent forces and bad lanes, R with R'R = Q_0, and whether it is definite, (*lanes)."""
    masked = _masked(weights, transmits)
    if masked is None:
        return None, None, jnp.array(True)
    usable = inverse_root(masked, transmits.shape[0])[1]
    axes = (0, 1) if is_full(masked, transmits.shape[0]) else (1, 2)
    definite = jnp.where(valid & usable, masked, jnp.eye(masked.shape[1], dtype=masked.dtype)[..., None])
    roots = linalg.cholesky(jnp.moveaxis(definite, axes, (-1, -2)))
    return definite, jnp.moveaxis(roots, (-1, -2), (0, 1)), usable


def _admit_options(options: Options, valid: jax.Array) -> tuple[Options, jax.Array]:
    """The options with harmless ones for lanes that are not valid, and which lanes still are."""
    margin, smoothing = options.margin, options.smoothing
    if margin is not None:
        valid &= (margin >= 0) & jnp.isfinite(margin)
        margin = jnp.where(valid, margin, 0)
    if smoothing is not None:
        valid &= (smoothing > 0) & jnp.isfinite(smoothing)
        smoothing = jnp.where(valid, smoothing, 1)
    return replace(options, margin=margin, smoothing=smoothing), valid


def _lined(positions: jax.Array, present: jax.Array) -> jax.Array:
    """Whether the points (3, n, *lanes) that are present lie on one line, (*lanes).

    Products are compared, not subtracted: a difference of products may be rounded once or twice, as compilers like.
    """
    first, far = positions[:, 0], jnp.zeros_like(positions[:, 0])
    for i in range(1, positions.shape[1]):
        first = jnp.where(present[:i].any(0), first, positions[:, i])
    apart = jnp.where(present, positions - first[:, None], 0)
    for i in range(positions.shape[1]):
        further = fold(jnp.maximum, jnp.abs(apart[:, i])) > fold(jnp.maximum, jnp.abs(far))
        far = jnp.where(further, apart[:, i], far)
    along = [apart[a] * far[(a + 1) % 3] == apart[(a + 1) % 3] * far[a] for a in range(3)]
    return fold(jnp.logical_and, [row.all(0) for row in along])


def _length(
    positions: jax.Array, present: jax.Array, wrench: jax.Array, extents: tuple[jax.Array, ...]
) -> tuple[jax.Array, jax.Array]:
    """The root-mean-square distance of contacts (n, 3, *lanes), 1 where zero, and whether it can divide moments."""
    own = lax.stop_gradient(jnp.where(present, jnp.moveaxis(positions, 1, 0), 0))
    # In units of the largest, whose square may be more, or less, than there are numbers for.
    largest = fold(jnp.maximum, fold(jnp.maximum, jnp.abs(own)))
    largest = jnp.where(largest > 0, largest, 1)
    count = jnp.maximum(fold(jnp.add, present.astype(own.dtype)), 1)
    mean = fold(jnp.add, fold(jnp.add, (own / largest) ** 2)) / count
    length = largest * jnp.sqrt(jnp.where(mean > 0, mean, 1))
    usable = jnp.isfinite(length) & jnp.isfinite(1 / length)
    for moment in (wrench, *extents):
        usable &= jnp.isfinite(lax.stop_gradient(moment[3:]) / length).all(0)
    return length, usable


def _masked(matrices: jax.Array | None, transmits: jax.Array) -> jax.Array | None:
    """Blocks or full matrices of contacts with the identity's rows and columns for forces that are not transmitted.

    Args:
        matrices: (n, k, k, *lanes) or (k n, k n, *lanes).
        transmits: bool (n, k, *lanes).
    """
    if matrices is None:
        return None
    full = is_full(matrices, transmits.shape[0])
    eye = jnp.eye(matrices.shape[1], dtype=matrices.dtype).reshape(
        (() if full else (1,)) + matrices.shape[1:2] * 2 + (1,) * (transmits.ndim - 2)
    )
    if not full:
        return jnp.where(transmits[:, :, None] & transmits[:, None], matrices, eye)
    there = transmits.reshape(-1, *transmits.shape[2:])
    return jnp.where(there[:, None] & there[None], matrices, eye)
