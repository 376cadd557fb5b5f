"""An audit of every answer outside the code that found it: plain XLA, the public arguments, and nothing of the kernels.

Statuses come from the solver itself, so a fault of a kernel could call a wrong answer solved. The audit checks what an
answer claims and takes `Status.SOLVED` away where it does not stand.
"""

from abc import ABC, abstractmethod
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxgrasp.compiling import compiled
from jaxgrasp.contact.contacts import Contacts
from jaxgrasp.disturbance import DisturbanceSet
from jaxgrasp.robustness.arguments import Arguments, laid_out
from jaxgrasp.robustness.auditing import setting
from jaxgrasp.robustness.auditing.problem import every, picked
from jaxgrasp.robustness.auditing.setting import audit

__all__ = ["Audited", "audit", "audited", "hidden"]

Tree = Any
# Batches up to this size are recomputed whole: there is nothing to save.
_SMALL = 64


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
    def correct(self, out: Tree, verdicts: Tree) -> Tree:
        """The results with what the audit confirms in place of what it does not."""


def hidden(value: jax.Array, failed: jax.Array, instead: Any) -> jax.Array:
    """A result (*batch, ...) with something else where the audit failed, (*batch)."""
    mask = failed.reshape(*failed.shape, *[1] * (value.ndim - failed.ndim))
    return jnp.where(mask, jnp.asarray(instead, value.dtype), value)


def audited(kernel: Any, out: Tree, contacts: Contacts, disturbances: DisturbanceSet, given: dict) -> Tree:
    """Audit the results of a kernel in the form that is chosen, see `setting.audit`.

    A direct call that finds a wrong answer warns. Inside a transformation the audit is part of the program.

    Args:
        kernel: what was run; results of one that is not `Audited` are left as they are.
        out: its results, leaves (*batch, ...).
        contacts: the grasps.
        disturbances: the set D.
        given: the other arguments by their public names.
    """
    form = setting.chosen_form()
    if form == "off" or not isinstance(kernel, Audited):
        return out
    stride = 1 if form == "strict" else setting.STRIDE
    still = jax.lax.stop_gradient((contacts, disturbances, given, out))
    verdicts, failed = _verdicts(kernel, stride, *still, np.int32(setting.next_turn()))
    if not isinstance(failed, jax.core.Tracer):
        if not int(failed):
            return out
        setting.report(int(failed), max(1, int(np.prod(jax.tree.leaves(verdicts)[0].shape))))
    return kernel.correct(out, verdicts)


@partial(compiled, static_argnums=(0, 1))
def _verdicts(
    kernel: Any, stride: int, contacts: Contacts, disturbances: DisturbanceSet, given: dict, out: Tree, turn: jax.Array
) -> tuple[Tree, jax.Array]:
    """What the kernel judges, (*batch), and how many answers failed."""
    arguments = laid_out(contacts, disturbances, given)
    lead = len(arguments.batch)
    flat = jax.tree.map(lambda x: x.reshape(-1, *x.shape[lead:]), out)
    lanes = jax.tree.leaves(flat)[0].shape[0]
    verdicts = kernel.judge(arguments, flat, stride == 1 or lanes <= _SMALL)
    if stride > 1 and lanes > _SMALL:
        some = jax.tree.map(lambda x: every(x, turn, stride), flat)
        verdicts = jax.tree.map(
            partial(_merged, turn), verdicts, kernel.judge(picked(arguments, turn, stride), some, True)
        )
    failed = jnp.sum(jnp.stack([jnp.sum(verdict) for verdict in _flags(verdicts)]))
    return jax.tree.map(lambda x: x.reshape(*arguments.batch, *x.shape[1:]), verdicts), failed


def _merged(turn: jax.Array, coarse: jax.Array, fine: jax.Array) -> jax.Array:
    """Verdicts on all lanes with those on lane `turn` of every stride in their place."""
    stride = coarse.shape[0] // fine.shape[0]
    blocks = coarse[: fine.shape[0] * stride].reshape(-1, stride)
    blocks = jnp.where(jnp.arange(stride, dtype=turn.dtype) == turn, fine[:, None], blocks).reshape(-1)
    return jnp.concatenate([blocks, coarse[blocks.shape[0] :]])


def _flags(verdicts: Tree) -> list[jax.Array]:
    return [x for x in jax.tree.leaves(verdicts) if x.dtype == bool]
