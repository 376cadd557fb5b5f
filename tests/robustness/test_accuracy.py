"""The programs (21) and (22) on more than twenty thousand problems, against HiGHS and Clarabel."""

from __future__ import annotations

from functools import lru_cache

import harness
import jax.numpy as jnp
import numpy as np
import oracles
import problems
import pytest

import jaxgrasp as jg

MARGIN_TOLERANCE = 1e-7
"""Of max(|margin|, Lambda): ten times the gap at which the method stops."""

BOUND_TOLERANCE = 1e-9
"""Of max(|margin|, Lambda): a certified bound is exact up to rounding and to HiGHS' own tolerance of 1e-10."""

ROW_TOLERANCE = 1e-8
"""Of f_max: forces that a hand is told to apply satisfy every row."""

EFFORT_TOLERANCE = 1e-7
"""Of max(effort, 1e-3 f_max^2), with the mean of the contacts' largest forces where they differ."""

SAME_MARGIN = 2e-8
"""Of max(margin, Lambda): (16) is (21)."""

SHARE = 0.75
"""Of the largest margin, at which (22) is asked."""

SINGLE_TOLERANCE = 1e-5
"""Of max(|margin|, Lambda), some hundred units in the last place of float32; for `SINGLE_SHARE` of the lanes."""

SINGLE_SHARE = 0.999

SINGLE_WRONG = 1e-3
"""Of max(|margin|, Lambda): farther off than this no lane may be called solved."""

MEDIAN_ITERATIONS, TAIL_ITERATIONS = 7, 11
"""The median and the 99th percentile over all problems."""


QUICK = ("3 contacts", "4 contacts", "8 contacts, hexagonal", "20 contacts")
"""The groups that the quicker of the two test commands goes through."""


def quick_or_thorough(names) -> list:
    return [name if name in QUICK else pytest.param(name, marks=pytest.mark.thorough) for name in names]


@pytest.fixture(scope="module", params=quick_or_thorough(problems.GROUPS))
def name(request) -> str:
    return request.param


def unit_of(truth: dict) -> np.ndarray:
    """max(|margin|, Lambda) where there is a margin; where it is 0 by definition the answer is expected exactly."""
    return np.maximum(np.abs(truth["margin"]), np.where(truth["by_definition"], 0.0, truth["scale"]))


def answered(solution, truth: dict, tolerance: float) -> np.ndarray:
    """(lanes,) bool: the status is the right one; within the tolerance of zero both signs may be called."""
    solved, infeasible = solution.status == jg.Status.SOLVED, solution.status == jg.Status.INFEASIBLE
    relative = truth["margin"] / truth["scale"]
    right = np.where(truth["status"] == "SOLVED", solved, infeasible)
    return np.where(np.abs(relative) <= tolerance, solved | infeasible, right)


def without_margin(solution, truth: dict) -> np.ndarray:
    """(lanes,) bool: the margin is rightly NaN.

    So it is where there is none, and it may be where rows that no disturbance loads make the negative one hard to find.
    """
    proved = (solution.status == jg.Status.INFEASIBLE) & truth["one_sided"] & (truth["margin"] < 0)
    return np.isnan(solution.margin) & (np.isnan(truth["margin"]) | proved)


def test_there_are_enough_problems():
    groups = [problems.group(name) for name in problems.GROUPS]
    assert sum(len(g.batch) for g in groups) >= 20_000
    assert {g.batch.positions.shape[1] for g in groups} >= {3, 4, 5, 8, 12, 20}
    frictions = np.concatenate([g.batch.friction.ravel() for g in groups])
    assert frictions.min() < 0.025 and frictions.max() > 1.45


class TestLargestDisturbance:
    def test_every_lane_is_answered(self, name):
        group, ours, truth = problems.group(name), harness.margins(name), harness.highs(name)
        wrong = ~answered(ours, truth, MARGIN_TOLERANCE)
        columns = {"status": ours.status, "margin": ours.margin, "HiGHS": truth["margin"], "Lambda": truth["scale"]}
        assert not wrong.any(), harness.tell(group, wrong, **columns)

    def test_the_margin_is_that_of_highs(self, name):
        group, ours, truth = problems.group(name), harness.margins(name), harness.highs(name)
        error = np.abs(ours.margin - truth["margin"]) / np.maximum(unit_of(truth), np.finfo(float).tiny)
        wrong = ~(error <= MARGIN_TOLERANCE) & ~without_margin(ours, truth)
        columns = {"status": ours.status, "margin": ours.margin, "HiGHS": truth["margin"], "error": error}
        assert not wrong.any(), harness.tell(group, wrong, **columns)

    def test_the_bounds_hold(self, name):
        group, ours, truth = problems.group(name), harness.margins(name), harness.highs(name)
        slack = BOUND_TOLERANCE * unit_of(truth)
        wrong = (ours.margin > truth["margin"] + slack) | (ours.upper_bound < truth["margin"] - slack)
        columns = {"margin": ours.margin, "HiGHS": truth["margin"], "upper": ours.upper_bound}
        assert not wrong.any(), harness.tell(group, wrong, **columns, Lambda=truth["scale"])

    def test_the_forces_satisfy_every_row(self, name):
        group, ours = problems.group(name), harness.margins(name)
        violation = np.zeros(len(group.batch))
        for lane, grasp in enumerate(harness.grasps(name)):
            on = group.batch.active[lane]
            assert np.isnan(ours.margin[lane]) or not ours.forces[lane][~on].any()
            if np.isfinite(ours.margin[lane]):
                violation[lane] = oracles.row_violation(grasp, ours.forces[lane][on], ours.margin[lane])
        wrong = ~(violation <= ROW_TOLERANCE)
        assert not wrong.any(), harness.tell(group, wrong, violation=violation, status=ours.status, margin=ours.margin)

    @pytest.mark.thorough
    def test_iterations(self):
        iterations = np.concatenate([harness.margins(name).iterations for name in problems.GROUPS])
        status = np.concatenate([harness.margins(name).status for name in problems.GROUPS])
        assert not np.any(status == jg.Status.MAX_ITERATIONS)
        assert np.median(iterations) <= MEDIAN_ITERATIONS
        assert np.percentile(iterations, 99) <= TAIL_ITERATIONS

    @pytest.mark.thorough
    def test_single_precision(self):
        inside, lies = [], []
        for name in problems.GROUPS:
            ours, truth = harness.margins(name, "float32"), harness.highs(name)
            assert ours.margin.dtype == ours.forces.dtype == np.float32
            error = np.abs(ours.margin - truth["margin"]) / np.maximum(unit_of(truth), np.finfo(float).tiny)
            right = answered(ours, truth, SINGLE_TOLERANCE) & without_margin(ours, truth)
            inside.append((error <= SINGLE_TOLERANCE) | right)
            solved = ours.status == jg.Status.SOLVED
            lies.append(solved & ~(error <= SINGLE_WRONG))
            assert not lies[-1].any(), harness.tell(
                problems.group(name), lies[-1], margin=ours.margin, HiGHS=truth["margin"], error=error
            )
            marked = ~solved
            for value in (ours.margin, ours.upper_bound, ours.forces, ours.effort, ours.gap):
                finite = np.isfinite(value).reshape(len(marked), -1).all(axis=-1)
                assert np.all(finite | marked), harness.tell(
                    problems.group(name), ~(finite | marked), margin=ours.margin
                )
        assert np.mean(np.concatenate(inside)) >= SINGLE_SHARE


