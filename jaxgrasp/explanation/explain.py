"""What ends a grasp's margin, and what would raise it."""

from dataclasses import replace
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Array, Float, Int

from jaxgrasp.compiling import by_size, compiled
from jaxgrasp.contact import Actuation, Contacts
from jaxgrasp.disturbance import DisturbanceSet
from jaxgrasp.explanation.zero_margins import REASONS, is_zero, reasons
from jaxgrasp.records import record
from jaxgrasp.robustness import Solution, largest_disturbance, worst_case
from jaxgrasp.solvers.status import Status

# Contacts and gains that are told in words, and shares below which none is.
_TOLD, _LEAST_SHARE = 3, 0.02
# What gains in words are for: a tenth of a coefficient or of a force, and m.
_TENTH, _WAY = 0.1, 1e-3


@record
class Explanation:
    """Why grasps have the margins (21) that they have."""

    margin: Float[Array, "*batch"]
    """lambda of (21), multiples of the disturbances."""
    status: Int[Array, "*batch"]
    """`Status` of each."""
    zero: Int[Array, "*batch"]
    """Where the margin is zero the place of its reason in `zero_margins.REASONS`, else -1."""
    slip: Float[Array, "*batch contacts"]
    """Shares of what ends the margin, one in all with `press` and the actuators': that the contact would slip."""
    press: Float[Array, "*batch contacts"]
    """That the contact presses with its largest force."""
    actuators: Float[Array, "*batch"]
    """That actuators are at their limits; 0 without actuation."""
    direction: Float[Array, "*batch 6"]
    """The disturbance of the set that the row with the largest share stands least, N and N m, object frame; NaN where
    no contact's row ends the margin."""
    friction_gain: Float[Array, "*batch contacts"]
    """d margin / d friction."""
    force_gain: Float[Array, "*batch contacts"]
    """d margin / d max_force, 1/N."""
    position_gain: Float[Array, "*batch contacts 3"]
    """d margin / d position along the surface, object frame, 1/m."""
    contacts: Contacts
    """The grasps."""

    def words(self, *place: int) -> list[str]:
        """Tells of one grasp in a few lines.

        Args:
            place: Where it is in the batch; nothing where there is none.

        Raises:
            IndexError: No such grasp, or no single one.
        """
        one = jax.tree.map(lambda x: np.asarray(x)[place], self)
        if np.ndim(one.margin):
            raise IndexError(f"place: got {place}; wanted {np.ndim(self.margin)} numbers")
        status = Status(int(one.status))
        if status is Status.INFEASIBLE:
            return ["the required wrench cannot be borne: no forces within friction and limits balance it"]
        if status is not Status.SOLVED:
            return [f"no margin to explain: {status.name}"]
        if one.zero >= 0:
            return [f"margin 0: a grasp {list(REASONS.values())[int(one.zero)]}"]
        lines = [f"margin {one.margin:.3g}, which ends where {_ends(one)}"]
        if np.isfinite(one.direction).all():
            force, moment = (", ".join(f"{x:.3g}" for x in part) for part in np.split(one.direction + 0.0, 2))
            lines.append(f"worst disturbance: force ({force}) N, moment ({moment}) N m about the centre of mass")
        gains = _gains(one)
        return [*lines, f"would help: {'; '.join(gains)}"] if gains else lines


def _ends(one: Explanation) -> str:
    shares = [(share, f"contact {number} slips") for number, share in enumerate(one.slip)]
    shares += [(share, f"contact {number} presses with its largest force") for number, share in enumerate(one.press)]
    shares += [(one.actuators, "actuators reach their limits")]
    shares = sorted(shares, key=lambda each: -each[0])
    told = [(share, what) for share, what in shares if share >= _LEAST_SHARE][:_TOLD]
    return ", ".join(f"{what} ({100 * share:.0f} %)" for share, what in told)


def _gains(one: Explanation) -> list[str]:
    """The largest of each kind, the most helpful first."""
    found = []
    for what, gain in (
        ("a tenth more friction", one.friction_gain * one.contacts.friction * _TENTH),
        ("a tenth more force", one.force_gain * one.contacts.max_force * _TENTH),
        (f"{_WAY * 1e3:.0f} mm along the surface", np.linalg.norm(one.position_gain, axis=-1) * _WAY),
    ):
        number = int(np.argmax(gain))
        if gain[number] > 1e-6 * one.margin:
            found.append((gain[number], f"{what} at contact {number}: {gain[number]:+.2g}"))
    return [line for _, line in sorted(found, key=lambda each: -each[0])]


