"""Margins that a hand can produce, against HiGHS and Clarabel with every row written out."""

from dataclasses import dataclass, replace
from functools import partial

import clarabel
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.sparse
from oracles import actuated_rows, largest_actuated

import jaxgrasp as jg

# The gap to which margins and efforts are certified in float64 is 1e-8 of max(Lambda, margin), and Lambda is below 10.
TOLERANCE = 2e-8
# Derivatives of exact forces are those of a central point.
SMOOTHED = 1e-5
# Margins of large hands, relative to the larger of theirs and 1, and the share of grasps that are answered.
RELATIVE = {"float64": 1e-7, "float32": 5e-4}
ANSWERED = {"float64": 1.0, "float32": 0.98}
BATCH, CONTACTS, JOINTS = 60, 4, 9
PUSHES = jg.DisturbanceSet.forces(1.0)
WRENCHES = np.concatenate([np.eye(6)[:3], -np.eye(6)[:3]])
WEIGHT = np.array([0.1, 0.2, 0.98, 0.0, 0.001, 0.0])


@dataclass(frozen=True, kw_only=True)
class Hand:
    """Random grasps of a ball by a thumb against three fingers, joints that move random contacts."""

    contacts: jg.Contacts
    jacobian: np.ndarray
    transmission: np.ndarray
    lower: np.ndarray
    upper: np.ndarray
    compliance: np.ndarray | None

    @property
    def actuation(self) -> jg.Actuation:
        return jg.Actuation.from_jacobian(self.jacobian, self.transmission, self.lower, self.upper)

    @property
    def task(self) -> dict:
        return {"required_wrench": WEIGHT, "compliance": self.compliance, "actuation": self.actuation}


def make(count: int, actuators: int, redundant: bool, compliant: bool) -> Hand:
    rng = np.random.default_rng(3)
    normals = np.array([[-1.0, 0.0, 0.1], [0.8, -0.6, 0.2], [0.8, 0.6, 0.2], [0.9, 0.0, -0.7]])
    normals = normals + 0.25 * rng.normal(size=(count, CONTACTS, 3))
    normals /= np.linalg.norm(normals, axis=-1, keepdims=True)
    friction = rng.uniform(0.4, 0.9, (count, CONTACTS))
    transmission = np.eye(JOINTS)[:, :actuators] + 0.3 * rng.normal(size=(JOINTS, actuators))
    if redundant:
        transmission = np.column_stack([transmission, 0.7 * transmission[:, 0]])
    limits = rng.uniform(0.1, 0.3, (count, transmission.shape[1]))
    M = rng.normal(size=(count, 3 * CONTACTS, 3 * CONTACTS))
    return Hand(
        contacts=jg.Contacts.from_normals(0.03 * normals, normals, friction=friction, max_force=6.0),
        jacobian=0.05 * rng.normal(size=(count, CONTACTS, 3, JOINTS)),
        transmission=transmission,
        lower=-limits,
        upper=1.2 * limits,
        compliance=np.eye(3 * CONTACTS) + 0.1 * M @ M.swapaxes(-1, -2) if compliant else None,
    )


def rows_of(hand: Hand, lane: int, load: np.ndarray = WEIGHT) -> tuple:
    """(21) of one grasp with every row written out."""
    given = (jg.grasp_map(hand.contacts), hand.contacts.friction, hand.contacts.max_force)
    own = {name: getattr(hand, name)[lane] for name in ("jacobian", "lower", "upper")}
    compliance = None if hand.compliance is None else hand.compliance[lane]
    return actuated_rows(
        *(np.asarray(x)[lane] for x in given),
        own | {"transmission": hand.transmission},
        WRENCHES,
        load,
        compliance,
    )


def least(A: np.ndarray, h: np.ndarray, equal: np.ndarray, c: np.ndarray, margin: float, weights: np.ndarray) -> float:
    """The effort of (22) by Clarabel, with a full Q_0."""
    settings = clarabel.DefaultSettings()
    settings.verbose = False
    settings.tol_gap_abs = settings.tol_gap_rel = settings.tol_feas = 1e-11
    # Torques and moments are small numbers.
    size = np.abs(equal).max(1)
    equal, c = equal / size[:, None], c / size
    rows = scipy.sparse.csc_matrix(np.vstack([equal, A])[:, :-1])
    cones = [clarabel.ZeroConeT(len(c)), clarabel.NonnegativeConeT(len(h))]
    unit = weights.max()
    P = scipy.sparse.block_diag([np.triu(weights / unit), np.zeros((rows.shape[1] - 3 * CONTACTS,) * 2)], format="csc")
    right = np.concatenate([c, h - A[:, -1] * margin])
    return clarabel.DefaultSolver(P, np.zeros(rows.shape[1]), rows, right, cones, settings).solve().obj_val * unit


