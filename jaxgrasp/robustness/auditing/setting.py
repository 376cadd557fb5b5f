"""How answers are audited, and what follows when one of them fails."""

import contextlib
import itertools
import os
import warnings
from collections.abc import Iterator

import jax

from jaxgrasp import kernels

SETTING = "JAXGRASP_AUDIT"
FORMS = ("sampled", "strict", "off")
# The default form recomputes S_1 and S_2 for one lane in this many, another one at every call: of sets with up to so
# many vertices. Of larger ones it looks at as many lanes fewer, so that it costs as much, but at `LEAST` of a batch.
STRIDE, VERTICES, LEAST = 16, 128, 8

# A context of JAX's, so that programs are traced anew where it changes.
_form = jax.make_user_context(None)
_turns = itertools.count()
_warned = False


@contextlib.contextmanager
def audit(form: str) -> Iterator[None]:
    """Choose how the answers of (21), (22), the chain and (11) are audited inside a `with` block.

    Every form but "off" checks each answer against the public arguments in plain XLA code: G f = b, the cone and bound
    rows at the claimed margin, the upper bound by its multipliers, and lower <= upper. An answer that does not pass
    gets `Status.NOT_VERIFIED`. The environment variable JAXGRASP_AUDIT chooses for the whole process.

    Args:
        form: "sampled", the default: every lane with the S_1 and S_2 that its solver used, and one lane in sixteen,
            other ones at each call, with S_1 and S_2 computed anew (of sets with more than 128 vertices as many lanes
            fewer, eight at least); of the chain and of (11) the forces alone.
            "strict": every lane with everything computed anew. "off": no audit.

    Raises:
        ValueError: another form.
    """
    with _form(_known("form", form)):
        yield


def chosen_form() -> str:
    """The form that counts now."""
    return _form.value or _known(SETTING, os.environ.get(SETTING, FORMS[0]))


def next_turn() -> int:
    """Count the calls, which look at one lane of every few after the other."""
    return next(_turns) % (1 << 30)


def step_of(lanes: int, vertices: int) -> int:
    """Find of how many lanes one is recomputed in a batch of so many, for a set of so many vertices."""
    return max(STRIDE, min(STRIDE * -(-vertices // VERTICES), lanes // LEAST))


def report(failed: int, lanes: int) -> None:
    """Warn, once a process, that answers failed, and have XLA run whatever is traced from now on."""
    global _warned
    kernels.distrust()
    if not _warned:
        _warned = True
        warnings.warn(
            f"{failed} of {lanes} answers failed the audit and have Status.NOT_VERIFIED; what is traced from now on "
            "runs on XLA in place of native kernels",
            RuntimeWarning,
            stacklevel=4,
        )


def _known(name: str, form: str) -> str:
    if form not in FORMS:
        raise ValueError(f"{name}: got {form!r}, wanted {', '.join(FORMS[:-1])} or {FORMS[-1]}")
    return form
