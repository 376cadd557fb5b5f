"""Models as MJX sees them."""

import contextlib
import io
from collections.abc import Iterator
from typing import Any

import jax
import mujoco


@contextlib.contextmanager
def allowing_mjx() -> Iterator[None]:
    """MJX mixes precisions and ranks at will."""
    with jax.numpy_dtype_promotion("standard"), jax.numpy_rank_promotion("allow"):
        yield


def mjx_of(model: mujoco.MjModel) -> tuple[Any, Any]:
    """MJX's model and data, in the precision that JAX has now; known while tracing.

    Raises:
        ValueError: MJX does not know something in the model.
    """
    # MJX takes seconds to import, and says on standard output that its version for NVIDIA's Warp is not installed.
    with contextlib.redirect_stdout(io.StringIO()):
        from mujoco import mjx

    try:
        with jax.ensure_compile_time_eval():
            device = mjx.put_model(model, impl="jax")
            return device, mjx.make_data(device)
    except NotImplementedError as error:
        raise ValueError(f"scene: MJX cannot represent it: {error}") from error