def explain(
    contacts: Contacts,
    disturbances: DisturbanceSet,
    required_wrench: ArrayLike | None = None,
    compliance: ArrayLike | None = None,
    cone_edges: int = 8,
    actuation: Actuation | None = None,
) -> Explanation:
    """Why grasps have the margins that they have: what ends them, the worst disturbance, and what would help most.

    At the optimum of (21) the multipliers z of its rows, with what the worst disturbance takes from each, S, obey
    z'S = 1: z_r S_r is the share of row r in what ends the margin. Gains are derivatives; at kinks one of several. It
    looks at numbers, so it cannot be called inside `jax.jit`.

    Args:
        contacts: the grasps.
        disturbances: the set D.
        required_wrench: as in `largest_disturbance`, like all that follow.
        compliance: blocks or a full Q, not one a direction.
        cone_edges: n_e.
        actuation: what the hand can do.

    Returns:
        Explanation with `*batch` axes; its `words` tell of one grasp.

    Raises:
        ValueError: shapes or options that do not fit.

    Example:
        >>> import jaxgrasp as jg, numpy as np
        >>> normals = np.array([[1.0, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0]])
        >>> contacts = jg.Contacts.from_normals(0.03 * normals, normals, friction=0.6, max_force=10.0)
        >>> for line in jg.explain(contacts, jg.DisturbanceSet.forces(1.0)).words(): print(line)  # doctest: +SKIP
    """
    wrenches = () if required_wrench is None else jnp.shape(required_wrench)[:-1]
    batch = jnp.broadcast_shapes(contacts.batch_shape, disturbances.batch_shape, wrenches)
    axes = len(contacts.batch_shape)
    contacts = jax.tree.map(lambda x: jnp.broadcast_to(x, (*batch, *x.shape[axes:])), contacts)
    settings: dict[str, Any] = {"compliance": compliance, "cone_edges": cone_edges, "actuation": actuation}

    def margin(friction: jax.Array, max_force: jax.Array, positions: jax.Array) -> tuple[jax.Array, Solution]:
        moved = replace(contacts, friction=friction, max_force=max_force, positions=positions)
        found = largest_disturbance(moved, disturbances, required_wrench, **settings)
        return jnp.sum(jnp.where(found.status == Status.SOLVED, found.margin, 0)), found

    gains, solution = jax.grad(margin, argnums=(0, 1, 2), has_aux=True)(
        contacts.friction, contacts.max_force, contacts.positions
    )
    outward = contacts.frames[..., 2]
    along = gains[2] - jnp.sum(gains[2] * outward, -1, keepdims=True) * outward
    multipliers = jnp.concatenate([solution.cone_multipliers, solution.bound_multipliers[..., None]], -1)
    rows = multipliers * jnp.concatenate(_losses(contacts, disturbances, settings), -1)
    ends = solution.status == Status.SOLVED
    rows = jnp.where(ends[..., None, None], rows, 0)
    left = jnp.clip(1 - rows.sum((-2, -1)), 0)
    return Explanation(
        margin=solution.margin,
        status=solution.status,
        zero=_zero(contacts, disturbances, solution, cone_edges),
        slip=rows[..., :-1].sum(-1),
        press=rows[..., -1],
        actuators=jnp.zeros_like(left) if actuation is None else jnp.where(ends, left, 0),
        direction=_direction(contacts, disturbances, settings, rows),
        friction_gain=gains[0],
        force_gain=gains[1],
        position_gain=along,
        contacts=contacts,
    )


def _zero(contacts: Contacts, disturbances: DisturbanceSet, solution: Solution, cone_edges: int) -> jax.Array:
    """The places of the reasons of zeros."""
    batch = solution.margin.shape
    zero = is_zero(np.asarray(solution.margin), np.asarray(solution.status))
    if not zero.any():
        return jnp.full(batch, -1)
    axes = len(batch)
    flat = lambda x: jnp.reshape(x, (-1, *x.shape[axes:]))
    spread = jax.tree.map(flat, disturbances.spread_over(batch)) if disturbances.batch_shape else disturbances
    found = reasons(jax.tree.map(flat, contacts), spread, cone_edges).reshape(batch)
    return jnp.where(zero, found, -1)


def _direction(
    contacts: Contacts, disturbances: DisturbanceSet, settings: dict[str, Any], shares: jax.Array
) -> jax.Array:
    """The disturbance that the row with the largest share stands least: where its h_D(a) is attained."""
    batch = shares.shape[:-2]
    # What the wrenches e_j and -e_j, one at a time, take from a row is the positive part of a_j and of -a_j.
    single = jnp.concatenate([jnp.eye(6), -jnp.eye(6)]).astype(shares.dtype).reshape(12, *(1 for _ in batch), 1, 6)
    twelve = jax.tree.map(lambda x: jnp.broadcast_to(x, (12, *x.shape)), contacts)
    taken = jnp.concatenate(_losses(twelve, DisturbanceSet.vertices(single), settings), -1)
    rows = jnp.moveaxis(taken[:6] - taken[6:], 0, -1).reshape(*batch, -1, 6)
    shares = shares.reshape(*batch, -1)
    row = jnp.take_along_axis(rows, jnp.argmax(shares, -1)[..., None, None], -2)
    worst = _furthest(disturbances, row)[..., 0, :]
    return jnp.where(shares.max(-1, keepdims=True) > 0, worst, jnp.nan)


@partial(compiled, pace=by_size)
def _furthest(disturbances: DisturbanceSet, rows: jax.Array) -> jax.Array:
    """The members of a set, like the rows a, that attain h_D(a)."""
    return jax.grad(lambda a: jnp.sum(disturbances.support(a)))(rows)


def _losses(contacts: Contacts, disturbances: DisturbanceSet, settings: dict[str, Any]) -> tuple[jax.Array, jax.Array]:
    """What the worst of a set takes from cone rows, (*batch, n_c, rows), and from bounds, (*batch, n_c, 1)."""
    cone, bound = worst_case(contacts, disturbances, **settings)
    return -cone, bound[..., None]
