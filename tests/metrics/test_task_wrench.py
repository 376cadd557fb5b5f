"""How much of a task a grasp can exert, against HiGHS: grasps with and without closure, of all ranks."""

from __future__ import annotations

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.optimize import linprog

import jaxgrasp as jg
from jaxgrasp import metrics
from jaxgrasp.candidates import sample_grasps
from jaxgrasp.metrics import WrenchSpace

COUNT = 160
TOLERANCE = {"float64": 1e-8, "float32": 2e-4}
"""Of a factor, of the larger of itself and 0.01."""
SPACE = WrenchSpace(cone_edges=4)
TASKS = {
    "forces": jg.DisturbanceSet.forces(1.0),
    "up": jg.DisturbanceSet.vertices([[0, 0, 1.0, 0, 0, 0]]),
    "mixed": jg.DisturbanceSet.vertices([[0.3, 0.2, -1, 0.01, 0, 0], [0, 1, 0, 0, 0, 0.02], [0, 0, 0, 0, 0, 0]]),
}
EXACT = {"primal_feasibility_tolerance": 1e-10, "dual_feasibility_tolerance": 1e-10, "presolve": False}
task = jax.jit(metrics.task_wrench)


def contacts_of(dtype: str = "float64") -> jg.Contacts:
    """A thumb and three fingers; of eight, two push from one side, one is on a line, one is a jaw."""
    found = sample_grasps(COUNT, seed=2)
    positions, normals = np.array(found.positions), np.array(found.outward_normals)
    normals[::4, :, 2] = -np.abs(normals[::4, :, 2]) - 1
    rng = np.random.default_rng(3)
    line = rng.normal(size=(len(positions[2::8]), 1, 3))
    positions[2::8] = 0.03 * line * rng.uniform(-1, 1, (len(line), 4, 1))
    # Twice two opposite contacts: nothing holds against turns about their line.
    jaw = positions[6::8, :1] / np.linalg.norm(positions[6::8, :1], axis=-1, keepdims=True)
    sides = np.array([1, -1, 1, -1])[:, None]
    positions[6::8], normals[6::8] = 0.03 * jaw * sides, jaw * sides
    places, directions, friction, most = (np.asarray(x, dtype) for x in (positions, normals, 0.6, 1.0))
    return jg.Contacts.from_normals(places, directions, friction=friction, max_force=most)


def by_highs(contacts: jg.Contacts, vertices: np.ndarray) -> np.ndarray:
    found = np.full(COUNT, np.inf)
    W = np.asarray(metrics.edge_wrenches(contacts, replace(SPACE, length=1.0))).reshape(COUNT, -1, 6)
    for row, points in enumerate(W):
        for wrench in vertices[vertices.any(-1)]:
            # Moments in units of 3 cm, so that HiGHS sees numbers of one size.
            unit = np.repeat([1, 0.03], 3)
            equal = np.column_stack([(points / unit).T, -wrench / unit])
            cost, total = np.append(np.zeros(len(points)), -1), np.append(np.ones(len(points)), 0)
            solved = linprog(cost, total[None], [1], equal, np.zeros(6), options=EXACT, method="highs")
            found[row] = min(found[row], -solved.fun)
    return found


@pytest.mark.parametrize("name", TASKS)
def test_factors_are_those_of_highs(name):
    contacts = contacts_of()
    wanted = by_highs(contacts, np.asarray(TASKS[name].terms[0].wrenches))
    ours = np.asarray(task(contacts, TASKS[name], SPACE))
    assert 0.1 < np.mean(wanted > 1e-9) < 0.9
    np.testing.assert_array_equal(ours == 0, wanted <= 1e-9)
    assert np.all(np.abs(ours - wanted) <= TOLERANCE["float64"] * np.maximum(wanted, 1e-2))


