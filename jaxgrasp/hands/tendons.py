"""Lengths and moments of actuators that act by way of tendons over sites and wrapping geoms, by MJX."""

import contextlib
import copy
import io
from collections.abc import Callable

import jax
import mujoco


def spatial_transmission(model: mujoco.MjModel) -> Callable[[jax.Array], tuple[jax.Array, jax.Array]]:
    """Lengths (nu,) and moments (nu, nv) of all actuators as a function of the configuration (nq,).

    Raises:
        ValueError: MJX does not know something in the model.
    """
    # MJX takes seconds to import, and says on standard output that its version for NVIDIA's Warp is not installed.
    with contextlib.redirect_stdout(io.StringIO()):
        from mujoco import mjx

    # Contacts are found elsewhere; MJX would refuse pairs of geoms that it has no function for.
    model = copy.copy(model)
    model.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_CONTACT)

    def transmission(qpos: jax.Array) -> tuple[jax.Array, jax.Array]:
        # MJX mixes precisions and ranks at will. The model takes the precision that JAX has while tracing.
        with jax.numpy_dtype_promotion("standard"), jax.numpy_rank_promotion("allow"):
            try:
                with jax.ensure_compile_time_eval():
                    on_device = mjx.put_model(model)
                    data = mjx.make_data(on_device)
            except NotImplementedError as error:
                raise ValueError(f"scene: MJX cannot represent it: {error}") from error
            found = mjx.com_pos(on_device, mjx.kinematics(on_device, data.replace(qpos=qpos)))
            found = mjx.transmission(on_device, mjx.tendon(on_device, found))
            return found.actuator_length, found._impl.actuator_moment

    return transmission
