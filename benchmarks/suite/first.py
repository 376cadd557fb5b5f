"""A fresh process that imports nothing but what it needs and solves one batch; see `fresh.py`."""

import sys
from functools import partial

import jax
import numpy as np

import jaxgrasp as jg


def main(how: str, dtype: str, count: str) -> None:
    jax.config.update("jax_enable_x64", dtype == "float64")
    normals = np.random.default_rng(0).normal(size=(int(count), 4, 3)).astype(dtype)
    normals /= np.linalg.norm(normals, axis=-1, keepdims=True)
    contacts = jg.Contacts.from_normals(normals, normals, friction=0.8, max_force=2.0)
    solve = {"direct": jg.largest_disturbance, "jit": jax.jit(jg.largest_disturbance)}.get(how)
    if how.startswith("formulation "):
        solve = partial(jg.formulation_margin, formulation=how.split()[1])
    elif how == "total effort":
        solve = jg.least_total_effort
    elif how == "comparison":
        solve = jg.compare_formulations
    if solve is not None:
        jax.block_until_ready(solve(contacts, jg.DisturbanceSet.forces(1.0)))


if __name__ == "__main__":
    main(*sys.argv[1:])
