"""Contacts: where the fingers touch, with which friction and strength."""

import functools
import warnings
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jax.typing import ArrayLike
from jaxtyping import Array, Bool, Float

from jaxgrasp.arrays import as_float, broadcast_batch, frames_from_normals, placed
from jaxgrasp.compiling import by_size, compiled
from jaxgrasp.lanes.direct import filled, is_direct, power_of_two
from jaxgrasp.records import record


@record
class Contacts:
    """A batch of grasps by their contacts, in the object frame about the centre of mass.

    Contacts are hard: points with friction. With `torsional_friction` they are soft, and bear a moment about the
    normal, too.

    Every leaf has the full batch shape, so that ``jax.vmap(f)(contacts)`` works. Make one with `from_normals` or
    `from_frames`.
    """

    positions: Float[Array, "*batch contacts 3"]
    """Contact points, m."""
    frames: Float[Array, "*batch contacts 3 3"]
    """Contact frames, columns t1, t2, n; n is the object's outward normal, so a finger that pushes has f_n <= 0."""
    friction: Float[Array, "*batch contacts"]
    """Coulomb's friction coefficient. At exactly 0 a contact transmits its normal force alone."""
    max_force: Float[Array, "*batch contacts"]
    """Largest normal force, N; bounds the normal component (8), not the norm."""
    active: Bool[Array, "*batch contacts"]
    """False where a contact is absent: it counts as if it had never been there, whatever its other data."""
    torsional_friction: Float[Array, "*batch contacts"] | None = None
    """gamma, m: the moment m about the normal is bounded by |f_t|^2 / mu^2 + m^2 / gamma^2 <= f_n^2. 0 is a hard
    contact; None makes all contacts hard, and programs smaller."""

    @classmethod
    def from_frames(
        cls,
        positions: ArrayLike,
        frames: ArrayLike,
        *,
        friction: ArrayLike,
        max_force: ArrayLike,
        active: ArrayLike | None = None,
        torsional_friction: ArrayLike | None = None,
    ) -> "Contacts":
        """Contacts whose tangents are given.

        Args:
            positions: (*batch, n_c, 3), m, object frame, about the centre of mass.
            frames: (*batch, n_c, 3, 3), rotations with columns t1, t2, n (outward).
            friction: scalar or (*batch, n_c), >= 0.
            max_force: scalar or (*batch, n_c), N, finite and positive.
            active: bool (*batch, n_c); None means that every contact is there.
            torsional_friction: scalar or (*batch, n_c), m, >= 0, as MuJoCo has it for condim 4; None is no moment.

        Raises:
            ValueError: shapes that do not fit. Data that are not admissible are not errors here: the grasp that has
                them is answered with `Status.INVALID_INPUT`.
        """
        positions = as_float("positions", positions, ("n_c", 3))
        frames = as_float("frames", frames, ("n_c", 3, 3))
        friction = as_float("friction", friction, ())
        max_force = as_float("max_force", max_force, ())
        present = placed(True if active is None else active)
        if present.dtype != bool:
            raise ValueError(f"active: got dtype {present.dtype}, wanted bool")
        n_c = positions.shape[-2]
        if n_c == 0 or frames.shape[-3] != n_c:
            raise ValueError(
                f"frames: got shape {frames.shape}, wanted (*batch, n_c, 3, 3) "
                f"with the n_c >= 1 of positions {positions.shape}"
            )
        given = {"friction": friction, "max_force": max_force, "active": present}
        if torsional_friction is not None:
            given["torsional_friction"] = as_float("torsional_friction", torsional_friction, ())
            _doubt_ratios(given["torsional_friction"])
        for name, value in given.items():
            if value.ndim and value.shape[-1] != n_c:
                raise ValueError(
                    f"{name}: got shape {value.shape}, wanted a scalar or (*batch, {n_c}), one for each contact"
                )
        batch = broadcast_batch(
            positions=positions.shape[:-2],
            frames=frames.shape[:-3],
            **{name: value.shape[:-1] for name, value in given.items()},
        )
        leaves = positions, frames, *given.values()
        spread = _spread_directly if is_direct(leaves) else _spread
        return cls(**dict(zip(_EVENTS, spread(batch, leaves), strict=False)))

    @classmethod
    def from_normals(
        cls,
        positions: ArrayLike,
        outward_normals: ArrayLike,
        *,
        friction: ArrayLike,
        max_force: ArrayLike,
        active: ArrayLike | None = None,
        torsional_friction: ArrayLike | None = None,
    ) -> "Contacts":
        """Contacts whose tangents follow from the normals, by a rule that rounding does not change.

        They are x and y turned by the smallest rotation that takes z to the normal n. Within 45 degrees of n = -z they
        turn about n besides, and are (-x, y) at n = -z; see `jaxgrasp.arrays.frames_from_normals`.

        Args:
            positions: (*batch, n_c, 3), m, object frame, about the centre of mass.
            outward_normals: (*batch, n_c, 3), pointing out of the object; they are normalised, and a zero normal makes
                its grasp `Status.INVALID_INPUT`.
            friction: scalar or (*batch, n_c), >= 0.
            max_force: scalar or (*batch, n_c), N, finite and positive.
            active: bool (*batch, n_c); None means that every contact is there.
            torsional_friction: scalar or (*batch, n_c), m, >= 0, as MuJoCo has it for condim 4; None is no moment.

        Raises:
            ValueError: shapes that do not fit.
        """
        normals = as_float("outward_normals", outward_normals, ("n_c", 3))
        n_c = as_float("positions", positions, ("n_c", 3)).shape[-2]
        if normals.shape[-2] != n_c:
            raise ValueError(
                f"outward_normals: got shape {normals.shape}, wanted (*batch, {n_c}, 3) "
                f"like positions {jnp.shape(positions)}"
            )
        given = {"friction": friction, "max_force": max_force, "active": active}
        return cls.from_frames(positions, _frames(normals), torsional_friction=torsional_friction, **given)

    @classmethod
    def from_dlpack(
        cls,
        positions: Any,
        frames: Any,
        *,
        friction: Any,
        max_force: Any,
        active: Any | None = None,
        torsional_friction: Any | None = None,
    ) -> "Contacts":
        """Contacts in arrays of another library (PyTorch, CuPy, NumPy), which share their memory where JAX can read it.

        JAX copies arrays that do not begin at a multiple of 64 bytes, and those that are not laid out row by row. The
        other library must not write to arrays that are shared. Results go back the same way: every array of JAX has
        `__dlpack__`, which `torch.from_dlpack` and the like take.

        Args:
            positions: (*batch, n_c, 3), m, float32 or float64, like all that follow.
            frames: (*batch, n_c, 3, 3), rotations with columns t1, t2, n (outward).
            friction: (*batch, n_c), >= 0; or a number.
            max_force: (*batch, n_c), N, finite and positive; or a number.
            active: bool (*batch, n_c); None means that every contact is there.
            torsional_friction: (*batch, n_c), m, >= 0; or a number; None is no moment.

        Raises:
            ValueError: shapes that do not fit.
        """
        leaves = {"positions": positions, "frames": frames, "friction": friction, "max_force": max_force}
        leaves["active"] = True if active is None else active
        if torsional_friction is not None:
            leaves["torsional_friction"] = torsional_friction
        found = {name: jnp.from_dlpack(x) for name, x in leaves.items() if hasattr(x, "__dlpack__")}
        for name in ("positions", "frames"):
            if name not in found:
                raise ValueError(f"{name}: got {type(leaves[name]).__name__}, wanted an array with __dlpack__")
        shape, dtype = found["positions"].shape[:-1], found["positions"].dtype
        for name in leaves:
            event = _EVENTS[name]
            kind = jnp.bool_ if name == "active" else dtype
            if name not in found:
                found[name] = jnp.full(shape, leaves[name], kind)
            if found[name].shape != (*shape, *event) or found[name].dtype != kind:
                got = f"{found[name].dtype.name} {found[name].shape}"
                raise ValueError(f"{name}: got {got}, wanted {jnp.dtype(kind).name} {(*shape, *event)}")
        return cls(**found)

    def check_precision(self) -> None:
        """Refuse what nothing here can compute with.

        Raises:
            ValueError: positions that are neither float32 nor float64.
        """
        dtype = self.positions.dtype
        if dtype not in (jnp.float32, jnp.float64):
            raise ValueError(f"contacts: got dtype {dtype.name}, wanted float32 or float64; cast their leaves")

    @property
    def batch_shape(self) -> tuple[int, ...]:
        """The leading axes."""
        return self.positions.shape[:-2]

    @property
    def n_c(self) -> int:
        """Number of contacts, absent ones included."""
        return self.positions.shape[-2]

    @property
    def components(self) -> int:
        """How many components a contact's force has in the programs: 3, and a fourth for the moment of soft ones."""
        return 3 if self.torsional_friction is None else 4

    @property
    def torsional_arms(self) -> Float[Array, "*batch contacts"] | None:
        """The lengths gamma / mu, m, None for hard contacts: moments m count as tangential forces m / arm, N.

        These use up as much of the friction, since |f_t|^2 + (m / arm)^2 <= mu^2 f_n^2. 0 where there is no friction.
        """
        if self.torsional_friction is None:
            return None
        least = LEAST_FRICTION[self.friction.dtype.name]
        return jnp.where(self.friction == 0, 0, self.torsional_friction / jnp.maximum(self.friction, least))


