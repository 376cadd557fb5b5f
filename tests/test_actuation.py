"""Margins that a hand can produce, against HiGHS and Clarabel with every row written out."""


import jax
import numpy as np
import pytest
import scipy.sparse
from scipy.optimize import linprog

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
    """(21) of one grasp over (f, u, lambda): A x <= h, B x = c."""
    G = np.asarray(jg.grasp_map(contacts))[lane]
    J = hand["jacobian"][lane].reshape(3 * CONTACTS, JOINTS)
    B, count = hand["transmission"], hand["transmission"].shape[1]
    left, values, _ = np.linalg.svd(B)
    N = left[:, np.sum(values > 1e-9) :]
    stacked = np.vstack([G, N.T @ J.T])
    root = np.linalg.cholesky(np.eye(3 * CONTACTS) if compliance is None else compliance[lane])
    star = np.linalg.solve(root.T, np.linalg.pinv(np.linalg.solve(root, stacked.T).T, 1e-9))[:, :6]
    force = -WRENCHES @ star.T
    effort = force @ J @ np.linalg.pinv(B).T
    k = np.arange(EDGES)
    angle = (2 * k + 1) * np.pi / EDGES
    blocks = [
        np.stack([np.cos(angle), np.sin(angle), np.full(EDGES, mu * np.cos(np.pi / EDGES))], -1)
        for mu in np.asarray(contacts.friction)[lane]
    ]
    C, E = scipy.linalg.block_diag(*blocks), np.kron(np.eye(CONTACTS), [0.0, 0.0, 1.0])
    worst = lambda change: np.maximum(change.max(0), 0)  # noqa: E731
    A = np.zeros((len(C) + CONTACTS + 2 * count, 3 * CONTACTS + count + 1))
    A[: len(C), : 3 * CONTACTS], A[len(C) : len(C) + CONTACTS, : 3 * CONTACTS] = C, -E
    A[-2 * count : -count, 3 * CONTACTS : -1], A[-count:, 3 * CONTACTS : -1] = np.eye(count), -np.eye(count)
    A[:, -1] = np.concatenate([worst(force @ C.T), worst(-force @ E.T), worst(effort), worst(-effort)])
    h = np.concatenate(
        [np.zeros(len(C)), np.asarray(contacts.max_force)[lane], hand["upper"][lane], -hand["lower"][lane]]
    )
    equal = np.zeros((6 + JOINTS, A.shape[1]))
    equal[:6, : 3 * CONTACTS], equal[6:, : 3 * CONTACTS], equal[6:, 3 * CONTACTS : -1] = G, J.T, -B
    return A, h, equal, np.concatenate([WEIGHT, np.zeros(JOINTS)])


def by_highs(A, h, equal, c) -> float:
    cost = np.append(np.zeros(A.shape[1] - 1), -1.0)
    # Torques and moments are small numbers.
    size = np.abs(equal).max(1)
    out = linprog(
        cost, A, h, equal / size[:, None], c / size, (None, None), "highs",
        options={"primal_feasibility_tolerance": 1e-10, "dual_feasibility_tolerance": 1e-10},
    )  # fmt: skip
    return -out.fun if out.status == 0 else np.nan


@pytest.mark.parametrize("actuators, redundant", [(9, False), (7, False), (7, True)])
@pytest.mark.parametrize("compliant", [False, True])
def test_margin_against_highs(actuators, redundant, compliant):
    contacts, hand = hands(3, actuators, redundant)
    compliance = None
    if compliant:
        M = np.random.default_rng(1).normal(size=(BATCH, 3 * CONTACTS, 3 * CONTACTS))
        compliance = np.eye(3 * CONTACTS) + 0.1 * M @ M.swapaxes(-1, -2)
    found = solved(contacts, hand, required_wrench=WEIGHT, compliance=compliance)
    truth = np.array([by_highs(*rows_of(contacts, hand, lane, compliance)) for lane in range(BATCH)])
    print(np.c_[truth, found.margin, found.status, found.iterations][:10])
    assert np.isfinite(truth).all()
    assert np.all(np.abs(found.margin - truth) <= TOLERANCE * np.maximum(10, np.abs(truth)))
    assert np.all(np.asarray(found.status) == np.where(truth < 0, jg.Status.INFEASIBLE, jg.Status.SOLVED))
    torque = jg.Actuation.from_jacobian(**hand).joint_torques(found.forces)
    np.testing.assert_allclose(torque, found.actuator_efforts @ hand["transmission"].T, atol=1e-9)
