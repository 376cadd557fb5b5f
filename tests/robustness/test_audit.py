"""The audit finds every answer that is wrong, and no other: faults are put into answers before it sees them."""

import warnings
from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxgrasp as jg
from jaxgrasp import kernels
from jaxgrasp.robustness import auditing, grasps
from jaxgrasp.robustness.auditing import setting

LANES, HURT = 80, 37
STATUS = jg.Status


@pytest.fixture(autouse=True)
def quiet(monkeypatch):
    """Neither a warning nor XLA for the tests that come later."""
    monkeypatch.setattr(setting, "report", lambda failed, lanes: None)


@pytest.fixture(scope="module")
def given():
    """Contacts, disturbances and a load that some of the grasps bear."""
    rng = np.random.default_rng(5)
    normals = rng.normal(size=(LANES, 4, 3))
    normals[:, 1] = -normals[:, 0] + 0.1 * normals[:, 1]
    normals /= np.linalg.norm(normals, axis=-1, keepdims=True)
    contacts = jg.Contacts.from_normals(0.05 * normals, normals, friction=0.7, max_force=8.0)
    return contacts, jg.DisturbanceSet.forces(1.0), jg.required_wrench(0.1)


def solved(given, program):
    contacts, disturbances, load = given
    if program == "(21)":
        return jg.largest_disturbance(contacts, disturbances, load)
    if program == "(22)":
        return jg.least_effort(contacts, disturbances, jnp.full(LANES, 0.3), load)
    if program == "(11)":
        return jg.least_total_effort(contacts, disturbances, 0.3, load)
    return jg.formulation_margin(contacts, disturbances, program, load)


def answers_of(out, program):
    return out[program][0] if isinstance(out, dict) else out[0]


def hurt(monkeypatch, program, change):
    """Have the solver's results come out with one lane changed."""
    run = grasps._run

    def changed(*args):
        out = run(*args)
        answer = change(answers_of(out, program), out)
        if isinstance(out, dict):
            return {program: (answer, out[program][1])}
        return (answer, *out[1:])

    monkeypatch.setattr(grasps, "_run", changed)


def moved(**steps):
    """A change of some fields of one lane."""
    return lambda s, _: replace(s, **{name: getattr(s, name).at[HURT].add(step) for name, step in steps.items()})


CHANGES = {
    "forces": lambda s, _: replace(s, forces=s.forces.at[HURT, 1, 2].add(-1e-3)),
    "no forces": lambda s, _: replace(s, forces=s.forces.at[HURT].set(0.0)),
    "margin too large": moved(margin=1e-4, upper_bound=1e-4),
    "margin too small": moved(margin=-1e-4),
    "upper bound too small": moved(upper_bound=-1e-4),
    "both too small": moved(margin=-1e-4, upper_bound=-1e-4),
}
OF_EFFORT = {
    "forces": CHANGES["forces"],
    "no forces": CHANGES["no forces"],
    "effort": lambda s, _: replace(s, effort=s.effort.at[HURT].multiply(1.01)),
}
CASES = [("(21)", name) for name in CHANGES]
CASES += [("(22)", name) for name in [*OF_EFFORT, "margin too large", "upper bound too small"]]
# Programs of the chain take long to compile.
SLOW = [(program, name) for program in ("13", "12_fixed") for name in CHANGES] + [("(11)", name) for name in OF_EFFORT]
CASES += [pytest.param(*case, marks=pytest.mark.thorough) for case in SLOW]


@pytest.mark.parametrize(("program", "fault"), CASES)
def test_strict_audit_finds_a_fault_in_one_lane_alone(monkeypatch, given, program, fault):
    change = (OF_EFFORT if program in ("(22)", "(11)") else CHANGES).get(fault) or CHANGES[fault]
    with auditing.audit("strict"):
        right = solved(given, program)
        assert right.status[HURT] == STATUS.SOLVED and not np.any(right.status == STATUS.NOT_VERIFIED)
        hurt(monkeypatch, program, change)
        found = solved(given, program)
    expected = np.asarray(right.status).copy()
    expected[HURT] = STATUS.NOT_VERIFIED
    np.testing.assert_array_equal(found.status, expected)
    assert np.isnan(found.forces[HURT]).all() and not np.isnan(found.forces[HURT + 1]).any()


SEEN_BY_DEFAULT = [("(21)", name) for name in CHANGES]
SEEN_BY_DEFAULT += [("(22)", name) for name in ("forces", "no forces", "margin too large", "upper bound too small")]


