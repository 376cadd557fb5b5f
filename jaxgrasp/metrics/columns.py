"""The edges of a grasp as columns, and programs of them over batches of grasps: kernels, where there can be some."""

import math
from collections.abc import Callable
from dataclasses import replace
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import lax

from jaxgrasp.arrays import as_float, broadcast_batch, fold
from jaxgrasp.contact import Contacts
from jaxgrasp.contact.row_space import Basis, row_basis
from jaxgrasp.lanes.tiles import map_lanes
from jaxgrasp.metrics.wrench_space import WrenchSpace, checked, edges_of

Tree = Any


class Columns(NamedTuple):
    """The edges as points, in coordinates in which the six rows are orthonormal; lanes trail."""

    points: jax.Array
    """U = T W, (6, m, *lanes); zero where an edge does not count."""
    present: jax.Array
    """(m, *lanes), 1 for edges that count, else 0."""
    basis: Basis
    """T, and which rows of it are kept: the others depend on these."""
    valid: jax.Array
    """bool (*lanes)."""

    @property
    def number(self) -> jax.Array:
        """The number of edges that count, at least 1, (*lanes)."""
        return jnp.maximum(fold(jnp.add, self.present), 1)

    @property
    def spans(self) -> jax.Array:
        """Whether the edges span the space of wrenches, bool (*lanes)."""
        return fold(jnp.minimum, self.basis.kept) > 0

    @property
    def idle(self) -> jax.Array:
        """A twist along which no edge does work, (6, *lanes); zero where the edges span the space."""
        twist = jnp.zeros_like(self.basis.kept)
        for kept, row in zip(self.basis.kept, self.basis.operations, strict=True):
            twist = jnp.where(kept > 0, twist, row)
        return twist

    def twist(self, y: jax.Array) -> jax.Array:
        """Turn y (6, *lanes) of u_k'y into T'y, of w_k'T'y."""
        return fold(jnp.add, self.basis.operations * (self.basis.kept * y)[:, None])


def columns_of(contacts: Contacts, space: WrenchSpace) -> Columns:
    """The columns of grasps whose leaves have the lanes last.

    The edges of a contact are symmetric: W W' = G D D'G' with the lengths D of the edges' components. So the rows of
    G D, which are shorter than those of W, have the same basis.
    """

    def of_one(contacts: Contacts, space: WrenchSpace) -> tuple[jax.Array, ...]:
        edges = edges_of(contacts, space)
        lengths = jnp.sqrt(fold(jnp.add, jnp.moveaxis(edges.forces * edges.forces, -2, 0)))
        scaled = edges.grasp_map * lengths[..., None, :]
        return edges.flat.T, edges.counted, jnp.moveaxis(scaled, 0, -1), edges.valid

    W, counted, scaled, valid = jax.vmap(of_one, -1, -1)(contacts, space)
    basis = row_basis(scaled)
    points = fold(jnp.add, jnp.swapaxes(basis.operations, 0, 1)[:, :, None] * W[:, None])
    return Columns(points * basis.kept[:, None], counted.astype(W.dtype), basis, valid)


def over_grasps(
    program: Callable[..., Tree],
    contacts: Contacts,
    space: WrenchSpace | None,
    *given: jax.Array,
) -> Tree:
    """Run a program of columns over a batch of grasps; its results are constants to the derivative.

    Args:
        program: a function of a module, of `Columns` and of `given`, lanes last.
        contacts: the grasps.
        space: conventions.
        given: (*batch, k), more arguments of the program.

    Returns:
        The results of the program, leaves (*batch, ...).
    """
    contacts, space, given = lax.stop_gradient((contacts, checked(contacts, space), given))
    dtype, own = contacts.positions.dtype, len(contacts.batch_shape)
    length = None if space.length is None else as_float("length", space.length, ()).astype(dtype)
    reference = None if space.reference is None else as_float("reference", space.reference, (3,)).astype(dtype)
    batches = {"contacts": contacts.batch_shape}
    batches |= {} if length is None else {"length": length.shape}
    batches |= {} if reference is None else {"reference": reference.shape[:-1]}
    batches |= {f"argument {k}": x.shape[:-1] for k, x in enumerate(given)}
    batch = broadcast_batch(**batches)

    def lanes(x: jax.Array, event: int) -> jax.Array:
        shape = x.shape[x.ndim - event :]
        return jnp.broadcast_to(x, (*batch, *shape)).reshape(math.prod(batch), *shape)

    arguments = (
        jax.tree.map(lambda x: lanes(x, x.ndim - own), contacts),
        replace(
            space,
            length=None if length is None else lanes(length, 0),
            reference=None if reference is None else lanes(reference, 1),
        ),
        *(lanes(x, 1) for x in given),
    )
    rows = contacts.n_c * (space.cone_edges + 2 * (contacts.components - 3))
    found = map_lanes(
        (lambda of_grasp: program(columns_of(*of_grasp[:2]), *of_grasp[2:]),),
        arguments,
        jax.tree.map(lambda _: False, arguments),
        rows,
        compact=True,
        known_as=f"{program.__module__}.{program.__qualname__} {space.cone_edges} {space.unit_edges}",
    )
    return jax.tree.map(lambda x: x.reshape(*batch, *x.shape[1:]), found)
