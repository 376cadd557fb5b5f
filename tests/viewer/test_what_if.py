"""What stands behind the page of `jaxgrasp view`: the list, and grasps that are changed, against the library's own."""

import threading

import jax.numpy as jnp
import numpy as np
import pytest

import jaxgrasp as jg
from jaxgrasp.candidates import sample_grasps
from jaxgrasp.hands import HandObject, sample_configurations, scenes
from jaxgrasp.ranking import rank
from jaxgrasp.ranking.table import ranking_table
from jaxgrasp.viewer.bodies import bodies_along
from jaxgrasp.viewer.browser import Change, Viewed, answer, reasons
from jaxgrasp.viewer.browser.latest import Latest
from jaxgrasp.viewer.browser.what_if import load_size
from jaxgrasp.viewer.solids import held_by

# The same program of the same numbers, but for the order in which they were rounded.
SAME = 1e-9
# Of forces that (22) finds with a gap of 1e-9 or less, N.
BALANCE = 1e-6
FORCES = jg.DisturbanceSet.forces(1.0)
COUNT = 60


@pytest.fixture(scope="module")
def viewed() -> Viewed:
    ranking = rank(sample_grasps(COUNT, seed=4), FORCES, top=0)
    candidates = ranking.candidates.take(ranking.order)
    return Viewed(candidates=candidates, table=ranking_table(ranking), disturbances=FORCES, unit="N")


def contacts_of(viewed: Viewed, row: int, friction: float = 1.0, moved: np.ndarray | None = None) -> jg.Contacts:
    """The contacts of a grasp, made by hand."""
    candidates = viewed.candidates
    return jg.Contacts.from_normals(
        candidates.positions[row] + (0.0 if moved is None else moved),
        candidates.normals[row],
        friction=candidates.friction[row] * friction,
        max_force=candidates.max_force[row],
    )


@pytest.mark.parametrize("change", [Change(), Change(friction=0.7, share=0.4), Change(load=1.5)])
def test_the_margin_is_the_librarys(viewed, change):
    weight = jg.required_wrench(change.load or 0.0, gravity=jnp.array([0.0, 0.0, -1.0]))
    contacts = contacts_of(viewed, 2, change.friction)
    best = jg.largest_disturbance(contacts, FORCES, required_wrench=weight)
    hold = jg.least_effort(contacts, FORCES, change.share * best.margin, required_wrench=weight)
    found = answer(viewed, 2, change)
    assert found.margin == pytest.approx(float(best.margin), rel=SAME)
    np.testing.assert_allclose(found.forces, hold.forces_in_object_frame(contacts), atol=1e-6)


def test_contacts_move_along_their_tangents(viewed):
    shifts = np.zeros((4, 2))
    shifts[1] = 2e-3, -1e-3
    frames = np.asarray(contacts_of(viewed, 2).frames)
    moved = np.einsum("ct,cit->ci", shifts, frames[..., :2])
    found = answer(viewed, 2, Change(shifts=shifts))
    np.testing.assert_allclose(found.positions, viewed.candidates.positions[2] + moved)
    assert abs(moved[1] @ viewed.candidates.normals[2][1]) < 1e-15
    best = jg.largest_disturbance(contacts_of(viewed, 2, moved=moved), FORCES)
    assert found.margin == pytest.approx(float(best.margin), rel=SAME)
    assert abs(found.margin - answer(viewed, 2, Change()).margin) > 1e-3


def test_the_disturbance_played_is_balanced_inside_the_cones(viewed):
    """At the share of the margin the forces bear load and worst disturbance together, and one row is at its end."""
    change = Change(share=1.0)
    found, why = answer(viewed, 0, change), reasons(viewed, 0, change)
    assert why.words == tuple(jg.explain(contacts_of(viewed, 0), FORCES).words())
    disturbance = found.margin * why.direction
    forces = found.forces + found.margin * why.answers
    wrench = np.concatenate([forces.sum(0), np.cross(found.positions, forces).sum(0)])
    np.testing.assert_allclose(wrench + disturbance, found.load, atol=BALANCE)
    press = -np.einsum("ci,ci->c", forces, found.normals)
    across = np.linalg.norm(forces + press[:, None] * found.normals, axis=-1)
    assert (across <= found.friction * press + BALANCE).all()
    assert (press <= found.max_force + BALANCE).all()
    assert why.binding in range(4)


