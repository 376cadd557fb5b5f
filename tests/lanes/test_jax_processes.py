"""Forked processes are refused in words, and nothing is compiled twice."""

from __future__ import annotations

import subprocess
import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax_sample import PUSHES, grasps

import jaxgrasp as jg

FORK = """
import os, sys, warnings
warnings.simplefilter("ignore")
from jax_sample import grasps, margin
contacts = grasps(2)
child = os.fork()
if not child:
    try:
        margin(contacts)
    except RuntimeError as error:
        print(error, flush=True)
    os._exit(0)
os.waitpid(child, 0)
"""


def test_a_forked_process_is_told_to_be_spawned():
    run = subprocess.run([sys.executable, "-c", FORK], capture_output=True, text=True, cwd="tests", timeout=100)
    assert "was used before this process was forked" in run.stdout and "'spawn'" in run.stdout, run.stderr


CALLS = {
    "solve_qp": lambda c: jg.solvers.solve_qp(np.eye(3), c.positions[:, 0]),
    "min_weight": lambda c: jg.metrics.min_weight(c),
    "force_closure": lambda c: jg.metrics.force_closure(c),
    "task_wrench": lambda c: jg.metrics.task_wrench(c, PUSHES),
    "isotropy": lambda c: jg.metrics.isotropy(c),
    "ferrari_canny_bound": lambda c: jg.metrics.ferrari_canny_bound(c),
}


@pytest.mark.parametrize("name", CALLS)
def test_a_second_call_compiles_nothing(name, compilations):
    first = jax.block_until_ready(grasps(2))
    second = jax.block_until_ready(jax.tree.map(lambda x: jnp.array(x[::-1]), first))
    jax.block_until_ready(CALLS[name](first))
    before = len(compilations)
    jax.block_until_ready(CALLS[name](second))
    assert len(compilations) == before
