"""What ends a margin adds up, the worst disturbance is the worst, and gains are what changes say."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxgrasp as jg
from jaxgrasp.candidates import sample_grasps
from jaxgrasp.cli import main
from jaxgrasp.ranking.tiles import columns_of, contacts_of

FORCES = jg.DisturbanceSet.forces(1.0)
BALL = jg.DisturbanceSet.ball(1.0, 0.02)
NORMALS = np.array([[1.0, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0]])


def cube(**changes) -> jg.Contacts:
    given = {"friction": 0.6, "max_force": 10.0}
    return jg.Contacts.from_normals(0.03 * NORMALS, NORMALS, **given | changes)


@pytest.fixture(scope="module")
def grasps():
    return contacts_of(columns_of(sample_grasps(24, seed=3)))


@pytest.mark.parametrize("disturbances", [FORCES, BALL], ids=["vertices", "ball"])
@pytest.mark.parametrize("torsional", [None, 0.01], ids=["hard", "soft"])
def test_shares_add_up_and_the_direction_is_the_worst(grasps, disturbances, torsional):
    soft = None if torsional is None else jnp.full_like(grasps.friction, torsional)
    contacts = replace(grasps, torsional_friction=soft)
    found = jg.explain(contacts, disturbances)
    positive = np.asarray(found.margin) > 1e-6
    assert positive.sum() > 10
    total = np.asarray(found.slip.sum(-1) + found.press.sum(-1))
    np.testing.assert_allclose(total[positive], 1, atol=1e-6)
    assert (np.asarray(found.slip) >= 0).all() and (np.asarray(found.press) >= 0).all()
    # A margin against that disturbance alone is never smaller; here it is finite, so the disturbance takes something.
    alone = jg.DisturbanceSet.vertices(jnp.where(positive[:, None], found.direction, 1.0)[:, None, :])
    against = np.asarray(jg.largest_disturbance(contacts, alone).margin)
    assert (against[positive] >= np.asarray(found.margin)[positive] - 1e-7).all()
    lost, pressed = jg.worst_case(contacts, disturbances)
    lost_alone, pressed_alone = jg.worst_case(contacts, alone)
    most = lambda x, y: np.concatenate([-np.asarray(x), np.asarray(y)[..., None]], -1).reshape(len(positive), -1)
    whole, own = most(lost, pressed), most(lost_alone, pressed_alone)
    # Some row loses to that one disturbance all that it loses to the worst of the set.
    attained = np.isclose(own[positive], whole[positive], rtol=1e-6, atol=1e-9) & (whole[positive] > 1e-6)
    assert attained.any(-1).all()


def test_gains_are_changes(grasps):
    found = jg.explain(grasps, FORCES)
    margin = lambda contacts: np.asarray(jg.largest_disturbance(contacts, FORCES).margin)
    step = 1e-6
    for name, gain in (("friction", found.friction_gain), ("max_force", found.force_gain)):
        value = getattr(grasps, name)
        more, less = (margin(replace(grasps, **{name: value * (1 + sign * step)})) for sign in (1, -1))
        wanted = (more - less) / (2 * step)
        np.testing.assert_allclose(np.sum(gain * value, -1), wanted, rtol=1e-4, atol=1e-5)
    along = np.einsum("...ci,...ci->...c", found.position_gain, grasps.frames[..., 2])
    np.testing.assert_allclose(along, 0, atol=1e-9)


def test_in_words():
    slips = jg.explain(cube(max_force=1e4), FORCES)
    presses = jg.explain(cube(friction=[0.6, 0.6, 5.0, 5.0]), FORCES)
    for found in (slips, presses):
        first, second, third = found.words()
        assert first.startswith(f"margin {float(found.margin):.3g}, which ends where contact ")
        assert second.startswith("worst disturbance: force (") and third.startswith("would help: a tenth more ")
    assert "presses with its largest force (" in presses.words()[0]


def test_what_has_no_margin():
    three = jax.tree.map(lambda *x: jnp.stack(x), cube(), cube(friction=0.0), cube(max_force=np.nan))
    found = jg.explain(three, FORCES, jnp.array([[0, 0, -1e3, 0, 0, 0], [0] * 6, [0] * 6]))
    assert found.words(0)[0].startswith("the required wrench cannot be borne")
    assert found.words(1) == ["margin 0: a grasp without friction"]
    assert found.words(2) == ["no margin to explain: INVALID_INPUT"]
    assert np.isnan(found.direction).all()
    with pytest.raises(IndexError, match="wanted 1 numbers"):
        found.words()


@pytest.mark.thorough
def test_actuators_that_end_a_margin():
    # A motor for every component of every force, and a joint that nothing drives.
    jacobian = jnp.concatenate([jnp.eye(12).reshape(4, 3, 12), jnp.zeros((4, 3, 1)).at[0, 0].set(1.0)], -1)
    drive = jnp.eye(13)[:, :12]
    weak, strong = (jg.Actuation.from_jacobian(jacobian, drive, -u * jnp.ones(12), u * jnp.ones(12)) for u in (1, 1e3))
    found = jg.explain(cube(), FORCES, actuation=weak)
    assert float(found.actuators) > 0.1 and "actuators reach their limits" in found.words()[0]
    found = jg.explain(cube(), FORCES, actuation=strong)
    # Limits beyond all that contacts ask for are taken to be just that much, so that a little of the bounds is theirs.
    assert float(found.actuators) < 0.02 and "actuators" not in found.words()[0]


def test_on_the_command_line(tmp_path, capsys):
    grasps = sample_grasps(20, seed=3)
    fields = {name: getattr(grasps, name) for name in ("positions", "outward_normals", "friction", "max_force")}
    np.savez(tmp_path / "a.npz", **fields)
    options = ["--output", "None", "--figure", "None", "--top", "0", "--explain", "20"]
    assert main(["rank", str(tmp_path / "a.npz"), *options]) == 0
    lines = [line for line in capsys.readouterr().out.splitlines() if line.startswith("a.npz:")]
    assert len(lines) == 20 and "which ends where contact" in lines[0] and "margin 0: a grasp with" in lines[-1]
    assert main(["rank", str(tmp_path / "a.npz"), "--run", str(tmp_path / "found"), "--explain", "1"]) == 2
    assert "--explain: got --run, too; wanted a ranking in one table" in capsys.readouterr().err
