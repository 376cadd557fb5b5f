"""The arguments of grasps side by side, with an axis for the draws of each."""

import math
from dataclasses import dataclass, replace
from typing import Any

import jax
import jax.numpy as jnp

from jaxgrasp.robustness.interface.arguments import GraspData, Options, Trailing, trailing_shapes


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Grasps:
    """The arguments of grasps; leaves (lanes, 1, ...), or without these axes where all grasps share them."""

    data: GraspData
    """The grasps."""
    margin: jax.Array
    """The scale of the disturbances that the forces are to hold."""
    forces: jax.Array | None
    """f_0 in known contact frames, N; None where none are given."""


def divided(x: jax.Array, parts: int, size: int) -> jax.Array:
    """An array (count, ...) as (parts, size, ...), filled with its last entry, or zeros where there is none."""
    mode = "edge" if len(x) else "constant"
    filled = jnp.pad(x, [(0, parts * size - len(x))] + [(0, 0)] * (x.ndim - 1), mode=mode)
    return filled.reshape(parts, size, *x.shape[1:])


def lanes_of(data: GraspData, options: Options, forces: jax.Array | None, batch: tuple[int, ...]) -> tuple[Grasps, Any]:
    """Give the arguments axes of lanes and of samples where grasps do not share them; also which these are.

    Raises:
        ValueError: shapes that do not fit.
    """
    axes, dtype = (math.prod(batch), 1), data.contacts.positions.dtype
    shapes = replace(trailing_shapes(data, options)[0], disturbances=None)
    others, disturbances = replace(data, disturbances=None), data.disturbances
    own = jax.tree.map(lambda x, end: end.lead(x) != (), others, shapes)
    # What belongs to contacts goes with them.
    own = replace(own, contacts=jax.tree.map(lambda _: True, data.contacts))
    if data.cone_margin is not None and data.cone_margin.ndim:
        own = replace(own, cone_margin=True)

    def lay(x: jax.Array, end: Trailing, has_lanes: bool) -> jax.Array:
        x = x if x.dtype == bool else x.astype(dtype)
        return jnp.broadcast_to(x, (*batch, *end.shape)).reshape(*axes, *end.shape) if has_lanes else x

    laid = jax.tree.map(lay, others, shapes, own)
    disturbed = disturbances.batch_shape != ()
    if disturbed:
        spread = disturbances.spread_over(batch)
        disturbances = jax.tree.map(lambda x: x.reshape(*axes, *x.shape[len(batch) :]), spread)
    own = replace(own, disturbances=jax.tree.map(lambda _: disturbed, disturbances))
    if forces is not None:
        end = Trailing(forces.shape[-2:])
        try:
            forces = lay(forces, end, True)
        except ValueError:
            raise ValueError(f"forces: got shape {forces.shape}, wanted {(*batch, *end.shape)}") from None
    margin = lay(jnp.asarray(options.margin), Trailing(()), True)
    grasps = Grasps(replace(laid, disturbances=disturbances), margin, forces)
    return grasps, (own, True, None if forces is None else True)
