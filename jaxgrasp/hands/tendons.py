"""Lengths and moments of actuators, those that act by way of tendons over sites and wrapping geoms by MJX."""

import copy
from collections.abc import Callable

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from jaxgrasp.hands.actuators import Actuators
from jaxgrasp.hands.mjx_models import allowing_mjx, mjx_module, mjx_of


def transmission_of(
    model: mujoco.MjModel, joints: np.ndarray, actuators: Actuators, qpos: jax.Array
) -> tuple[jax.Array, jax.Array | np.ndarray]:
    """Lengths (n, actuators) and B, (joints, actuators) where it is the same everywhere, at qpos (n, nq).

    Raises:
        ValueError: MJX does not know something in the model.
    """
    numbers, constant = actuators.numbers, actuators.transmission
    if constant is not None:
        data = mujoco.MjData(model)
        mujoco.mj_forward(model, data)
        places = model.jnt_qposadr[joints]
        start = jnp.asarray(data.actuator_length[numbers], qpos.dtype)
        rest = jnp.asarray(model.qpos0[places], qpos.dtype)
        return start + (qpos[:, places] - rest) @ jnp.asarray(constant, qpos.dtype), constant
    lengths, moments = jax.vmap(spatial_transmission(model))(qpos)
    moments = moments[:, numbers][:, :, model.jnt_dofadr[joints]]
    return lengths[:, numbers], jnp.swapaxes(moments, -1, -2)


def spatial_transmission(model: mujoco.MjModel) -> Callable[[jax.Array], tuple[jax.Array, jax.Array]]:
    """Lengths (nu,) and moments (nu, nv) of all actuators as a function of the configuration (nq,).

    Raises:
        ValueError: MJX does not know something in the model.
    """
    # Contacts are found elsewhere; MJX would refuse pairs of geoms that it has no function for.
    model = copy.copy(model)
    model.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_CONTACT)

    def transmission(qpos: jax.Array) -> tuple[jax.Array, jax.Array]:
        with allowing_mjx():
            device, data = mjx_of(model)
            mjx = mjx_module()
            found = mjx.com_pos(device, mjx.kinematics(device, data.replace(qpos=qpos)))
            found = mjx.transmission(device, mjx.tendon(device, found))
            return found.actuator_length, found._impl.actuator_moment

    return transmission
