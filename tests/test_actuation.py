"""Margins that a hand can produce, against HiGHS and Clarabel with every row written out."""

import jax
import numpy as np
import pytest
from oracles import actuated_rows, largest_actuated

import jaxgrasp as jg

# The gap to which margins and efforts are certified in float64 is 1e-8 of max(1, margin / scale).
TOLERANCE = 2e-8
BATCH, CONTACTS, JOINTS, EDGES = 60, 4, 9, 8


def hands(seed: int, actuators: int, redundant: bool = False) -> tuple[jg.Contacts, dict]:
    """Random grasps of a ball by a thumb against three fingers, joints that move random contacts."""
    rng = np.random.default_rng(seed)
    normals = np.array([[-1.0, 0.0, 0.1], [0.8, -0.6, 0.2], [0.8, 0.6, 0.2], [0.9, 0.0, -0.7]])
    normals = normals + 0.25 * rng.normal(size=(BATCH, CONTACTS, 3))
    normals /= np.linalg.norm(normals, axis=-1, keepdims=True)
    contacts = jg.Contacts.from_normals(
        0.03 * normals, normals, friction=rng.uniform(0.4, 0.9, (BATCH, CONTACTS)), max_force=6.0
    )
    jacobian = 0.05 * rng.normal(size=(BATCH, CONTACTS, 3, JOINTS))
    transmission = np.eye(JOINTS)[:, :actuators] + 0.3 * rng.normal(size=(JOINTS, actuators))
    if redundant:
        transmission = np.column_stack([transmission, 0.7 * transmission[:, 0]])
    limits = rng.uniform(0.1, 0.3, (BATCH, transmission.shape[1]))
    return contacts, {"jacobian": jacobian, "transmission": transmission, "lower": -limits, "upper": 1.2 * limits}


def solved(contacts, hand, **given):
    actuation = jg.Actuation.from_jacobian(**hand)
    return jax.jit(lambda c: jg.largest_disturbance(c, PUSHES, actuation=actuation, **given))(contacts)


PUSHES = jg.DisturbanceSet.forces(1.0)
WRENCHES = np.concatenate([np.eye(6)[:3], -np.eye(6)[:3]])
WEIGHT = np.array([0.1, 0.2, 0.98, 0.0, 0.001, 0.0])


def rows_of(contacts: jg.Contacts, hand: dict, lane: int, compliance=None) -> tuple:
    """(21) of one grasp with every row written out."""
    own = {name: value if name == "transmission" else value[lane] for name, value in hand.items()}
    G, friction, max_force = (
        np.asarray(x)[lane] for x in (jg.grasp_map(contacts), contacts.friction, contacts.max_force)
    )
    return actuated_rows(
        G, friction, max_force, own, WRENCHES, WEIGHT, None if compliance is None else compliance[lane], EDGES
    )


@pytest.mark.parametrize("actuators, redundant", [(9, False), (7, False), (7, True)])
@pytest.mark.parametrize("compliant", [False, True])
def test_margin_against_highs(actuators, redundant, compliant):
    contacts, hand = hands(3, actuators, redundant)
    compliance = None
    if compliant:
        M = np.random.default_rng(1).normal(size=(BATCH, 3 * CONTACTS, 3 * CONTACTS))
        compliance = np.eye(3 * CONTACTS) + 0.1 * M @ M.swapaxes(-1, -2)
    found = solved(contacts, hand, required_wrench=WEIGHT, compliance=compliance)
    truth = np.array([largest_actuated(*rows_of(contacts, hand, lane, compliance)) for lane in range(BATCH)])
    print(np.c_[truth, found.margin, found.status, found.iterations][:10])
    assert np.isfinite(truth).all()
    assert np.all(np.abs(found.margin - truth) <= TOLERANCE * np.maximum(10, np.abs(truth)))
    assert np.all(np.asarray(found.status) == np.where(truth < 0, jg.Status.INFEASIBLE, jg.Status.SOLVED))
    torque = jg.Actuation.from_jacobian(**hand).joint_torques(found.forces)
    np.testing.assert_allclose(torque, found.actuator_efforts @ hand["transmission"].T, atol=1e-9)