def without_friction(hand: Hand) -> Hand:
    """The last contact transmits its normal force alone."""
    return replace(hand, contacts=replace(hand.contacts, friction=hand.contacts.friction.at[:, -1].set(0)))


def make_hands(count: int) -> dict[str, Hand]:
    coupled = make(count, JOINTS - 2, redundant=True, compliant=True)
    return {
        "an actuator a joint": make(count, JOINTS, redundant=False, compliant=False),
        "two joint directions unreached, one reached twice": coupled,
        "a contact without friction": without_friction(coupled),
    }


HANDS = make_hands(BATCH)


def large_hand(count: int) -> Hand:
    """A thumb and four fingers of 22 joints, in four fingers two on one actuator, all with dry friction; 8 contacts."""
    rng = np.random.default_rng(5)
    finger = np.repeat(np.arange(5), [5, 4, 4, 4, 5])
    touching = np.array([0, 0, 1, 1, 2, 2, 3, 4])
    sides = np.array([[-1.0, 0.0, 0.1], [0.8, -0.6, 0.2], [0.8, 0.0, 0.2], [0.8, 0.6, 0.2], [0.6, 0.8, -0.4]])
    normals = sides[touching] + 0.25 * rng.normal(size=(count, 8, 3))
    normals /= np.linalg.norm(normals, axis=-1, keepdims=True)
    # The last two joints of the fingers are coupled.
    coupled = [np.flatnonzero(finger == f)[-2:] for f in (1, 2, 3, 4)]
    alone = np.setdiff1d(np.arange(22), np.concatenate(coupled))
    pairs = np.stack([np.eye(22)[pair].sum(0) for pair in coupled], 1)
    limits = np.concatenate([rng.uniform(0.2, 1.0, (count, 18)), rng.uniform(0.005, 0.03, (count, 22))], 1)
    reach = 0.04 * rng.normal(size=(count, 8, 3, 22))
    return Hand(
        contacts=jg.Contacts.from_normals(
            0.03 * normals, normals, friction=rng.uniform(0.4, 0.9, (count, 8)), max_force=6.0
        ),
        jacobian=np.where(touching[:, None, None] == finger, reach, 0),
        transmission=np.concatenate([np.eye(22)[:, alone], pairs, np.eye(22)], 1),
        lower=-limits,
        upper=limits * rng.uniform(0.8, 1.2, limits.shape),
        compliance=None,
    )


@pytest.fixture(scope="module", params=HANDS, ids=str)
def solved(request):
    hand = HANDS[request.param]
    found = jg.largest_disturbance(hand.contacts, PUSHES, **hand.task)
    return hand, found, np.array([largest_actuated(*rows_of(hand, lane)) for lane in range(BATCH)])


def test_margins_are_those_of_highs(solved):
    hand, found, truth = solved
    assert np.isfinite(truth).all()
    assert np.all(np.abs(found.margin - truth) <= TOLERANCE * np.maximum(10, np.abs(truth)))
    assert np.all(np.asarray(found.status) == np.where(truth < 0, jg.Status.INFEASIBLE, jg.Status.SOLVED))


@pytest.mark.thorough
@pytest.mark.parametrize("dtype", ["float64", "float32"])
def test_margins_of_five_thousand_configurations_of_a_large_hand_are_those_of_highs(dtype):
    # A load that not all can bear.
    hand, count, load = large_hand(5000), 5000, 8 * WEIGHT
    contacts, actuation, weight = jax.tree.map(
        lambda x: x.astype(dtype) if x.dtype.kind == "f" else x, (hand.contacts, hand.actuation, jnp.asarray(load))
    )
    pushes = jg.DisturbanceSet.forces(jnp.ones((), dtype))
    found = jg.largest_disturbance(contacts, pushes, required_wrench=weight, actuation=actuation)
    truth = np.array([largest_actuated(*rows_of(hand, lane, load)) for lane in range(count)])
    status = np.asarray(found.status)
    answered = np.isin(status, (jg.Status.SOLVED, jg.Status.INFEASIBLE))
    assert np.mean(answered) >= ANSWERED[dtype]
    off = np.abs(found.margin - truth)[answered] / np.maximum(1, np.abs(truth[answered]))
    # Where a load cannot be borne the margin need not be known.
    known = ~np.isnan(found.margin[answered])
    assert np.all(known | (status[answered] == jg.Status.INFEASIBLE)) and known.mean() > 0.7
    assert np.max(off[known]) <= RELATIVE[dtype]
    assert np.all((status == jg.Status.INFEASIBLE)[answered] == (truth < 0)[answered])
    assert 0.2 <= np.mean(truth >= 0) <= 0.95


