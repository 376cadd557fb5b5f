"""Metrics of the grasp map alone: singular values, and the residual of unit normal forces."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxgrasp import linalg
from jaxgrasp.arrays import safe_divide, safe_norm
from jaxgrasp.contact import Contacts
from jaxgrasp.contact.row_space import RANK_TOLERANCE
from jaxgrasp.metrics.wrench_space import WrenchSpace, edges_of, hidden, metric


@metric
def smallest_singular_value(contacts: Contacts, space: WrenchSpace | None = None) -> Float[Array, "*batch"]:
    """The smallest of the six singular values of the grasp map: how far the grasp is from one that loses a direction.

    Li and Sastry, "Task-oriented optimal grasping by multifingered robot hands" (IEEE J. Robotics and Automation,
    1988). Friction is not asked. Moment rows are divided by the length of `space` and are about its reference.

    Args:
        contacts: the grasps.
        space: conventions, of which the edges do not matter; `WrenchSpace()` where None.

    Returns:
        (*batch,), exactly 0 where the map has not full rank; NaN for data that are not admissible. Differentiable;
        where several singular values are equal, by one of them.

    Raises:
        ValueError: options or shapes that do not fit.
    """
    edges = edges_of(contacts, space)
    return hidden(edges, _extreme(edges.grasp_map)[0])


@metric
def isotropy(contacts: Contacts, space: WrenchSpace | None = None) -> Float[Array, "*batch"]:
    """The smallest over the largest singular value of the grasp map, 1 where all directions are alike.

    Kim, Oh, Yi and Suh, "Optimal grasping based on non-dimensionalized performance indices" (IROS 2001), the grasp
    isotropy index; conventions as for `smallest_singular_value`.

    Args:
        contacts: the grasps.
        space: conventions, of which the edges do not matter; `WrenchSpace()` where None.

    Returns:
        (*batch,), between 0 and 1, exactly 0 where the map has not full rank; NaN for data that are not admissible.
        Differentiable.

    Raises:
        ValueError: options or shapes that do not fit.
    """
    edges = edges_of(contacts, space)
    return hidden(edges, safe_divide(*_extreme(edges.grasp_map)))


@metric
def closure_residual(contacts: Contacts, space: WrenchSpace | None = None) -> Float[Array, "*batch"]:
    """|G c|, the wrench that is left where every finger pushes with a normal force of 1: the smaller the better.

    Liu et al., "Synthesizing diverse and physically stable grasps with arbitrary hand structures using differentiable
    force closure estimator" (IEEE RA-L 2022, arXiv 2104.09194): friction, which could balance what is left, is not
    asked. There moments are in N m (length 1) about the origin of the object's frame.

    Args:
        contacts: the grasps.
        space: conventions, of which the edges do not matter; `WrenchSpace()` where None.

    Returns:
        (*batch,), NaN for data that are not admissible. Differentiable; at 0 the gradient is 0.

    Raises:
        ValueError: options or shapes that do not fit.
    """
    edges = edges_of(contacts, space)
    residual = safe_norm(edges.grasp_map[..., 2].sum(-2))
    # Opposite normals cancel but for rounding, by which grasps would be ranked.
    rounding = 16 * jnp.finfo(residual.dtype).eps * edges.present.sum(-1, dtype=residual.dtype)
    return hidden(edges, jnp.where(residual > rounding, residual, 0))


def _extreme(blocks: jax.Array) -> tuple[jax.Array, jax.Array]:
    """The sixth and the first singular value of G from blocks (*batch, n_c, 6, k)."""
    G = jnp.moveaxis(blocks, -3, -2).reshape(*blocks.shape[:-3], 6, blocks.shape[-1] * blocks.shape[-3])
    # The derivative of a singular value is that of |G'u| with its own u held.
    u = linalg.right_singular(jnp.swapaxes(G, -1, -2))[1]
    length = lambda column: safe_norm(jnp.einsum("...ij,...i->...j", G, column))
    smallest, largest = length(u[..., -1]), length(u[..., 0])
    return jnp.where(smallest > RANK_TOLERANCE[G.dtype.name] * largest, smallest, 0), largest
