"""Forces for a whole box of grasps, and forces that hold with a probability."""

from __future__ import annotations

import itertools
import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from test_margin_distribution import PUSHES, WEIGHT, grasps

import jaxgrasp as jg
from jaxgrasp.uncertainty import box_effort, normal, samples, scenario_effort, uniform

BOX = jg.Uncertainty.of(
    friction=uniform(0.05, correlation=1.0),
    max_force=uniform(0.1, correlation=1.0),
    mass=uniform(0.2),
    load=uniform([0.02, 0.0, 0.02, 0.0, 0.0005, 0.0]),
)
SPEC = jg.Uncertainty.of(friction=0.02, position=0.0003, normal=normal(0.02), center_of_mass=0.0005)
PROBABILITY = 0.9


def one() -> jg.Contacts:
    """A grasp, twice, with room for errors."""
    known = jax.tree.map(lambda x: jnp.stack([x[0]] * 2), grasps())
    return jg.Contacts.from_frames(
        known.positions, known.frames, friction=0.6, max_force=jnp.array([[6.0], [8.0]]).repeat(4, 1)
    )


def test_forces_of_a_box_hold_at_its_corners_and_no_more():
    margin = 0.4 * jg.largest_disturbance(one(), PUSHES, WEIGHT).margin
    found = box_effort(one(), PUSHES, margin, BOX, WEIGHT)
    known = jg.least_effort(one(), PUSHES, margin, WEIGHT)
    assert (np.asarray(found.status) == jg.Status.SOLVED).all()
    assert (np.asarray(found.effort) > np.asarray(known.effort)).all()

    signs = np.array(list(itertools.product([-1.0, 1.0], repeat=6)))
    zero = np.zeros(len(signs))
    load = np.stack([0.02 * signs[:, 3], zero, 0.02 * signs[:, 4], zero, 0.0005 * signs[:, 5], zero], 1)
    corners = jg.Uncertainty.of(
        friction=samples(0.05 * signs[:, 0]),
        max_force=samples(0.1 * signs[:, 1]),
        mass=samples(0.2 * signs[:, 2]),
        load=samples(load),
    )
    hold = lambda forces, scale: np.asarray(
        jg.margin_distribution(one(), PUSHES, corners, WEIGHT, forces=forces, margin=scale * margin).p_hold.value
    )
    assert (hold(found.forces, 1.0) == 1).all()
    # It is the least effort: rows of some corner are used up.
    assert (hold(found.forces, 1.01) < 1).all()
    assert (hold(known.forces, 1.0) < 1).all()


def test_forces_from_draws_hold_in_them_and_as_often_as_asked_in_others():
    margin = 0.4 * jg.largest_disturbance(one(), PUSHES, WEIGHT).margin
    found = scenario_effort(one(), PUSHES, margin, SPEC, PROBABILITY, WEIGHT, samples=400, seed=3)
    assert (np.asarray(found.status) == jg.Status.SOLVED).all()
    assert (np.asarray(found.effort) >= np.asarray(found.known_effort)).all()
    assert (np.asarray(found.p_hold.high) >= PROBABILITY).all()
    used = math.ceil(3 * 4 / (1 - PROBABILITY))
    again = jg.margin_distribution(
        one(), PUSHES, SPEC, WEIGHT, forces=found.forces, margin=margin, samples=used, seed=3
    )
    # The first draw is replaced by the grasp as it is known.
    assert (np.asarray(again.p_hold.value) >= 1 - 1 / used - 1e-9).all()
    plain = jg.least_effort(one(), PUSHES, margin, WEIGHT).forces
    bare = jg.margin_distribution(one(), PUSHES, SPEC, WEIGHT, forces=plain, margin=margin, samples=used, seed=3)
    assert (np.asarray(bare.p_hold.value) < PROBABILITY).all()


@pytest.mark.parametrize(
    ("call", "words"),
    [
        (lambda: box_effort(one(), PUSHES, 1.0, jg.Uncertainty.of(position=uniform(0.1))), "scenario_effort"),
        (lambda: box_effort(one(), PUSHES, 1.0, jg.Uncertainty.of(friction=0.1)), "uniform"),
        (lambda: scenario_effort(one(), PUSHES, 1.0, SPEC, 1.0), "probability"),
        (lambda: scenario_effort(one(), PUSHES, 1.0, jg.Uncertainty.of(mass=samples([0.1]))), "distributions"),
    ],
)
def test_what_cannot_be_asked_is_refused(call, words):
    with pytest.raises(ValueError, match=r"got .*wanted ") as caught:
        call()
    assert words in str(caught.value)
