"""`jax.export`: on request, without kernels, for batches of any size; and programs for other platforms."""

from __future__ import annotations

import jax
import numpy as np
import pytest
from jax import export
from jax_sample import PUSHES, at, grasps

import jaxgrasp as jg


def test_kernels_are_not_exported_and_the_error_says_how_else():
    contacts = grasps(3)
    with pytest.raises(ValueError, match=r"export it inside `with jaxgrasp.without_kernels\(\)") as error:
        export.export(jax.jit(lambda p: at(p, contacts)))(contacts.positions)
    assert "\n" not in str(error.value)


FUNCTIONS = {
    "margin": lambda c: jg.largest_disturbance(c, PUSHES, cone_edges=4).margin,
    "effort": lambda c: jg.least_effort(c, PUSHES, 0.01, cone_edges=4).effort,
    "chain": lambda c: jg.formulation_margin(c, PUSHES, "12_fixed", cone_edges=4).margin,
    "total effort": lambda c: jg.least_total_effort(c, PUSHES, 0.01, cone_edges=4).effort,
}


@pytest.mark.parametrize(
    "name", ["margin", *(pytest.param(name, marks=pytest.mark.thorough) for name in FUNCTIONS if name != "margin")]
)
def test_any_number_of_grasps(name):
    normals = grasps(5).frames[..., 2]

    def values(normals):
        contacts = jg.Contacts.from_normals(0.05 * normals, normals, friction=0.5, max_force=1.0)
        return FUNCTIONS[name](contacts)

    (count,) = export.symbolic_shape("b")
    with jg.without_kernels():
        made = export.export(jax.jit(values))(jax.ShapeDtypeStruct((count, 4, 3), normals.dtype))
    found = values(normals)
    assert np.isfinite(found).any()
    np.testing.assert_allclose(made.call(normals), found, rtol=1e-7)
    np.testing.assert_allclose(made.call(normals[:2]), found[:2], rtol=1e-7)


def test_a_program_for_another_platform_has_no_kernel_of_this_one():
    contacts = grasps(3)
    traced = jax.jit(lambda p: at(p, contacts)).trace(contacts.positions)
    assert "@jaxgrasp_" in traced.lower().as_text()
    assert "@jaxgrasp_" not in traced.lower(lowering_platforms=("cuda",)).as_text()
