"""The data of grasps and the options of a call: checked, and laid side by side as lanes.

`GraspData` says what grasps are, `Options` what a caller asks for. Trees parallel to the two say how a leaf lies: its
shape without the batch axes, and whether all grasps share it. An option that is a scalar of each grasp needs nothing
here but its field.
"""

import math
from dataclasses import dataclass, field, replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Array, Float

from jaxgrasp.arrays import as_float, broadcast_batch
from jaxgrasp.contact.actuation import Actuation
from jaxgrasp.contact.compliance import Compliance
from jaxgrasp.contact.contacts import Contacts
from jaxgrasp.disturbance import DisturbanceSet
from jaxgrasp.disturbance.vertices import Vertices
from jaxgrasp.robustness.interface.cone_margins import cone_margin_shape


@jax.tree_util.register_dataclass
@dataclass(frozen=True, kw_only=True)
class GraspData:
    """The data of a batch of grasps; make one with `from_arguments`."""

    contacts: Contacts
    """The contacts; their dtype is the precision of everything."""
    disturbances: DisturbanceSet
    """The set D of disturbances; without batch axes it is shared by all grasps."""
    required_wrench: Float[Array, "*batch 6"] | None
    """b, N and N m; None is zero."""
    compliance: Float[Array, "..."] | Compliance | None
    """Q as blocks (*batch, contacts, k, k) or full (*batch, k contacts, k contacts), or one for each vertex of the
    disturbance set; None is the identity. k = 3, or 4 for soft contacts."""
    cone_margin: Float[Array, "..."] | None
    """d, N: what the facet rows keep in reserve, one value a grasp, a contact or a row; None is nothing."""
    actuation: Actuation | None
    """The limits and transmission of the hand's actuators; None lets every finger push at will."""
    cone_edges: int | None = field(default=None, metadata={"static": True})
    """n_e of the rows that d may tell apart; None where friction cones are exact, or there is no d."""

    @classmethod
    def from_arguments(
        cls,
        contacts: Contacts,
        disturbances: DisturbanceSet,
        required_wrench: ArrayLike | None = None,
        compliance: ArrayLike | Compliance | None = None,
        cone_margin: ArrayLike | None = 0.0,
        actuation: Actuation | None = None,
        cone_edges: int | None = None,
    ) -> "GraspData":
        """The public arguments of these names, of the right kinds.

        Raises:
            ValueError: another kind of argument.
        """
        if not isinstance(contacts, Contacts):
            raise ValueError(f"contacts: got {type(contacts).__name__}, wanted jaxgrasp.Contacts")
        contacts.check_precision()
        if not isinstance(disturbances, DisturbanceSet):
            raise ValueError(f"disturbances: got {type(disturbances).__name__}, wanted jaxgrasp.DisturbanceSet")
        if not isinstance(compliance, Compliance):
            compliance = optional_float("compliance", compliance)
        if actuation is not None and not isinstance(actuation, Actuation):
            raise ValueError(f"actuation: got {type(actuation).__name__}, wanted jaxgrasp.Actuation")
        if actuation is not None and not actuation.transmission.shape[-1]:
            raise ValueError("actuation: got no actuators, wanted at least one; leave it out and fingers push at will")
        return cls(
            contacts=contacts,
            disturbances=disturbances,
            required_wrench=optional_float("required_wrench", required_wrench),
            compliance=compliance,
            cone_margin=optional_float("cone_margin", cone_margin),
            actuation=actuation,
            # Soft contacts have twice as many rows.
            cone_edges=None if cone_edges is None else cone_edges * (contacts.components - 2),
        )


