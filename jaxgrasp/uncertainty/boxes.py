"""Tightening forces (22) for the worst of boxes of friction, largest forces, masses and loads.

That is exact. The rows of a smaller cone imply those of a larger one. What a load differs by from the one that is known
is answered by blocking forces, like a disturbance that the margin does not scale: its worst case is one more support
function,

    C f_0 - S_1(lambda D + U) <= -d,     U = {b' - b}.
"""

import jax
import jax.numpy as jnp
from jax.typing import ArrayLike

from jaxgrasp.arrays import as_float
from jaxgrasp.contact.contacts import Contacts
from jaxgrasp.disturbance import DisturbanceSet
from jaxgrasp.robustness import Solution, least_effort
from jaxgrasp.uncertainty.spec import Distribution, Uncertainty

# Boxes leave contacts at least so much friction: with none at all G* would be another one.
_LEAST_FRICTION = 1e-6
_EXACT = ("friction", "max_force", "mass", "load")


def box_effort(
    contacts: Contacts,
    disturbances: DisturbanceSet,
    margin: ArrayLike,
    uncertainty: Uncertainty,
    required_wrench: ArrayLike | None = None,
    compliance: ArrayLike | None = None,
    cone_edges: int = 8,
    cone_margin: ArrayLike = 0.0,
) -> Solution:
    """The forces of least effort that hold for all of a box of friction, largest forces, masses and loads, (22).

    Args:
        contacts: the grasps.
        disturbances: the set D.
        margin: lambda (*batch,), >= 0.
        uncertainty: uniform distributions of friction, max_force, mass and load alone, whose whole range counts.
        required_wrench: b (*batch, 6), N and N m; None is zero.
        compliance: Q, as in `largest_disturbance`.
        cone_edges: n_e.
        cone_margin: d, N, as in `largest_disturbance`.

    Returns:
        Solution of `least_effort` for the worst of the box; INFEASIBLE where no forces hold for all of it. `margin` and
        `upper_bound` count in units of the scaled set with the box of loads, of which 1 is wanted.

    Raises:
        ValueError: another quantity is not known, or a distribution has no ends; shapes that do not fit.
    """
    given = uncertainty.given()
    for name, distribution in given.items():
        if name not in _EXACT:
            raise ValueError(f"uncertainty: got {name}, wanted {', '.join(_EXACT)}; scenario_effort takes it")
        if not isinstance(distribution, Distribution) or not distribution.uniform:
            raise ValueError(f"{name}: got a distribution without ends, wanted uniform(half_width)")
    dtype = contacts.positions.dtype

    def ends(name: str) -> tuple[jax.Array, jax.Array]:
        """The middle of a box and half its width."""
        box = given[name]
        assert isinstance(box, Distribution)
        return box.mean.astype(dtype), box.spread.astype(dtype)

    friction, max_force = contacts.friction, contacts.max_force
    if "friction" in given:
        middle, half = ends("friction")
        friction = jnp.where(friction > 0, jnp.maximum(friction + middle - half, _LEAST_FRICTION), friction)
    if "max_force" in given:
        middle, half = ends("max_force")
        max_force = max_force * (1 + middle - half)
    worst = Contacts.from_frames(
        contacts.positions,
        contacts.frames,
        friction=friction,
        max_force=max_force,
        active=contacts.active,
        torsional_friction=contacts.torsional_friction,
    )
    scaled = disturbances.scaled(as_float("margin", margin, ()).astype(dtype))
    wrench = None if required_wrench is None else as_float("required_wrench", required_wrench, (6,)).astype(dtype)
    if "mass" in given and wrench is not None:
        middle, half = ends("mass")
        moved = half * wrench
        scaled = scaled + DisturbanceSet.vertices(jnp.stack([moved, -moved], -2))
        wrench = (1 + middle) * wrench
    if "load" in given:
        middle, half = ends("load")
        scaled = scaled + DisturbanceSet.box(jnp.broadcast_to(half, (6,)))
        wrench = jnp.broadcast_to(middle, (6,)) + (0 if wrench is None else wrench)
    return least_effort(
        worst, scaled, jnp.ones((), dtype), wrench, compliance, cone_edges=cone_edges, cone_margin=cone_margin
    )
