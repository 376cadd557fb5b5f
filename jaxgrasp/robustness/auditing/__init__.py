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
from jaxgrasp.robustness.arguments import laid_out
from jaxgrasp.robustness.auditing import setting
from jaxgrasp.robustness.auditing.problem import Problem, problem_of

Tree = Any
# Batches up to this size are recomputed whole: there is nothing to save.
_SMALL = 64


class Audited(ABC):
    """A kernel whose answers can be audited."""

    @abstractmethod
    def judge(self, problem: Problem, out: Tree, turn: jax.Array, stride: int) -> Tree:
        """Verdicts with a field `failed`, bool (lanes,), on results with lanes leading.

        Args:
            problem: the public arguments.
            out: the kernel's results.
            turn: which lane of every `stride` is computed anew.
            stride: 1 computes all of them anew.
        """

    @abstractmethod
    def correct(self, out: Tree, verdicts: Tree) -> Tree:
        """The results with what the audit confirms in place of what it does not."""


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
    verdicts = kernel.judge(problem_of(arguments), flat, turn, stride if lanes > _SMALL else 1)
    failed = jnp.sum(jnp.stack([jnp.sum(verdict) for verdict in _flags(verdicts)]))
    return jax.tree.map(lambda x: x.reshape(*arguments.batch, *x.shape[1:]), verdicts), failed


def _flags(verdicts: Tree) -> list[jax.Array]:
    return [x for x in jax.tree.leaves(verdicts) if x.dtype == bool]
