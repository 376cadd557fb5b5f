"""Derivatives of contacts and margins with respect to configurations, against central differences.

Differences count where those of a step and of half a step agree: there the same features touch on both sides.
"""

from __future__ import annotations

from dataclasses import replace

import hand_configurations as configurations
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hand_models import finger, random_configurations
from test_hand_inputs import PARTS

import jaxgrasp as jg
from jaxgrasp.hands import HandObject

WORST = 1e-5
AGREE = 2e-6
COUNTED = 0.8
CONTACTS = 4
"""Of the grasps whose margins are differentiated; what more contacts cost is compilation."""


def check(function, qpos: np.ndarray, step: float, seed: int = 0) -> None:
    """`function` maps (n, nq) to a dictionary of (n, ...)."""
    rng = np.random.default_rng(seed)
    direction = rng.normal(size=qpos.shape)
    # Without a jit around it all: each part is a program of its own, which is far less to compile.
    value, pushed = jax.jvp(function, (qpos,), (direction,))
    cotangent = jax.tree.map(lambda x: rng.normal(size=x.shape), value)
    (pulled,) = jax.vjp(function, qpos)[1](cotangent)
    ends = [function(qpos + h * direction) for h in (step, -step, step / 2, -step / 2)]
    both = np.zeros(len(qpos))
    for name in value:
        flat = lambda x: np.asarray(x).reshape(len(qpos), -1)  # noqa: E731
        coarse = flat(ends[0][name] - ends[1][name]) / (2 * step)
        fine = flat(ends[2][name] - ends[3][name]) / step
        size = np.maximum(1, np.abs(fine))
        fits = np.all(np.abs(coarse - fine) <= AGREE * size, -1)
        error = (np.abs(flat(pushed[name]) - fine) / size).max(-1)
        print(name, "counted", fits.mean(), "worst", error[fits].max(initial=0))
        assert fits.mean() >= COUNTED
        assert np.abs(fine[fits]).max() > 0.1
        assert error[fits].max() <= WORST
        both += np.sum(flat(pushed[name]) * flat(cotangent[name]), -1)
    reverse = np.sum(np.asarray(pulled) * direction, -1)
    np.testing.assert_allclose(reverse, both, rtol=1e-9, atol=1e-9)


@pytest.mark.thorough
def test_contacts():
    model = finger('<actuator><position joint="b" kp="2"/></actuator>', objects=PARTS)
    hand = HandObject.from_mjcf(model, "object", contact_distance=0.0, points_per_link=None, max_contacts=6)

    def outputs(qpos):
        grasps = hand.grasps(qpos)
        return {
            "distances": grasps.distances,
            "positions": grasps.contacts.positions,
            "normals": grasps.contacts.frames[..., 2],
            "jacobian": grasps.actuation.jacobian,
            "required_wrench": grasps.required_wrench,
        }

    check(outputs, random_configurations(model, 100), 1e-6)


@pytest.mark.thorough
@pytest.mark.parametrize("scene", ["four_fingers", "shadow_hand"])
def test_margins(scene):
    this = configurations.case(scene, "sphere")
    touched = zip(this.grasps.links.tolist(), this.grasps.touching, strict=True)
    links = np.array([len(set(row[:count])) for row, count in touched])
    qpos = this.qpos[(links >= 3) & (this.grasps.touching <= CONTACTS)][:20]

    def outputs(qpos):
        grasps = this.hand.grasps(qpos)
        contacts = jax.tree.map(lambda x: x[:, :CONTACTS], grasps.contacts)
        actuation = replace(grasps.actuation, jacobian=grasps.actuation.jacobian[:, :CONTACTS])
        solution = jg.largest_disturbance(
            contacts,
            jg.DisturbanceSet.forces(1.0),
            required_wrench=grasps.required_wrench,
            actuation=actuation,
            # Central points are found to rounding, the margin itself to 1e-8 alone.
            smoothing=jnp.full(len(qpos), 1e-4),
        )
        return {"margin": solution.margin}

    check(outputs, qpos, 1e-6)
