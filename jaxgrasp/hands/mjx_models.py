"""Models as MJX sees them."""

import contextlib
import io
from collections.abc import Iterator
from types import ModuleType
from typing import Any

import jax
import mujoco


@contextlib.contextmanager
def allowing_mjx() -> Iterator[None]:
    """MJX mixes precisions and ranks at will."""
    with jax.numpy_dtype_promotion("standard"), jax.numpy_rank_promotion("allow"):
        yield


def mjx_module() -> ModuleType:
    """MJX, which takes seconds to import, and says on standard output that NVIDIA's Warp is not installed."""
    with contextlib.redirect_stdout(io.StringIO()):
        from mujoco import mjx
    return mjx


def mjx_of(model: mujoco.MjModel) -> tuple[Any, Any]:
    """MJX's model and data, in the precision that JAX has now; known while tracing.

    Raises:
        ValueError: MJX does not know something in the model.
    """
    mjx = mjx_module()
    try:
        with jax.ensure_compile_time_eval():
            device = mjx.put_model(model, impl="jax")
            return device, mjx.make_data(device)
    except NotImplementedError as error:
        raise ValueError(f"scene: MJX cannot represent it: {error}") from error
