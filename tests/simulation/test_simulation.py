"""Pushed hands in C MuJoCo: paths, joint dynamics, controllers, and the runs of section V in short."""

from __future__ import annotations

import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from pictures import has_context
from PIL import Image

import jaxgrasp as jg
from jaxgrasp.hands import HandObject
from jaxgrasp.hands.dynamics import joint_dynamics, object_inertia
from jaxgrasp.hands.scenes import four_fingers
from jaxgrasp.simulation import ComputedTorque, ForceOptimization, JointSprings, Path, Push, Simulator, torque_hand
from jaxgrasp.simulation.control import Impedance, Wanted, goal_of
from jaxgrasp.simulation.simulator import _rotation_vectors, _rotations
from jaxgrasp.simulation.state import measure
from jaxgrasp.viewer import figure_of_motions, figure_of_pushes
from jaxgrasp.viewer.movie import write_movie

ROUNDING = 1e-12
EIGHT_EDGES = np.cos(np.pi / 8)
BEGIN, SECONDS = 0.05, 0.3
BASELINE = np.tile([0.0, 0.0, -0.5], (4, 1))
PUSHES = np.array([[1.0, 0, 0, 0, 0, 0], [0, 0, 1, 0, 0, 0]])


@pytest.fixture(scope="module")
def sim() -> Simulator:
    return Simulator.from_spec(torque_hand("sphere", gravity=False))


@pytest.fixture(scope="module")
def plan(sim):
    """Margin of the grasp around the ball, its tightening forces for 0.85 of that, and the grasp."""
    grasp = sim.grasps(sim.around[None])
    unit = jg.DisturbanceSet.forces(1.0)
    largest = jg.largest_disturbance(grasp.contacts, unit)
    hold = jg.least_effort(grasp.contacts, unit, 0.85 * largest.margin)
    return float(largest.margin[0]), np.asarray(hold.forces[0]), grasp


def pushed(sim, plan, forces, controller, share=0.75, **options):
    push = Push(wrench=share * plan[0] * PUSHES, begin=BEGIN)
    return sim.run(np.tile(sim.around, (2, 1)), np.tile(forces, (2, 1, 1)), controller, push, SECONDS, **options)


def state_and_goal(sim, plan) -> tuple:
    """Of a hand and a ball that are on their way, not where they should be."""
    rng, model = np.random.default_rng(1), sim.hand.model
    qpos = np.tile(sim.around, (3, 1))
    qpos[:, 12:15] += 2e-4 * rng.normal(size=(3, 3))
    qvel = 0.05 * rng.normal(size=(3, model.nv))
    state = measure(sim.hand, jnp.asarray(qpos), jnp.asarray(qvel), jnp.ones((3, 4), bool))
    wanted = Wanted(state.position + 1e-4, state.rotation, np.zeros((3, 6)), 0.1 * np.ones((3, 6)))
    forces = np.tile(plan[1].reshape(-1), (3, 1))
    limit = model.actuator_forcerange[:, 1]
    return state, goal_of(Impedance(), state, wanted, forces, qpos[:, :12], limit)[0]


@pytest.fixture(scope="module")
def on_the_way(sim, plan):
    return state_and_goal(sim, plan)


def test_dynamics_are_those_of_mujoco():
    model = four_fingers("box").compile()
    hand, data, rng = HandObject.from_mjcf(model, "object"), mujoco.MjData(model), np.random.default_rng(0)
    qpos = np.tile(model.qpos0, (5, 1))
    qpos[:, :12] += rng.uniform(-0.5, 0.5, (5, 12))
    inertia, weight = joint_dynamics(hand, qpos)
    for lane in range(5):
        data.qpos[:] = qpos[lane]
        mujoco.mj_forward(model, data)
        full = np.zeros((model.nv, model.nv))
        mujoco.mj_fullM(model, data, full)
        np.testing.assert_allclose(inertia[lane], full[np.ix_(hand.dofs, hand.dofs)], atol=ROUNDING)
        np.testing.assert_allclose(weight[lane], data.qfrc_bias[hand.dofs], atol=ROUNDING)
        turned = full[15:18, 15:18]
        np.testing.assert_allclose(object_inertia(model, hand.object_body), turned, atol=ROUNDING)


