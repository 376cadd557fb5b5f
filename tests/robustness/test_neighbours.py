"""A lane's answer is its own: whatever its neighbours are, and as if it were alone."""

from __future__ import annotations

import contextlib
from collections.abc import Callable
from dataclasses import replace

import jax
import jax.numpy as jnp
import kernel_programs
import numpy as np
import problems
import pytest

import jaxgrasp as jg
from jaxgrasp import kernels

Change = Callable[[problems.Batch], problems.Batch]

QUICK = [("plain", "float64", False), ("smooth", "float64", False), ("smooth", "float64", True)]
GROUPS = [g for g in kernel_programs.GROUPS if "derivative" not in g and g != "gradients"]
THOROUGH = [(group, dtype, xla) for group in GROUPS for dtype in ("float64", "float32") for xla in (False, True)]
THOROUGH = [pytest.param(*case, marks=pytest.mark.thorough) for case in THOROUGH if case not in QUICK]

SPOILT = np.arange(kernel_programs.LANES) % 8 == 3


def spoilt(batch: problems.Batch) -> problems.Batch:
    """One lane in eight: NaN, no normal, one point, a line, forces without bound, negative friction."""
    new = {name: getattr(batch, name).copy() for name in ("positions", "frames", "friction", "max_force")}
    for number, lane in enumerate(np.flatnonzero(SPOILT)):
        kind = number % 6
        if kind == 0:
            new["positions"][lane] = np.nan
        elif kind == 1:
            new["frames"][lane] = 0
        elif kind == 2:
            new["positions"][lane] = new["positions"][lane, :1]
        elif kind == 3:
            new["positions"][lane] *= [1, 0, 0]
        elif kind == 4:
            new["max_force"][lane] = np.inf
        else:
            new["friction"][lane] = -1
    return replace(batch, **new)


def answers(group: str, dtype: str, xla: bool, batches: list[Change], monkeypatch) -> list[dict[str, np.ndarray]]:
    """For every change of the batch; the programs are the same."""
    original, found = kernel_programs.batch, []
    jax.clear_caches()
    with kernels.without() if xla else contextlib.nullcontext():
        for change in batches:
            monkeypatch.setattr(kernel_programs, "batch", lambda *args, change=change: change(original(*args)))
            found.append(kernel_programs.answers(group, dtype))
    jax.clear_caches()
    return found


@pytest.mark.parametrize(("group", "dtype", "xla"), QUICK + THOROUGH)
def test_a_lane_is_as_beside_others_and_among_its_like(group, dtype, xla, monkeypatch):
    """Neighbours that are spoilt change nothing; nor does a whole batch of the same grasp, for what is its own data."""
    alike = [0, 3, 7, 11, 19, 27, 35, 43, 402] if group in ("plain", "smooth", "sets", "edges") else []
    changes = [lambda batch, k=lane: spoilt(batch)[np.full(len(batch), k)] for lane in alike]
    clean, beside, *alone = answers(group, dtype, xla, [lambda batch: batch, spoilt, *changes], monkeypatch)
    wrong = {name: kernel_programs.differing(x[~SPOILT], beside[name][~SPOILT]) for name, x in clean.items()}
    assert not {name: lanes for name, lanes in wrong.items() if len(lanes)}
    for lane, found in zip(alike, alone, strict=True):
        differs = [n for n, x in beside.items() if len(kernel_programs.differing(x[lane : lane + 1], found[n][:1]))]
        assert not differs, lane


@pytest.mark.parametrize("disturbances", [jg.DisturbanceSet.forces(1.0), jg.DisturbanceSet.ball(1.0)])
def test_smoothed_sets_of_grasps_without_full_rank(disturbances):
    """A jaw, four contacts on a line, and four in a plane: margins are those of the set but for the smoothing."""
    along, across = np.array([1.0, 0, 0]), np.array([0, 1.0, 0])
    normals = np.array(
        [[along, -along, along, -along], [along, -along, along, -along], [along, -along, across, -across]]
    )
    positions = 0.03 * normals * np.array([[1, 1, 1, 1], [1, 1, 0.5, 0.5], [1, 1, 1, 1]])[..., None]
    active = np.array([[1, 1, 0, 0], [1, 1, 1, 1], [1, 1, 1, 1]], bool)
    contacts = jg.Contacts.from_normals(positions, normals, friction=0.6, max_force=10.0, active=active)
    exact = jg.largest_disturbance(contacts, disturbances)
    assert (np.asarray(exact.rank) == [5, 5, 6]).all() and (np.asarray(exact.margin) > 1).all()
    smooth = jg.largest_disturbance(contacts, disturbances.smoothed(jnp.asarray([[1e-2], [1e-6], [1e-12]])))
    assert (np.asarray(smooth.status) == jg.Status.SOLVED).all()
    share = np.asarray(smooth.margin / exact.margin)
    assert (share <= 1 + 1e-7).all() and (share[0] > 0.95).all() and (share[1:] > 1 - 1e-5).all()
    assert (np.asarray(smooth.upper_bound) >= np.asarray(smooth.margin)).all()
