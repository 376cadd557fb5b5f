"""JAX's debug modes, which ask for things that are no faults here."""

from __future__ import annotations

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax_sample import at, grasps, margin, min_weight

import jaxgrasp as jg


def bad():
    contacts = grasps(3)
    return replace(contacts, friction=contacts.friction.at[0].set(np.nan))


def quadratic(q):
    return jg.solvers.solve_qp(np.eye(2), q, None, None, -np.eye(2), np.zeros(2)).objective


BAD = bad()
CALLS = {
    "margin": lambda: margin(grasps(3)),
    "inadmissible": lambda: margin(BAD),
    "slope": lambda: jax.grad(lambda p: at(p, grasps(3)).sum())(grasps(3).positions),
    "mapped": lambda: jax.vmap(margin)(grasps(3)),
    "min_weight": lambda: min_weight(grasps(3)),
    "required_wrench": lambda: jg.required_wrench(np.ones(5)),
    "solve_qp": lambda: quadratic(-jnp.ones(2)),
    "slope of solve_qp": lambda: jax.grad(quadratic)(-jnp.ones(2)),
}
MODES = {
    "nan": lambda: jax.debug_nans(True),
    "inf": lambda: jax.debug_infs(True),
    "leaks": jax.checking_leaks,
    "rank": lambda: jax.numpy_rank_promotion("raise"),
    "no jit": jax.disable_jit,
}


@pytest.mark.parametrize("call", CALLS)
@pytest.mark.parametrize("mode", MODES)
def test_the_same_answers(call, mode):
    wanted = CALLS[call]()
    with MODES[mode]():
        found = CALLS[call]()
    np.testing.assert_allclose(found, wanted, rtol=1e-9)