def test_a_path_passes_from_rest_to_rest():
    goal = np.array([[0.0, -0.02, 0, 0.1, 0, 0], [0.01, 0, 0, 0, 0, 0]])
    path = Path.to(goal, np.array([1.0, 2.0]), np.array([3.0, 2.5]))
    np.testing.assert_allclose(path.goal, goal, atol=ROUNDING)
    for time, place in ((0.0, 0 * goal), (3.5, goal)):
        for value, wanted in zip(path.at(time), (place, 0 * goal, 0 * goal), strict=True):
            np.testing.assert_allclose(value, wanted, atol=ROUNDING)
    h = 1e-5
    before, here, after = (path.at(2.2 + k * h) for k in (-1, 0, 1))
    np.testing.assert_allclose(here[1], (after[0] - before[0]) / (2 * h), atol=1e-8)
    np.testing.assert_allclose(here[2], (after[1] - before[1]) / (2 * h), atol=1e-8)
    # From rest to rest the fastest is in the middle, at 15/8 of the mean speed.
    np.testing.assert_allclose(path.at(2.0)[1][0], 15 / 16 * goal[0], atol=1e-9)


def test_a_path_begins_anew_where_the_object_is():
    goal, start, velocity = (np.random.default_rng(k).normal(size=(2, 6)) for k in range(3))
    old = Path.to(goal, np.zeros(2), np.ones(2))
    new = Path.to(old.goal, np.full(2, 0.5), np.ones(2), start, velocity)
    path = old.replaced(np.array([True, False]), new)
    place, speed, _ = path.at(0.5)
    np.testing.assert_allclose(place, [start[0], old.at(0.5)[0][1]], atol=1e-9)
    np.testing.assert_allclose(speed, [velocity[0], old.at(0.5)[1][1]], atol=1e-9)
    np.testing.assert_allclose(path.at(1.0)[0], goal, atol=1e-9)


def test_rotation_vectors():
    vectors = np.concatenate([np.zeros((1, 3)), np.random.default_rng(0).normal(size=(20, 3))])
    np.testing.assert_allclose(_rotation_vectors(_rotations(vectors)), vectors, atol=1e-9)


def test_the_state_is_that_of_mujoco(sim, on_the_way):
    state, _ = on_the_way
    assert np.all(state.reach) and np.abs(state.distances).max() < 2e-3
    rigid = np.einsum("nwa,nw->na", state.grasp_map, state.twist).reshape(3, 4, 3)
    moving = np.einsum("nav,nv->na", state.jacobian, state.joint_velocity).reshape(3, 4, 3)
    np.testing.assert_allclose(state.sliding, (moving - rigid)[..., :2], atol=ROUNDING)
    np.testing.assert_allclose(state.inertia, np.diag(np.r_[[0.1] * 3, [0.4 * 0.1 * 0.025**2] * 3]), rtol=1e-9)


def test_computed_torque_gives_the_wrench_that_is_asked_for(on_the_way):
    state, goal = on_the_way
    rng = np.random.default_rng(2)
    root = rng.normal(size=(12, 12))
    Q = np.tile(root @ root.T + np.eye(12), (3, 1, 1))
    for controller in (ComputedTorque(), ComputedTorque(compliance=Q)):
        torques, forces = controller(state, goal)
        np.testing.assert_allclose(np.einsum("nwa,na->nw", state.grasp_map, forces), goal.wrench, rtol=1e-4, atol=1e-5)
        pushed = torques - np.einsum("nav,na->nv", state.jacobian, forces)
        np.testing.assert_allclose(pushed, goal.joint_torque, atol=ROUNDING)


def test_the_answer_is_the_blocking_force(plan, on_the_way):
    state, goal = on_the_way
    _, forces = ComputedTorque()(state, goal)
    missing = goal.wrench - np.einsum("nwa,na->nw", state.grasp_map, goal.tightening)
    G = np.asarray(state.grasp_map)
    truth = np.einsum("naw,nw->na", np.linalg.pinv(G), missing)
    np.testing.assert_allclose(forces - goal.tightening, truth, atol=1e-5)


@pytest.mark.thorough
def test_optimisation_is_the_computed_torque_where_only_motion_counts(on_the_way):
    state, goal = on_the_way
    # What is left of the other goals is of the order of 1 / w.
    heavy = ForceOptimization(weight=jnp.full(3, 1e3), friction=jnp.full(3, 50.0), posture=0.0)
    torques, forces = heavy(state, goal)
    expected, wanted = ComputedTorque()(state, goal)
    np.testing.assert_allclose(forces, wanted, atol=5e-3)
    np.testing.assert_allclose(torques, expected, atol=5e-4)