@lru_cache(maxsize=1)
def efforts(name: str):
    """Our answers to (22) for a group at a share of the largest margin, and these margins; 0 where there is none."""
    group, margins = problems.group(name), harness.margins(name)
    margin = np.where(margins.margin > 0, SHARE * margins.margin, 0.0)
    solution = harness.least(*harness.data_of(group.batch), jnp.asarray(margin), cone_edges=group.cone_edges)
    return harness.as_numpy(solution), margin


class TestLeastEffort:
    def test_the_effort_is_that_of_clarabel(self, name):
        group, grasps, (ours, margin) = problems.group(name), harness.grasps(name), efforts(name)
        # Without a margin there is no interior, and Clarabel too stops early: the next test is about those lanes.
        asked = margin > 1e-6 * np.array([oracles.program(grasp).scale for grasp in grasps])
        truth, error, violation = np.zeros((3, len(margin)))
        for lane in np.flatnonzero(asked):
            grasp, on = grasps[lane], group.batch.active[lane]
            truth[lane] = oracles.least_effort(grasp, margin[lane])
            unit = max(truth[lane], 1e-3 * np.mean(grasp.max_force) ** 2)
            error[lane] = abs(ours.effort[lane] - truth[lane]) / unit
            violation[lane] = oracles.row_violation(grasp, ours.forces[lane][on], margin[lane])
        solved = ours.status == jg.Status.SOLVED
        wrong = asked & ~(solved & (error <= EFFORT_TOLERANCE) & (violation <= ROW_TOLERANCE))
        columns = {"status": ours.status, "margin": margin, "effort": ours.effort, "Clarabel": truth}
        assert not wrong.any(), harness.tell(group, wrong, **columns, error=error, violation=violation)

    def test_without_a_load_and_a_margin_nothing_is_to_be_done(self, name):
        group, (ours, margin) = problems.group(name), efforts(name)
        idle = (margin == 0) & ~group.batch.required_wrench.any(axis=-1) & (group.batch.cone_margin == 0)
        solved = ours.status == jg.Status.SOLVED
        unit = 1e-3 * np.mean(group.batch.max_force, axis=-1, where=group.batch.active) ** 2
        wrong = idle & ~(solved & (np.abs(ours.effort) <= EFFORT_TOLERANCE * unit))
        assert not wrong.any(), harness.tell(group, wrong, status=ours.status, effort=ours.effort)

    def test_a_load_that_cannot_be_borne_is_infeasible(self, name):
        group, (ours, _) = problems.group(name), efforts(name)
        unbearable = harness.margins(name).upper_bound < 0
        wrong = unbearable & (ours.status != jg.Status.INFEASIBLE)
        assert not wrong.any(), harness.tell(group, wrong, status=ours.status, upper=harness.margins(name).upper_bound)


@pytest.mark.parametrize("name", quick_or_thorough(["3 contacts", "4 contacts", "5 contacts", "8 contacts"]))
def test_keeping_the_directions_apart_changes_nothing(name):
    group, reduced = problems.group(name), harness.margins(name)
    unloaded = ~group.batch.required_wrench.any(axis=-1) & (group.batch.cone_margin == 0)
    truth = harness.highs(name)
    held = np.flatnonzero(((truth["margin"] > 1e-9 * truth["scale"]) | unloaded) & ~truth["by_definition"])[::37]
    apart = oracles.largest_disturbances([group.batch.grasp(k, group.cone_edges) for k in held], every_direction=True)
    margins, scale = np.array([a.margin for a in apart]), np.array([a.scale for a in apart])
    assert np.all(np.abs(margins - reduced.margin[held]) <= SAME_MARGIN * np.maximum(scale, margins))
