"""The package's data as values of JAX and Python: equality, hash, precision, and batches of nothing."""

from __future__ import annotations

import copy

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax_sample import PUSHES, grasps, margin

import jaxgrasp as jg

metrics = jg.metrics


def records():
    contacts = grasps(2)
    return [contacts, PUSHES, metrics.WrenchSpace(), jg.largest_disturbance(contacts, PUSHES, cone_edges=4)]


@pytest.mark.parametrize("value", records(), ids=lambda x: type(x).__name__)
def test_equal_values_are_equal(value):
    twin = copy.deepcopy(value)
    assert value == twin and value in [twin] and hash(value) == hash(twin) and value != 1
    assert {value: 3}[twin] == 3


def test_other_values_are_not():
    contacts = grasps(2)
    assert contacts != jax.tree.map(lambda x: x[:1], contacts)
    assert contacts != jax.tree.map(lambda x: 2 * x if x.dtype != bool else x, contacts)
    assert contacts != jax.tree.map(lambda x: x.astype(jnp.float32) if x.dtype != bool else x, contacts)
    assert PUSHES != jg.DisturbanceSet.ball(1.0)


EMPTY = {
    "margin": margin,
    "least_effort": lambda c: jg.least_effort(c, PUSHES, 0.1).forces,
    "compare_formulations": lambda c: jg.compare_formulations(c, PUSHES).margins["12"],
    "min_weight": metrics.min_weight,
    "force_closure": lambda c: metrics.force_closure(c).closed,
    "task_wrench": lambda c: metrics.task_wrench(c, PUSHES),
    "isotropy": metrics.isotropy,
    "smallest_singular_value": metrics.smallest_singular_value,
    "closure_residual": metrics.closure_residual,
    "ferrari_canny_bound": metrics.ferrari_canny_bound,
}


@pytest.mark.parametrize("name", EMPTY)
def test_no_grasps_at_all(name):
    assert EMPTY[name](jax.tree.map(lambda x: x[:0], grasps(1))).shape[:1] == (0,)


@pytest.mark.parametrize("dtype", [jnp.float16, jnp.bfloat16])
def test_half_precision_is_refused(dtype):
    half = jax.tree.map(lambda x: x.astype(dtype) if x.dtype != bool else x, grasps(2))
    for call in (margin, metrics.min_weight, lambda c: jg.worst_case(c, PUSHES)):
        with pytest.raises(ValueError, match=f"contacts: got dtype {jnp.dtype(dtype).name}, wanted float32") as error:
            call(half)
        assert "\n" not in str(error.value)


def test_what_is_no_number_is_refused_in_one_line():
    contacts = grasps(2)
    solution = jg.largest_disturbance(contacts, PUSHES, cone_edges=4)
    with pytest.raises(ValueError, match="^margin: got Solution, wanted an array of real numbers$"):
        jg.least_effort(contacts, PUSHES, solution)


def test_a_wrench_has_the_precision_of_what_it_is_of():
    assert jg.required_wrench(jnp.float32(1.0)).dtype == jnp.float32
    assert jg.required_wrench(1.0).dtype == jg.required_wrench(np.ones(2)).dtype == jnp.float64


def test_a_bad_transmission_is_an_inadmissible_grasp():
    contacts = grasps(2)
    jacobian = jnp.ones((2, 4, 3, 2))
    hand = jg.Actuation.from_jacobian(jacobian, np.array([[1.0, np.nan], [0.0, 1.0]]), -np.ones(2), np.ones(2))
    solution = jg.largest_disturbance(contacts, PUSHES, actuation=hand, cone_edges=4)
    assert (solution.status == jg.Status.INVALID_INPUT).all()


@pytest.mark.parametrize("turn", [np.diag([1.0, 1.0, -1.0]), 2 * np.eye(3), np.full((3, 3), np.nan)])
@pytest.mark.parametrize("pushes", [PUSHES, jg.DisturbanceSet.ball(1.0, 0.1)], ids=["vertices", "ball"])
def test_what_is_no_rotation_is_an_inadmissible_grasp(turn, pushes):
    turns = jnp.stack([jnp.eye(3), jnp.asarray(turn)])
    found = jg.worst_case(grasps(2), pushes.rotated(turns), cone_edges=4)[1]
    assert np.isfinite(found[0]).all() and np.isnan(found[1]).all()


@pytest.mark.parametrize("size", [1e-200, 1e-30, 1e30, 1e200])
def test_the_size_of_the_object_alone_changes_nothing(size):
    """Forces through the centre of mass ask for no moment, so lengths cancel, however far they are from 1."""
    contacts = grasps(4)
    scaled = jg.Contacts.from_frames(
        contacts.positions * size, contacts.frames, friction=contacts.friction, max_force=contacts.max_force
    )
    np.testing.assert_allclose(margin(scaled), margin(contacts), rtol=1e-7, atol=1e-9)