@jax.tree_util.register_dataclass
@dataclass(frozen=True, kw_only=True)
class Options:
    """The wishes of a caller; None where one does not apply."""

    margin: Float[Array, "*batch"] | None = None
    """lambda that (22) is to give, or that (11) is to withstand."""
    smoothing: Float[Array, "*batch"] | None = None
    """kappa of the central point that is asked for in place of the optimum."""
    cutoff: Float[Array, "*batch"] | None = None
    """The least margin that is of interest."""
    effort_weights: Float[Array, "..."] | None = None
    """Q_0 as blocks (*batch, contacts, k, k) or full (*batch, k contacts, k contacts), contact frames; None is the
    identity."""


def optional_float(name: str, value: ArrayLike | None) -> jax.Array | None:
    """`as_float` of an argument that may be left out."""
    return None if value is None else as_float(name, value, ())


@jax.tree_util.register_dataclass
@dataclass(frozen=True, kw_only=True)
class Inputs:
    """The public arguments as batched functions take them."""

    data: GraspData
    """The grasps; the required wrench is always there."""
    options: Options
    """The options of the call."""
    extents: tuple[Float[Array, "*batch 6"], ...]
    """The largest |w_i| of every term of the disturbance set, N and N m; constants to the derivative."""


@dataclass(frozen=True)
class Arguments:
    """The public arguments of all grasps as lanes."""

    inputs: Inputs
    """Leaves (lanes, ...), or without the leading axis where all grasps share them."""
    shared: Inputs
    """A bool for each leaf, parallel to `inputs`: whether all grasps share it."""
    batch: tuple[int, ...]
    """The batch axes that the lanes stand for."""


@dataclass(frozen=True)
class Trailing:
    """The shape of an array without its batch axes; a leaf of trees that are parallel to the arguments."""

    shape: tuple[int, ...]

    def lead(self, array: jax.Array) -> tuple[int, ...]:
        """The batch axes of an array that ends in this shape."""
        return array.shape[: array.ndim - len(self.shape)]


def trailing_shapes(data: GraspData, options: Options) -> tuple[GraspData, Options]:
    """The shapes that leaves have to end in, as parallel trees; without those of the disturbance set."""
    n, k, batch = data.contacts.n_c, data.contacts.components, data.contacts.batch_shape
    alike = lambda tree, shape: jax.tree.map(lambda _: Trailing(shape), tree)
    actuation: Any = data.actuation
    if actuation is not None:
        joints, actuators = actuation.transmission.shape[-2:]
        actuation = replace(
            actuation,
            jacobian=Trailing((n, k, joints)),
            transmission=Trailing((joints, actuators)),
            lower=Trailing((actuators,)),
            upper=Trailing((actuators,)),
            inverse=Trailing((actuators, joints)),
            unreached=jax.tree.map(lambda x: Trailing(x.shape[-2:]), actuation.unreached),
        )
    shapes = replace(
        data,
        contacts=jax.tree.map(lambda x: Trailing(x.shape[len(batch) :]), data.contacts),
        disturbances=None,
        required_wrench=alike(data.required_wrench, (6,)),
        compliance=_compliance_shape(data),
        cone_margin=None,
        actuation=actuation,
    )
    weights = options.effort_weights
    weights = None if weights is None else _matrix_shape("effort_weights", weights, n, k)
    option_shapes = replace(alike(options, ()), effort_weights=weights)
    return replace(shapes, cone_margin=_cone_margin_shape(data, options, shapes, option_shapes)), option_shapes


