"""The solutions of (21) and (22)."""

from dataclasses import replace

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from jaxgrasp.compiling import compiled
from jaxgrasp.contact.contacts import Contacts
from jaxgrasp.records import record


@record
class Solution:
    """Tightening forces of a batch of grasps, with what certifies them."""

    margin: Float[Array, "*batch"]
    """lambda, certified from below: the factor by which the disturbance set may be scaled while `forces` hold the
    object. Negative where the required wrench itself cannot be borne; NaN where there is no answer; inf where nothing
    disturbs."""
    upper_bound: Float[Array, "*batch"]
    """No forces whatever reach a margin above this one."""
    forces: Float[Array, "*batch contacts 3"]
    """f_0 in contact frames (t1, t2, n), N; 0 for absent contacts, NaN where there is no answer."""
    effort: Float[Array, "*batch"]
    """1/2 f_0' Q_0 f_0; Q_0 is the identity unless effort weights were given; moments of soft contacts then count as
    the forces m mu / gamma."""
    status: Int[Array, "*batch"]
    """`Status` of every grasp."""
    iterations: Int[Array, "*batch"]
    """Interior-point steps taken; of both programs for (22)."""
    primal_residual: Float[Array, "*batch"]
    """Largest violation of any row by `forces` at `margin` (at the margin asked for in (22)), in units of the mean
    f_max."""
    dual_residual: Float[Array, "*batch"]
    """Largest entry of the stationarity condition in the scaled program."""
    gap: Float[Array, "*batch"]
    """Certified gap: (upper_bound - margin) / max(Lambda, |margin|) for (21), with Lambda the margin's natural scale;
    that of the effort for (22)."""
    rank: Int[Array, "*batch"]
    """Rank of the grasp map, of contacts without friction with their normals alone."""
    cone_multipliers: Float[Array, "*batch contacts edges"]
    """z >= 0 of C f_0 - S_1 lambda <= -d, 2 n_e of them for soft contacts; without friction of rows cos(pi / n_e) f_n,
    see `largest_disturbance`."""
    bound_multipliers: Float[Array, "*batch contacts"]
    """z >= 0 of -E f_0 + S_2 lambda <= f_max."""
    wrench_multipliers: Float[Array, "*batch 6"]
    """y of G f_0 = b: how the optimum changes with b, for (21) d margin / d b, for (22) -d effort / d b."""
    actuator_efforts: Float[Array, "*batch actuators"] | None = None
    """u with J'f_0 = B u, N or N m; None without actuation."""
    actuator_multipliers: Float[Array, "*batch actuators 2"] | None = None
    """z >= 0 of the worst case of u <= u_max and of -u <= -u_min."""
    joint_multipliers: Float[Array, "*batch joints"] | None = None
    """y of J'f_0 - B u = 0."""
    moments: Float[Array, "*batch contacts"] | None = None
    """The moments of the fingers on the object about the normals n, right-handed, N m; None for hard contacts."""

    def forces_in_object_frame(self, contacts: Contacts) -> Float[Array, "*batch contacts 3"]:
        """Forces of the fingers on the object in the object frame, N.

        Args:
            contacts: the grasps that were solved.
        """
        turned = jnp.einsum("...ij,...j->...i", contacts.frames, self.forces)
        return jnp.where(contacts.active[..., None], turned, self.forces)


def with_moments(solution: Solution, contacts: Contacts) -> Solution:
    """Split the forces of soft contacts, whose fourth component is m / arm, into forces and moments."""
    return solution if contacts.torsional_friction is None else _split(solution, contacts)


@compiled
def _split(solution: Solution, contacts: Contacts) -> Solution:
    forces, moments = split(solution.forces, contacts)
    return replace(solution, forces=forces, moments=moments)


def split(forces: jax.Array, contacts: Contacts) -> tuple[jax.Array, jax.Array]:
    """Forces (*batch, n_c, 3), N, and moments (*batch, n_c), N m, of soft contacts; *batch may end in directions.

    Args:
        forces: (*batch, n_c, 4), the fourth component as m / arm.
        contacts: the grasps, whose axes broadcast to these.
    """
    arms = contacts.torsional_arms
    assert arms is not None
    moments = forces[..., 3] * jnp.where(contacts.active, arms, 0)
    return forces[..., :3], jnp.where(contacts.active, moments, 0)
