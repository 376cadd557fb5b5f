"""Which loops of a jaxpr are written out, round by round, and how much code that makes."""

import math

from jax.extend.core import Jaxpr, jaxprs_in_params

from jaxgrasp.kernels.program.entries import aval_of

# Unroll limits, in rounds: of any loop, since the first round often starts from zeros and nobody reads all that the
# last one leaves; of loops whose body reads the counter; of loops that stack results.
_SHORT, _COUNTED, _STACKED = 2, 16, 64
# A loop whose body reads the counter stays one where its rounds have more entries than this in all: code this long
# gains nothing by knowing the counter, and compiles for as long as there are rounds.
_MOST_UNROLLED = 1 << 13
# The most entries of all arrays in a kernel, of which a third to a half are operations; more would compile for minutes.
MOST_ENTRIES = 700_000
STAYS = "in_turn"
"""The name of a function that is the body of a loop which is not written out, see `lanes.fence.in_turn`."""


def entries_of(jaxpr: Jaxpr) -> int:
    """Count the entries of all arrays that are computed, in a loop once for each round that may be unrolled."""
    total = 0
    for eqn in jaxpr.eqns:
        total += sum(math.prod(aval_of(v).shape) for v in eqn.outvars)
        inner = sum(entries_of(j) for j in jaxprs_in_params(eqn.params))
        total += inner * (eqn.params["length"] if eqn.primitive.name == "scan" and may_unroll(eqn.params) else 1)
    return total


def stays(body: Jaxpr) -> bool:
    """Tell whether a loop shall stay one, however short: its body is nothing but a call of a function named `STAYS`."""
    return len(body.eqns) == 1 and body.eqns[0].params.get("name") == STAYS


def may_unroll(params: dict, counted: bool = True) -> bool:
    """Tell whether the rounds of a scan are written one after the other, where its body reads its counter or not."""
    body, length = params["jaxpr"], params["length"]
    if stays(body.jaxpr):
        return False
    stacks = len(body.jaxpr.outvars) > params["num_carry"]
    if length <= _SHORT or (stacks and length <= _STACKED):
        return True
    if not counted or length > _COUNTED:
        return False
    return _slices_carried(params) or length * entries_of(body.jaxpr) <= _MOST_UNROLLED


def _slices_carried(params: dict) -> bool:
    """Tell whether a round slices, at its counter, what rounds before it computed; a loop has no code for that."""
    body, n_consts = params["jaxpr"].jaxpr, params["num_consts"]
    carried = body.invars[n_consts : n_consts + params["num_carry"]]
    sliced = [eqn.invars[0] for eqn in body.eqns if eqn.primitive.name.startswith("dynamic_")]
    return any(x is y for x in sliced for y in carried)