def test_efforts_make_the_forces_and_stay_within_limits(solved):
    hand, found, _ = solved
    torque = hand.actuation.joint_torques(found.forces)
    np.testing.assert_allclose(torque, found.actuator_efforts @ hand.transmission.T, atol=1e-9)
    holds = np.asarray(found.margin) >= 0
    assert np.all((found.actuator_efforts <= hand.upper + 1e-9)[holds])
    assert np.all((found.actuator_efforts >= hand.lower - 1e-9)[holds])


@pytest.mark.thorough
def test_least_effort_is_that_of_clarabel():
    hand = HANDS["an actuator a joint"]
    margin = 0.75 * np.array([largest_actuated(*rows_of(hand, lane)) for lane in range(BATCH)])
    found = jg.least_effort(hand.contacts, PUSHES, np.maximum(margin, 0), **hand.task)
    holds = margin > 0
    assert holds.sum() > BATCH / 2
    assert np.all(np.asarray(found.status)[holds] == jg.Status.SOLVED)
    given = np.eye(3 * CONTACTS)
    truth = np.array([least(*rows_of(hand, lane), margin[lane], given) for lane in np.flatnonzero(holds)])
    np.testing.assert_allclose(found.effort[holds], truth, rtol=1e-6)


@pytest.mark.thorough
@pytest.mark.parametrize("name", HANDS)
def test_least_joint_torques_are_clarabels(name):
    # Of grasps with a contact without friction one in fifteen withstands anything.
    count = 10 * BATCH
    hand = make_hands(count)[name]
    margin = 0.75 * np.array([largest_actuated(*rows_of(hand, lane)) for lane in range(count)])
    solve = partial(jg.least_effort, hand.contacts, PUSHES, np.maximum(margin, 0), **hand.task)
    weights = np.asarray(hand.actuation.joint_torque_weights())
    found = solve(effort_weights=weights)
    holds = margin > 0
    assert holds.sum() > BATCH / 2
    assert np.all(np.asarray(found.status)[holds] == jg.Status.SOLVED)
    # Without friction a contact transmits its normal force alone; the others, free in these rows, weigh for themselves.
    felt = np.repeat(np.asarray(hand.contacts.friction) > 0, 3, 1)
    felt[:, 2::3] = True
    own = np.where(felt[:, :, None] & felt[:, None], weights, np.eye(3 * CONTACTS))
    truth = np.array([least(*rows_of(hand, lane), margin[lane], own[lane]) for lane in np.flatnonzero(holds)])
    unit = 1e-3 * np.abs(weights[holds]).max((1, 2)) * 6.0**2
    assert np.max(np.abs(found.effort[holds] - truth) / np.maximum(truth, unit)) <= 1e-7
    # No forces take smaller torques, up to what the lever adds.
    squares = lambda forces: np.sum(hand.actuation.joint_torques(forces) ** 2, -1)[holds]  # noqa: E731
    other = solve().forces
    lever = 1e-6 * np.sum(other**2, (1, 2))[holds]
    assert np.all(squares(found.forces) <= squares(other) + lever + 1e-9)


def moved(hand):
    """The grasps and the hand along a line through their data, at t."""
    rng = np.random.default_rng(0)
    start = {
        "positions": hand.contacts.positions,
        "jacobian": jnp.asarray(hand.jacobian),
        "transmission": jnp.asarray(hand.transmission),
        "upper": jnp.asarray(hand.upper),
        "weight": jnp.asarray(WEIGHT),
    }
    sizes = {"positions": 1e-3, "jacobian": 1e-2, "transmission": 0.1, "upper": 0.1, "weight": 0.1}
    along = {name: sizes[name] * rng.normal(size=x.shape) for name, x in start.items()}
    # Turned and stretched, so that what no actuator reaches does not become reached.
    along["transmission"] = sizes["transmission"] * rng.normal(size=(JOINTS, JOINTS)) @ hand.transmission

    def task(t):
        at = {name: x + t * along[name] for name, x in start.items()}
        normals = hand.contacts.frames[..., 2]
        contacts = jg.Contacts.from_normals(at["positions"], normals, friction=hand.contacts.friction, max_force=6.0)
        actuation = jg.Actuation.from_jacobian(at["jacobian"], at["transmission"], hand.lower, at["upper"])
        return contacts, {"required_wrench": at["weight"], "actuation": actuation}

    return task