@pytest.mark.parametrize(("program", "fault"), SEEN_BY_DEFAULT)
def test_default_audit_finds_a_fault_in_any_lane(monkeypatch, given, program, fault):
    hurt(monkeypatch, program, CHANGES[fault])
    assert solved(given, program).status[HURT] == STATUS.NOT_VERIFIED


def test_multipliers_that_prove_nothing_are_found(monkeypatch, given):
    run = grasps._run

    def changed(*args):
        solution, evidence = run(*args)
        return solution, evidence._replace(cone_multipliers=evidence.cone_multipliers.at[HURT].multiply(1.01))

    monkeypatch.setattr(grasps, "_run", changed)
    assert solved(given, "(21)").status[HURT] == STATUS.NOT_VERIFIED


def test_claims_of_solved_or_infeasible_without_proof(monkeypatch, given):
    given = (*given[:2], jg.required_wrench(2.0))
    statuses = np.asarray(solved(given, "(21)").status)
    cannot, can = (int(np.flatnonzero(statuses == status)[0]) for status in (STATUS.INFEASIBLE, STATUS.SOLVED))

    def change(solution, _):
        status = solution.status.at[can].set(STATUS.INFEASIBLE).at[cannot].set(STATUS.SOLVED)
        return replace(solution, status=status)

    hurt(monkeypatch, "(21)", change)
    found = solved(given, "(21)").status
    assert found[can] == STATUS.NOT_VERIFIED and found[cannot] == STATUS.NOT_VERIFIED


def test_a_wrong_rank_or_wrong_worst_rows_are_found_when_they_are_computed_anew(monkeypatch, given):
    run = grasps._run

    def changed(*args):
        solution, evidence = run(*args)
        # Everything as if the disturbances were half as large.
        by = lambda x, factor: x.at[HURT].multiply(factor)  # noqa: E731
        rows = evidence.rows._replace(cone=by(evidence.rows.cone, 0.5), bound=by(evidence.rows.bound, 0.5))
        wrong = replace(solution, margin=by(solution.margin, 2.0), upper_bound=by(solution.upper_bound, 2.0))
        names = ("cone_multipliers", "bound_multipliers", "wrench_multipliers")
        return wrong, evidence._replace(rows=rows, **{name: by(getattr(evidence, name), 2.0) for name in names})

    monkeypatch.setattr(grasps, "_run", changed)
    found = [int(solved(given, "(21)").status[HURT]) for _ in range(setting.STRIDE)]
    # The rules that take the solver's S_1 and S_2 cannot see it; every sixteenth call has its own.
    assert found.count(STATUS.NOT_VERIFIED) == 1
    with auditing.audit("strict"):
        assert solved(given, "(21)").status[HURT] == STATUS.NOT_VERIFIED


def test_what_fails_keeps_what_is_confirmed_and_has_no_derivative(monkeypatch, given):
    contacts, disturbances, load = given
    right = solved(given, "(21)")
    hurt(monkeypatch, "(21)", CHANGES["margin too large"])
    found = solved(given, "(21)")
    np.testing.assert_allclose(found.margin[HURT], right.margin[HURT], rtol=1e-6)

    def total(scale):
        moved = replace(contacts, max_force=contacts.max_force * scale[:, None])
        return jnp.nansum(jg.largest_disturbance(moved, disturbances, load).margin)

    slopes = jax.jit(jax.grad(total))(jnp.ones(LANES))
    assert slopes[HURT] == 0 and slopes[HURT + 1] != 0


def test_the_first_wrong_answer_warns_and_ends_the_kernels(monkeypatch, given):
    monkeypatch.undo()
    monkeypatch.setattr(setting, "_warned", False)
    monkeypatch.setattr(kernels.primitive, "_trusted", True)
    hurt(monkeypatch, "(21)", CHANGES["no forces"])
    with pytest.warns(RuntimeWarning, match=f"1 of {LANES} answers failed the audit"):
        solved(given, "(21)")
    assert not kernels.usable()
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        solved(given, "(21)")


def test_without_an_audit_and_with_a_wrong_name(monkeypatch, given):
    hurt(monkeypatch, "(21)", CHANGES["no forces"])
    with auditing.audit("off"):
        assert solved(given, "(21)").status[HURT] == STATUS.SOLVED
    with (
        pytest.raises(ValueError, match="form: got 'thorough', wanted sampled, strict or off"),
        auditing.audit("thorough"),
    ):
        pass