def lay_out(data: GraspData, options: Options) -> Arguments:
    """Broadcast all arguments to the batch that they have in common.

    Raises:
        ValueError: shapes that do not fit.
    """
    load = np.zeros(6) if data.required_wrench is None else data.required_wrench
    data = replace(data, required_wrench=as_float("required_wrench", load, (6,)))
    _check_vertices(data)
    _check_jacobian(data)
    shapes, option_shapes = trailing_shapes(data, options)
    data, options = moments_in_newtons(data, options)
    disturbances = data.disturbances
    batch = broadcast_batch(
        contacts=data.contacts.batch_shape,
        disturbances=disturbances.batch_shape,
        **_batches(replace(data, contacts=None, disturbances=None), replace(shapes, contacts=None)),
        **_batches(options, option_shapes),
    )
    lead = ()
    if disturbances.batch_shape:
        disturbances, lead = disturbances.spread_over(batch), batch
    inputs = Inputs(
        data=replace(data, disturbances=disturbances),
        options=options,
        extents=tuple(jax.lax.stop_gradient(term.extent()) for term in disturbances.terms),
    )
    after = lambda tree: jax.tree.map(lambda x: Trailing(x.shape[len(lead) :]), tree)
    shapes = Inputs(
        data=replace(shapes, disturbances=after(disturbances)), options=option_shapes, extents=after(inputs.extents)
    )
    shared = jax.tree.map(lambda x, shape: shape.lead(x) == (), inputs, shapes)
    contacts = jax.tree.map(lambda _: False, data.contacts)
    # What belongs to contacts has their axes, so that nobody takes its axes for others.
    reserve = jax.tree.map(
        lambda is_shared, shape: is_shared and not shape.shape, shared.data.cone_margin, shapes.data.cone_margin
    )
    shared = replace(shared, data=replace(shared.data, contacts=contacts, cone_margin=reserve))
    dtype = data.contacts.positions.dtype

    def lay(leaf: jax.Array, shape: Trailing, is_shared: bool) -> jax.Array:
        leaf = leaf if leaf.dtype == bool else leaf.astype(dtype)
        if is_shared:
            return leaf
        return jnp.broadcast_to(leaf, (*batch, *shape.shape)).reshape(math.prod(batch), *shape.shape)

    return Arguments(jax.tree.map(lay, inputs, shapes, shared), shared, batch)


def moments_in_newtons(data: GraspData, options: Options) -> tuple[GraspData, Options]:
    """Turn matrices for forces and moments (f_t1, f_t2, f_n, m) into those for (f_t1, f_t2, f_n, m / arm).

    So all components are newtons, and moments count as much as the tangential forces that use up as much friction. That
    is also what no compliance, or no weights, stand for; MuJoCo's contacts are as stiff. Where a contact bears no
    moment its fourth row and column are those of the identity.
    """
    arms = data.contacts.torsional_arms
    if arms is None:
        return data, options

    def turn(matrices: jax.Array, shape: tuple[int, ...], blocks: bool) -> jax.Array:
        """Turn matrices that end in this shape: blocks by contact, or of all contacts together."""
        factors = jnp.concatenate([jnp.ones((*arms.shape, 3), arms.dtype), arms[..., None]], -1)
        own = (*arms.shape[-1:], 4) if blocks else (4 * arms.shape[-1],)
        directions = (1,) * (len(shape) - len(own) - 1)
        factors = factors.reshape(*arms.shape[:-1], *directions, *own)
        idle = jnp.where(factors == 0, 1, 0)[..., None] * jnp.eye(own[-1], dtype=arms.dtype)
        return matrices.astype(arms.dtype) * factors[..., None] * factors[..., None, :] + idle

    compliance, weights, actuation = data.compliance, options.effort_weights, data.actuation
    shape = _compliance_shape(data)
    if isinstance(compliance, Compliance):
        shape = shape.per_vertex.shape
        compliance = Compliance(per_vertex=turn(compliance.per_vertex, shape, len(shape) == 4))
    elif compliance is not None:
        compliance = turn(compliance, shape.shape, len(shape.shape) == 3)
    if weights is not None:
        own = _matrix_shape("effort_weights", weights, data.contacts.n_c, 4).shape
        weights = turn(weights, own, len(own) == 3)
    if actuation is not None:
        jacobian = actuation.jacobian
        moved = jnp.concatenate([jacobian[..., :3, :], jacobian[..., 3:, :] * arms[..., None, None]], -2)
        actuation = replace(actuation, jacobian=moved)
    return replace(data, compliance=compliance, actuation=actuation), replace(options, effort_weights=weights)