@pytest.mark.thorough
@pytest.mark.parametrize(
    ("program", "name"),
    [
        ("largest_disturbance", "two joint directions unreached, one reached twice"),
        ("largest_disturbance", "an actuator a joint"),
        # Of the hand that does not reach two directions only few grasps have a margin to ask for.
        ("least_effort", "an actuator a joint"),
    ],
)
def test_derivatives_are_central_differences(program, name):
    moves = moved(HANDS[name])

    def answer(t):
        contacts, task = moves(t)
        if program == "largest_disturbance":
            return jg.largest_disturbance(contacts, PUSHES, **task).margin
        # Smoothed: central points are found to rounding, exact forces to 1e-8, which the step makes 1e-3.
        found = jg.least_effort(contacts, PUSHES, 0.02, smoothing=1e-4, **task)
        return jnp.concatenate([found.forces.reshape(BATCH, -1), 10 * found.actuator_efforts], 1)

    step, known = 1e-5, jax.jit(answer)
    numeric = np.asarray((known(step) - known(-step)) / (2 * step)).reshape(BATCH, -1)
    forward = np.asarray(jax.jit(lambda t: jax.jvp(answer, (t,), (1.0,))[1])(0.0)).reshape(BATCH, -1)
    answered = np.isfinite(numeric).all(-1) & np.isfinite(np.asarray(known(0.0)).reshape(BATCH, -1)).all(-1)
    off = np.abs(forward - numeric).max(-1)[answered] / np.maximum(1, np.abs(numeric).max(-1)[answered])
    assert answered.sum() >= 10
    # Where a row becomes active within the step there is a kink.
    assert np.quantile(off, 0.9) <= SMOOTHED
    weights = np.random.default_rng(1).normal(size=forward.shape)
    total = lambda t: jnp.sum(jnp.where(answered[:, None], weights * answer(t).reshape(BATCH, -1), 0))  # noqa: E731
    backward = jax.jit(jax.grad(total))(0.0)
    np.testing.assert_allclose(backward, np.sum((weights * forward)[answered]), rtol=1e-8)


def test_bad_limits_are_one_grasps_own_affair():
    hand = HANDS["an actuator a joint"]
    upper, jacobian = hand.upper.copy(), hand.jacobian.copy()
    upper[3, 2], upper[5, 1], jacobian[7, 0, 0, 0] = np.nan, hand.lower[5, 1] - 0.1, np.inf
    bad = jg.Actuation.from_jacobian(jacobian, hand.transmission, hand.lower, upper)
    good = jg.largest_disturbance(hand.contacts, PUSHES, **hand.task)
    found = jg.largest_disturbance(hand.contacts, PUSHES, required_wrench=WEIGHT, actuation=bad)
    wrong = np.isin(np.arange(BATCH), (3, 5, 7))
    assert np.all((np.asarray(found.status) == jg.Status.INVALID_INPUT) == wrong)
    np.testing.assert_array_equal(found.margin[~wrong], good.margin[~wrong])


def test_shapes_that_do_not_fit_are_named():
    hand = HANDS["an actuator a joint"]
    with pytest.raises(ValueError, match=r"transmission: got shape \(8, 9\), wanted \(\*batch, 9, n_u\)"):
        jg.Actuation.from_jacobian(hand.jacobian, hand.transmission[:-1], hand.lower, hand.upper)
    with pytest.raises(ValueError, match=r"upper: got shape \(60, 8\)"):
        jg.Actuation.from_jacobian(hand.jacobian, hand.transmission, hand.lower, hand.upper[:, :-1])
    short = jg.Actuation.from_jacobian(hand.jacobian[:, :3], hand.transmission, hand.lower, hand.upper)
    with pytest.raises(ValueError, match=r"actuation: got a jacobian .* one for each of the 4 contacts"):
        jg.largest_disturbance(hand.contacts, PUSHES, actuation=short)
    with pytest.raises(ValueError, match="wanted jaxgrasp.Actuation"):
        jg.largest_disturbance(hand.contacts, PUSHES, actuation=hand.jacobian)