def test_a_grasp_without_a_margin_says_why(viewed):
    row = len(viewed) - 1
    found, why = answer(viewed, row, Change()), reasons(viewed, row, Change())
    assert found.margin == 0 and why.binding is None and np.isnan(why.answers).all()
    assert "without" in why.words[0]


def test_a_bad_grasp_harms_no_other(viewed):
    positions = viewed.candidates.positions.copy()
    positions[1, 0] = np.nan
    broken = Viewed(
        candidates=jg.candidates.Candidates(**{**vars(viewed.candidates), "positions": positions}),
        table=viewed.table,
        disturbances=FORCES,
        unit="N",
    )
    assert answer(broken, 1, Change()).status == jg.Status.INVALID_INPUT
    assert answer(broken, 2, Change()).margin == answer(viewed, 2, Change()).margin


def test_an_own_load_is_scaled(viewed):
    loaded = Viewed(candidates=viewed.candidates, table=viewed.table, disturbances=FORCES, unit="N", gravity=9.81)
    assert load_size(viewed, 0) == 0
    assert load_size(loaded, 0) == pytest.approx(9.81 * 0.25)
    same = answer(loaded, 2, Change(load=9.81 * 0.25))
    assert same.margin == pytest.approx(answer(loaded, 2, Change()).margin, rel=SAME)


def test_the_list_is_sorted_by_any_column(viewed):
    table = viewed.table | {"object_name": np.where(np.arange(COUNT) % 2, "a", "b")}
    table["margin"] = table["margin"].copy()
    table["margin"][3] = np.nan
    listed = Viewed(candidates=viewed.candidates, table=table, disturbances=FORCES, unit="N")
    assert listed.columns[0] == "margin" and "forces" not in listed.columns
    for falling in (True, False):
        order = listed.sorted_by("margin", falling)
        assert sorted(order.tolist()) == list(range(COUNT)) and order[-1] == 3
        values = table["margin"][order[:-1]]
        assert (np.diff(values) <= 0).all() if falling else (np.diff(values) >= 0).all()
    assert (table["object_name"][listed.sorted_by("object_name", False)][: COUNT // 2] == "a").all()


def test_the_last_request_counts():
    """Requests that come while one is worked on are answered by one more call, which sees the last of them."""
    begun, go, seen, value = threading.Event(), threading.Event(), [], [0]

    def work() -> None:
        seen.append(value[0])
        begun.set()
        go.wait(10)

    latest = Latest(work)
    first = threading.Thread(target=latest)
    first.start()
    assert begun.wait(10)
    for number in range(1, 6):
        value[0] = number
        latest()
    assert latest.overtaken()
    go.set()
    first.join(10)
    assert seen == [0, 5] and not latest.overtaken()


def test_an_error_leaves_it_ready():
    answers = iter([ValueError("once"), None])

    def work() -> None:
        error = next(answers)
        if error:
            raise error

    latest = Latest(work)
    with pytest.raises(ValueError, match="once"):
        latest()
    latest()


def test_bodies_stand_where_the_figures_have_them():
    hand = HandObject.from_mjcf(scenes.four_fingers(), "object")
    (qpos,) = sample_configurations(hand, 1, seed=3)
    bodies, held = bodies_along(hand, np.stack([qpos, hand.model.qpos0])), held_by(hand, qpos)
    for mine, others in ((bodies.of_object, held.object), (~bodies.of_object, held.hand)):
        found = np.concatenate([s for s, chosen in zip(bodies.surfaces, mine, strict=True) if chosen])
        expected = np.concatenate(others)
        # Geoms of a body are together, in whatever order.
        order = lambda x: x.reshape(-1, 9)[np.lexsort(np.round(x.reshape(-1, 9), 7).T)]
        np.testing.assert_allclose(order(found), order(expected), atol=1e-9)
    assert set(bodies.names) >= set(held.links[:1])
    # The second configuration is in the first one's frame.
    (number,) = np.flatnonzero(bodies.of_object)
    np.testing.assert_allclose(bodies.positions[0, number], 0.0, atol=1e-12)
    moved = hand.model.qpos0[-7:-4] - qpos[-7:-4]
    np.testing.assert_allclose(bodies.positions[1, number], bodies.turn @ moved, atol=1e-12)