def test_optimisation_keeps_to_cones_and_torques(on_the_way):
    state, goal = on_the_way
    goal = goal._replace(wrench=goal.wrench.at[:, 0].add(20.0), limit=jnp.full(12, 0.2))
    torques, forces = ForceOptimization(weight=jnp.ones(3), friction=jnp.full(3, 0.8))(state, goal)
    forces = np.asarray(forces).reshape(3, 4, 3)
    tangential = np.linalg.norm(forces[..., :2], axis=-1)
    assert np.all(tangential <= -0.8 * forces[..., 2] + 1e-7)
    assert np.all(tangential.max(-1) > 0.8 * EIGHT_EDGES * -forces[..., 2].max(-1))
    assert np.all(np.abs(torques) <= 0.2 + 1e-7) and np.isclose(np.abs(torques).max(), 0.2, atol=1e-6)


def test_without_contact_nothing_is_asked_of_the_fingers(sim, on_the_way):
    state, goal = on_the_way
    none = state._replace(grasp_map=jnp.zeros_like(state.grasp_map), reach=jnp.zeros_like(state.reach))
    goal = goal._replace(tightening=jnp.zeros_like(goal.tightening))
    _, forces = ComputedTorque(compliance=jnp.tile(jnp.eye(12), (3, 1, 1)))(none, goal)
    np.testing.assert_array_equal(forces, 0)


@pytest.fixture(scope="module")
def tight(sim, plan):
    return pushed(sim, plan, plan[1], ComputedTorque())


@pytest.fixture(scope="module")
def loose(sim, plan):
    return pushed(sim, plan, BASELINE, ComputedTorque())


def test_tightening_forces_hold_what_the_baseline_loses(tight, loose):
    assert not tight.lost.any() and loose.lost.all()
    away, angle = tight.error
    assert away[-1].max() < 5e-4 and np.degrees(angle[-1].max()) < 0.5
    assert tight.longest_loss().max() < 5e-3 and tight.worst_slip().max() < 5e-4
    assert 1e-3 < tight.peak.min() and loose.longest_loss().max() > 0.04


def test_forces_are_those_that_were_asked_for(tight, plan):
    at_rest = tight.time < BEGIN
    np.testing.assert_allclose(tight.normal_force[at_rest][-1], -tight.commanded[at_rest][-1][..., 2], rtol=1e-3)
    np.testing.assert_allclose(tight.normal_force[-1], -plan[1][None, :, 2].repeat(2, 0), rtol=0.01)
    while_pushed = np.searchsorted(tight.time, BEGIN + 0.09)
    used = tight.tangential_force[while_pushed] / (0.8 * tight.normal_force[while_pushed])
    assert 0.8 < used.max() < 1


def test_optimisation_based_control_holds(sim, plan):
    controller = ForceOptimization(weight=jnp.full(2, 0.1), friction=jnp.full(2, 0.8))
    held = pushed(sim, plan, plan[1], controller)
    assert not held.lost.any() and held.longest_loss().max() < 0.02


def test_section_v_a_as_printed(sim, plan):
    """Optimisation, f_0 of (22) at 0.75 lambda, pushes of 0.75 lambda: all are held; 0.5 N a finger loses some."""
    margin, _, grasp = plan
    printed = np.asarray(jg.least_effort(grasp.contacts, jg.DisturbanceSet.forces(1.0), [0.75 * margin]).forces[0])
    forces = np.repeat([printed, BASELINE], 6, 0)
    directions = np.stack([sign * axis for axis in np.eye(6)[:3] for sign in (1, -1)])
    push = Push(wrench=np.tile(0.75 * margin * directions, (2, 1)), begin=BEGIN)
    controller = ForceOptimization(weight=jnp.full(12, 0.1), friction=jnp.full(12, 0.8))
    run = sim.run(np.tile(sim.around, (12, 1)), forces, controller, push, SECONDS)
    tightened, baseline = run.lanes(slice(0, 6)), run.lanes(slice(6, 12))
    assert not tightened.lost.any() and tightened.longest_loss().max() < 2e-3
    assert tightened.peak.max() < 0.008 and tightened.error[0][-1].max() < 5e-4
    assert baseline.lost.any() and baseline.longest_loss().max() > 0.1