# Their frames take no time, however few they are.
_FEW_NORMALS = 1024
_EVENTS = {"positions": (3,), "frames": (3, 3), "friction": (), "max_force": (), "active": (), "torsional_friction": ()}
# Friction coefficients above 0 count as no less than this: tangential forces then stay as small in units of max_force.
LEAST_FRICTION = {"float64": 1e-9, "float32": 1e-6}
# Longer torsional coefficients, in metres, are ratios by mistake, or those of pads as large as a plate.
_LONGEST = 0.5


def _doubt_ratios(torsional_friction: jax.Array) -> None:
    """Warn of coefficients that are no lengths of fingertips, where they are known."""
    if isinstance(torsional_friction, Tracer) or not is_direct([torsional_friction]):
        return
    largest = float(np.max(np.asarray(torsional_friction), initial=0))
    if largest > _LONGEST:
        warnings.warn(
            f"torsional_friction: got {largest:.3g}, wanted metres (0.02 for example), not a ratio to friction",
            stacklevel=3,
        )


@functools.partial(compiled, static_argnums=(0,), pace=by_size)
def _spread(batch: tuple[int, ...], leaves: tuple[jax.Array, ...]) -> list[jax.Array]:
    """The leaves in one precision and with all axes: one program, where each operation would be one by itself."""
    positions, frames = leaves[:2]
    dtype, n_c = jnp.result_type(positions, frames), positions.shape[-2]
    return [
        jnp.broadcast_to(x if x.dtype == bool else x.astype(dtype), (*batch, n_c, *event))
        for x, event in zip(leaves, _EVENTS.values(), strict=False)
    ]