@pytest.mark.parametrize("name", TASKS)
def test_single_precision_is_right_or_says_nothing(name):
    wanted = np.asarray(task(contacts_of(), TASKS[name], SPACE))
    ours = np.asarray(task(contacts_of("float32"), TASKS[name], SPACE))
    assert ours.dtype == np.float32
    known = ~np.isnan(ours)
    assert known.mean() >= 0.95
    assert np.all(np.abs(ours - wanted)[known] <= TOLERANCE["float32"] * np.maximum(wanted, 1e-2)[known])


def test_derivatives_are_those_of_differences():
    contacts = contacts_of()
    along = jnp.asarray(np.random.default_rng(5).normal(size=contacts.positions.shape))
    moved = lambda step: replace(contacts, positions=contacts.positions + step * along)  # noqa: E731
    value, slope = jax.jit(
        lambda c: jax.jvp(lambda p: task(replace(c, positions=p), TASKS["forces"], SPACE), (c.positions,), (along,))
    )(contacts)
    steps = [1e-6, -1e-6]
    above, below = (np.asarray(task(moved(step), TASKS["forces"], SPACE)) for step in steps)
    central = (above - below) / 2e-6
    # Where the worst wrench or the edges that bear it change within the step, both sides differ.
    smooth = (value > 0) & (np.abs((above - value) - (value - below)) <= 1e-9 * np.maximum(np.abs(central), 1))
    assert smooth.sum() >= COUNT // 5
    np.testing.assert_allclose(slope[smooth], central[smooth], atol=1e-5 * np.abs(central[smooth]).max())


def test_factors_turn_with_the_object_keep_in_any_unit_and_grow_with_friction():
    contacts = contacts_of()
    before = np.asarray(task(contacts, TASKS["mixed"], SPACE))
    R = np.linalg.qr(np.random.default_rng(0).normal(size=(3, 3)))[0]
    R *= np.linalg.det(R)
    turned = replace(contacts, positions=contacts.positions @ R.T, frames=R @ contacts.frames)
    np.testing.assert_allclose(before, task(turned, TASKS["mixed"].rotated(R), SPACE), atol=1e-7)
    rng = np.random.default_rng(1)
    other = replace(SPACE, length=rng.uniform(0.01, 0.1, COUNT), reference=0.02 * rng.normal(size=(COUNT, 3)))
    np.testing.assert_allclose(before, task(contacts, TASKS["mixed"], other), atol=1e-7)
    rougher = replace(contacts, friction=contacts.friction + 0.1)
    assert np.all(task(rougher, TASKS["mixed"], SPACE) >= before - 1e-7)


def test_a_bad_grasp_and_a_bad_task_spoil_themselves_alone():
    contacts = contacts_of()
    before = np.asarray(task(contacts, TASKS["mixed"], SPACE))
    bad = np.asarray(task(replace(contacts, frames=contacts.frames.at[5].set(0.0)), TASKS["mixed"], SPACE))
    assert np.isnan(bad[5])
    np.testing.assert_array_equal(np.delete(bad, 5), np.delete(before, 5))
    own = np.tile(np.asarray(TASKS["mixed"].terms[0].wrenches), (COUNT, 1, 1))
    own[7, 1, 2] = np.nan
    bad = np.asarray(task(contacts, jg.DisturbanceSet.vertices(own), SPACE))
    assert np.isnan(bad[7])
    np.testing.assert_allclose(np.delete(bad, 7), np.delete(before, 7), atol=1e-9)


def test_absent_contacts_and_tasks_without_wrenches():
    contacts = contacts_of()
    three = jax.tree.map(lambda x: x[:, :3], contacts)
    fourth = replace(contacts, active=jnp.ones((COUNT, 4), bool).at[:, 3].set(False))
    np.testing.assert_allclose(task(three, TASKS["up"], SPACE), task(fourth, TASKS["up"], SPACE), atol=1e-7)
    nobody = replace(contacts, active=jnp.zeros((COUNT, 4), bool))
    assert np.all(np.asarray(task(nobody, TASKS["up"], SPACE)) == 0)
    nothing = jg.DisturbanceSet.vertices(np.zeros((1, 6)))
    assert np.all(np.isinf(task(contacts, nothing, SPACE)))
