"""Where everything is in a configuration, by MJX."""

import contextlib
import copy
import io
from functools import lru_cache
from typing import Any, NamedTuple

import jax
import mujoco

# Its version for NVIDIA's Warp is not needed, and says on standard output that it is not installed.
with contextlib.redirect_stdout(io.StringIO()):
    from mujoco import mjx


class Pose(NamedTuple):
    """World frame; a leading axis of configurations."""

    geom_positions: jax.Array
    """(n, geoms, 3), m."""
    geom_rotations: jax.Array
    """(n, geoms, 3, 3)."""
    anchors: jax.Array
    """(n, joints, 3), a point on each joint's axis, m."""
    axes: jax.Array
    """(n, joints, 3)."""
    body_rotations: jax.Array
    """(n, bodies, 3, 3)."""
    mass_centres: jax.Array
    """(n, bodies, 3), m."""


class Kinematics:
    """Forward kinematics and tendon lengths of a model."""

    def __init__(self, model: mujoco.MjModel):
        """Keeps what the kinematics need.

        Raises:
            ValueError: MJX does not know something in the model.
        """
        # Contacts are found elsewhere; MJX would refuse pairs of geoms that it has no function for.
        self._model = copy.copy(model)
        self._model.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_CONTACT)
        self._on_device = lru_cache(maxsize=None)(self._put)
        self._on_device(jax.config.jax_enable_x64)

    def _put(self, _: bool) -> tuple[Any, Any]:
        """The model in JAX's precision."""
        try:
            with jax.ensure_compile_time_eval(), jax.numpy_dtype_promotion("standard"):
                model = mjx.put_model(self._model)
                return model, mjx.make_data(model)
        except NotImplementedError as error:
            raise ValueError(f"scene: MJX cannot represent it: {error}") from error

    def poses(self, qpos: jax.Array) -> Pose:
        """Poses in configurations (n, nq)."""
        model, data = self._on_device(jax.config.jax_enable_x64)

        def one(qpos: jax.Array) -> Pose:
            found = mjx.kinematics(model, data.replace(qpos=qpos))
            return Pose(found.geom_xpos, found.geom_xmat, found.xanchor, found.xaxis, found.xmat, found.xipos)

        with _lenient():
            return jax.vmap(one)(qpos)

    def actuator_lengths(self, qpos: jax.Array) -> jax.Array:
        """Lengths (n, nu) of all actuators, by way of tendons where they act on these."""
        model, data = self._on_device(jax.config.jax_enable_x64)

        def one(qpos: jax.Array) -> jax.Array:
            found = mjx.com_pos(model, mjx.kinematics(model, data.replace(qpos=qpos)))
            return mjx.transmission(model, mjx.tendon(model, found)).actuator_length

        with _lenient():
            return jax.vmap(one)(qpos)


@contextlib.contextmanager
def _lenient():
    """MJX mixes precisions and ranks at will."""
    with jax.numpy_dtype_promotion("standard"), jax.numpy_rank_promotion("allow"):
        yield