def _spread_directly(batch: tuple[int, ...], leaves: tuple[jax.Array, ...]) -> list[jax.Array]:
    """`_spread` in NumPy, for direct calls: nothing is compiled."""
    positions, frames = leaves[:2]
    dtype, n_c = jnp.result_type(positions, frames), positions.shape[-2]
    return [
        jax.device_put(np.broadcast_to(np.asarray(x, x.dtype if x.dtype == bool else dtype), (*batch, n_c, *event)))
        for x, event in zip(leaves, _EVENTS.values(), strict=False)
    ]


def _frames(normals: jax.Array) -> jax.Array:
    """`frames_from_normals`, in direct calls by one program for many shapes."""
    if not normals.size or not is_direct([normals]):
        return frames_from_normals(normals)
    flat = np.asarray(normals).reshape(-1, 3)
    frames = frames_from_normals(filled(flat, power_of_two(len(flat), _FEW_NORMALS)))
    return jax.device_put(np.asarray(frames)[: len(flat)].reshape(*normals.shape, 3))


def rotations(frames: jax.Array) -> jax.Array:
    """Which frames (n, 3, 3, *lanes) are rotations, (n, *lanes)."""
    tolerance = 1e-6 if frames.dtype == jnp.float64 else 1e-4
    t1, t2, normal = ([frames[:, r, a] for r in range(3)] for a in range(3))
    cross = [t1[1] * t2[2] - t1[2] * t2[1], t1[2] * t2[0] - t1[0] * t2[2], t1[0] * t2[1] - t1[1] * t2[0]]
    dot = lambda a, b: a[0] * b[0] + a[1] * b[1] + a[2] * b[2]
    near = lambda x, y: jnp.abs(x - y) <= tolerance
    aligned = near(cross[0], normal[0]) & near(cross[1], normal[1]) & near(cross[2], normal[2])
    return near(dot(t1, t1), 1) & near(dot(t2, t2), 1) & near(dot(t1, t2), 0) & aligned
