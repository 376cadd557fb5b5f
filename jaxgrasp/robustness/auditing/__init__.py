"""An audit of every answer outside the code that found it: plain XLA, the public arguments, and nothing of the kernels.

Statuses come from the solver itself, so a fault of a kernel could call a wrong answer solved. The audit checks what an
answer claims and takes `Status.SOLVED` away where it does not stand.
"""

from abc import ABC, abstractmethod
from dataclasses import replace
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer

from jaxgrasp.compiling import compiled
from jaxgrasp.lanes.fence import fences
from jaxgrasp.robustness.auditing import setting
from jaxgrasp.robustness.auditing.parts import once
from jaxgrasp.robustness.auditing.problem import devices_of, every
from jaxgrasp.robustness.auditing.setting import audit
from jaxgrasp.robustness.interface.arguments import Arguments, GraspData, Inputs, Options, lay_out

__all__ = ["Audited", "audit", "audited", "hidden"]

Tree = Any
# Batches up to this size are looked at whole: there is nothing to save.
_SMALL = 64
# Up to this size compiling takes longer than whatever is audited.
_FEW = 256


class Audited(ABC):
    """A kernel whose answers can be audited."""

    @abstractmethod
    def judge(self, arguments: Arguments, out: Tree, anew: bool) -> Tree:
        """Verdicts with a field `failed`, bool (lanes,), on results with lanes leading.

        Args:
            arguments: the public arguments.
            out: the kernel's results.
            anew: with everything computed anew that the solver only claims to have used.
        """

    @abstractmethod
    def spot(self, arguments: Arguments, out: Tree) -> Tree:
        """Where what the solver claims to have used is not what comes out anew: bool (lanes,) for each verdict."""

    @abstractmethod
    def correct(self, out: Tree, verdicts: Tree) -> Tree:
        """The results with what the audit confirms in place of what it does not."""


def hidden(value: jax.Array, failed: jax.Array, instead: Any) -> jax.Array:
    """A result (*batch, ...) with something else where the audit failed, (*batch)."""
    mask = failed.reshape(*failed.shape, *[1] * (value.ndim - failed.ndim))
    return jnp.where(mask, jnp.asarray(instead, value.dtype), value)


def audited(
    kernel: Any,
    out: Tree,
    data: GraspData,
    options: Options,
    count: int | None = None,
) -> Tree:
    """Audit the results of a kernel in the form that is chosen, see `setting.audit`.

    A direct call that finds a wrong answer warns. Inside a transformation the audit is part of the program.

    Args:
        kernel: what was run; results of one that is not `Audited` are left as they are.
        out: its results, leaves (*batch, ...).
        data: the grasps.
        options: what was asked for.
        count: how many answers count where the last ones are copies; None where all do.
    """
    form = setting.chosen_form()
    if form == "off" or not isinstance(kernel, Audited) or jax.tree.leaves(out)[0].size == 0:
        return out
    stride = 1 if form == "strict" else setting.STRIDE
    still = jax.lax.stop_gradient((data, options, out))
    first = jax.tree.leaves(out)[0]
    pace = "brief" if isinstance(first, Tracer) or first.size > _FEW else "soon"
    verdicts, failed = _JUDGES[pace](kernel, stride, *still, np.int32(setting.next_turn()))
    if not isinstance(failed, Tracer):
        if not int(failed):
            return out
        flags = [np.asarray(flag) for flag in _flags(verdicts)]
        flags = flags if count is None else [flag[:count] for flag in flags]
        setting.report(max(1, int(sum(flag.sum() for flag in flags))), max(1, flags[0].size))
    return _corrected(kernel, out, verdicts)


def _verdicts(
    kernel: Any, stride: int, data: GraspData, options: Options, out: Tree, turn: jax.Array
) -> tuple[Tree, jax.Array]:
    """What the kernel judges, (*batch), and whether an answer failed."""
    arguments = lay_out(data, options)
    lead = len(arguments.batch)
    flat = jax.tree.map(lambda x: x.reshape(-1, *x.shape[lead:]), out)
    with fences(jax.default_backend() == "cpu"):
        verdicts = kernel.judge(arguments, flat, stride == 1)
        if stride > 1:
            verdicts = _spotted(kernel, stride, arguments, flat, verdicts, turn)
    failed = jnp.stack([flag.any() for flag in _flags(verdicts)]).any()
    return jax.tree.map(lambda x: x.reshape(*arguments.batch, *x.shape[1:]), verdicts), failed


def _spotted(kernel: Any, stride: int, arguments: Arguments, out: Tree, verdicts: Tree, turn: jax.Array) -> Tree:
    """The verdicts with what comes out anew for one lane in `stride`."""
    lanes = jax.tree.leaves(out)[0].shape[0]
    # Where it is known only when an exported program runs how many there are, all are looked at.
    step = stride if isinstance(lanes, int) and lanes > _SMALL else 1
    devices = devices_of(jax.tree.leaves(out)[0]) if step > 1 else 1

    @once
    def pick(inputs: Inputs, out: Tree, turn: jax.Array) -> tuple[Inputs, Tree]:
        picked = partial(every, turn=turn, stride=step, devices=devices) if step > 1 else lambda x: x
        one = lambda x, shared: x if shared else picked(x)
        return jax.tree.map(one, inputs, arguments.shared), jax.tree.map(picked, out)

    @once
    def spot(inputs: Inputs, out: Tree) -> Tree:
        return kernel.spot(replace(arguments, inputs=inputs), out)

    spots = spot(*pick(arguments.inputs, out, turn % step))
    refuted = partial(_refuted, turn=turn % step, step=step, devices=devices)
    return jax.tree.map(refuted, verdicts, spots, is_leaf=lambda x: hasattr(x, "failed"))


_JUDGES = {
    pace: compiled(_verdicts, static_argnums=(0, 1), pace=lambda *_, pace=pace: pace) for pace in ("brief", "soon")
}


@partial(compiled, static_argnums=(0,), pace=lambda *_: "soon")
def _corrected(kernel: Any, out: Tree, verdicts: Tree) -> Tree:
    return kernel.correct(out, verdicts)


def _refuted(verdict: Any, spots: jax.Array, turn: jax.Array, step: int, devices: int) -> Any:
    """A verdict with what was found on lane `turn` of every `step` of each device; nothing is confirmed there."""
    if step == 1:
        wrong = spots
    else:
        blocks = spots.reshape(devices, -1, 1) & (jnp.arange(step, dtype=turn.dtype) == turn)
        lanes = blocks.reshape(devices, -1)
        # Padded within each device: an axis that is divided cannot be.
        left = len(verdict.failed) // devices - lanes.shape[1]
        wrong = jnp.pad(lanes, ((0, 0), (0, left))).reshape(-1)
    unknown = {name: hidden(getattr(verdict, name), wrong, jnp.nan) for name in verdict._fields if name != "failed"}
    return verdict._replace(failed=verdict.failed | wrong, **unknown)


def _flags(verdicts: Tree) -> list[jax.Array]:
    return [x for x in jax.tree.leaves(verdicts) if x.dtype == bool]