def _batches(tree: Any, shapes: Any) -> dict[str, tuple[int, ...]]:
    """The batch axes of all leaves, by their public names."""
    leaves, ends = jax.tree_util.tree_flatten_with_path(tree)[0], jax.tree.leaves(shapes)
    name = lambda path: jax.tree_util.keystr(path, simple=True, separator=".")
    return {name(path): end.lead(leaf) for (path, leaf), end in zip(leaves, ends, strict=True)}


def _check_vertices(data: GraspData) -> None:
    """Refuse one Q for each direction where the set does not consist of directions."""
    if not isinstance(data.compliance, Compliance):
        return
    terms = data.disturbances.terms
    if len(terms) != 1 or not isinstance(terms[0], Vertices):
        raise ValueError(
            "compliance: got one Q for each direction, wanted a single Q, "
            "since the disturbance set is not given by vertices; use DisturbanceSet.vertices"
        )
    if terms[0].width is not None:
        raise ValueError("compliance: got one Q for each direction, wanted a single Q, since the set is smoothed")


def _check_jacobian(data: GraspData) -> None:
    """Refuse an actuation for another number of contacts."""
    n, k, actuation = data.contacts.n_c, data.contacts.components, data.actuation
    if actuation is not None and actuation.jacobian.shape[-3:-1] != (n, k):
        raise ValueError(
            f"actuation: got a jacobian of shape {actuation.jacobian.shape}, wanted (*batch, {n}, {k}, n_v), "
            f"one for each of the {n} contacts"
        )


def _cone_margin_shape(data: GraspData, options: Options, shapes: GraspData, option_shapes: Options) -> Any:
    """The shape that d has to end in, parallel to it, see `cone_margin_shape`."""
    if data.cone_margin is None:
        return None
    others = replace(data, contacts=None, disturbances=None, cone_margin=None), options
    ends = jax.tree.leaves((replace(shapes, contacts=None), option_shapes))
    leads = [end.lead(leaf) for leaf, end in zip(jax.tree.leaves(others), ends, strict=True)]
    axes = max(map(len, (data.contacts.batch_shape, data.disturbances.batch_shape, *leads)))
    return Trailing(cone_margin_shape(data.cone_margin.shape, axes, data.contacts.n_c, data.cone_edges))


def _compliance_shape(data: GraspData) -> Any:
    """The shape that Q has to end in, parallel to the compliance: blocks of contacts, or all contacts together.

    Raises:
        ValueError: it ends in neither.
    """
    n, k, compliance = data.contacts.n_c, data.contacts.components, data.compliance
    if compliance is None:
        return None
    if not isinstance(compliance, Compliance):
        return _matrix_shape("compliance", compliance, n, k)
    (vertices,) = data.disturbances.terms
    assert isinstance(vertices, Vertices)
    array, count = compliance.per_vertex, vertices.wrenches.shape[-2]
    for shape in ((count, n, k, k), (count, k * n, k * n)):
        if array.shape[-len(shape) :] == shape:
            return replace(compliance, per_vertex=Trailing(shape))
    raise ValueError(
        f"compliance: got shape {array.shape}, wanted (*batch, {count}, {n}, {k}, {k}) or "
        f"(*batch, {count}, {k * n}, {k * n}), one Q for each of the {count} wrenches"
    )


def _matrix_shape(name: str, matrices: jax.Array, n: int, k: int) -> Trailing:
    """The shape that Q or Q_0 has to end in: blocks of contacts, or all contacts together.

    Raises:
        ValueError: it ends in neither.
    """
    array = as_float(name, matrices, ("rows", "columns"))
    for shape in ((n, k, k), (k * n, k * n)):
        if array.shape[-len(shape) :] == shape:
            return Trailing(shape)
    raise ValueError(f"{name}: got shape {array.shape}, wanted (*batch, {n}, {k}, {k}) or (*batch, {k * n}, {k * n})")