def test_section_v_b_as_printed_in_short(plan):
    """Everything as in V-A under gravity: the optimisation bears the weight and the push, the computed torque drops."""
    margin, _, grasp = plan
    heavy = Simulator.from_spec(torque_hand("sphere"))
    printed = np.asarray(jg.least_effort(grasp.contacts, jg.DisturbanceSet.forces(1.0), [0.75 * margin]).forces)
    push = Push(wrench=0.75 * margin * PUSHES * [[1], [0]], begin=0.15)
    path = Path.to(np.tile([0.0, -0.005, 0, 0, 0, 0], (2, 1)), np.full(2, 0.05), np.full(2, 0.35))
    start, forces = np.tile(heavy.around, (2, 1)), np.tile(printed, (2, 1, 1))
    optimised, computed = (
        heavy.run(start, forces, controller, push, 0.5, path=path)
        for controller in (ForceOptimization(weight=jnp.ones(2), friction=jnp.full(2, 0.8)), ComputedTorque())
    )
    assert not optimised.lost.any() and computed.lost.tolist() == [True, False]
    # The weight, which f_0 does not bear, leaves the ball a little below its place.
    assert optimised.peak[0] < 0.0025 and 5e-5 < optimised.error[0][-1].min() < optimised.error[0][-1].max() < 2e-4


def test_springs_hold_a_weak_push_and_give_way(sim, plan):
    jacobian = plan[2].actuation
    controller = JointSprings(torques=np.tile(jacobian.joint_torques(plan[1][None])[0], (2, 1)))
    held = pushed(sim, plan, plan[1], controller, share=0.3)
    assert not held.lost.any() and held.peak.max() > 5e-4


def test_an_object_is_carried_and_ends_where_it_should(sim, plan):
    goal = np.tile([0.0, -0.005, 0, 0, 0, 0], (2, 1))
    path = Path.to(goal, np.full(2, 0.02), np.full(2, 0.25))
    kept = pushed(sim, plan, plan[1], ComputedTorque(), share=0.5, path=path)
    anew = pushed(sim, plan, plan[1], ComputedTorque(), share=0.5, path=path, replan=(3e-4, 0.12))
    for run in (kept, anew):
        assert not run.lost.any()
    assert np.linalg.norm(kept.position[-1] - goal[:, :3], axis=-1).max() < 1e-4
    assert np.linalg.norm(anew.position[-1] - anew.wanted[-1][:, :3], axis=-1).max() < 5e-4
    assert np.abs(anew.wanted - kept.wanted).max() > 1e-4


def test_lanes_have_friction_of_their_own_and_leave_each_other_alone(sim, plan, tight):
    run = pushed(sim, plan, plan[1], ComputedTorque(), friction=np.array([0.8, 0.3]))
    np.testing.assert_array_equal(run.qpos[:, 0], tight.qpos[:, 0])
    assert run.lost.tolist() == [False, True]
    assert np.isfinite(run.position).all()


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"qpos": np.zeros((2, 18))}, r"qpos: got shape \(2, 18\), wanted \(2, 19\)"),
        ({"tightening": np.full((2, 4, 3), np.nan)}, r"tightening: lanes \[0, 1\] are not finite.*22"),
        ({"push": Push(wrench=np.zeros((3, 6)), begin=0.0)}, r"push: got shape \(3, 6\), wanted \(2, 6\)"),
        ({"path": Path.rest(1)}, r"path: got shape \(1, 6, 6\)"),
        ({"friction": np.array([0.5, -1.0])}, r"friction: lanes \[1\] are not positive"),
    ],
)
def test_what_does_not_fit_is_named(sim, plan, changes, words):
    given = {
        "qpos": np.tile(sim.around, (2, 1)),
        "tightening": np.tile(plan[1], (2, 1, 1)),
        "controller": ComputedTorque(),
        "push": Push(wrench=np.zeros((2, 6)), begin=0.0),
        "seconds": 0.01,
    }
    with pytest.raises(ValueError, match=words):
        sim.run(**(given | changes))


def test_figures_and_movie(tight, loose, sim, tmp_path):
    for figure in (figure_of_pushes({"a": tight, "b": loose}, "xz"), figure_of_motions({"a": tight}, "xz")):
        figure.savefig(tmp_path / "figure.png")
        assert (tmp_path / "figure.png").stat().st_size > 20_000
    if not has_context():
        pytest.skip("no OpenGL context can be had here")
    panels = [("a", tight, 0), ("b", loose.lanes(slice(1, 2)), 0)]
    write_movie(tmp_path / "movie.gif", sim.hand.model, panels, begin=0.05, end=0.1, slower=4)
    with Image.open(tmp_path / "movie.gif") as movie:
        assert movie.n_frames >= 3 and movie.size == (600, 300)
