"""The page on the paper: what it names exists, and its errata are true."""

from __future__ import annotations

import ast
import re
from importlib import import_module
from pathlib import Path

import jax.numpy as jnp
import numpy as np
import pytest
from scipy.optimize import linprog

import jaxgrasp as jg
from jaxgrasp.contact.friction import pyramid_facets

ROOT = Path(__file__).resolve().parents[2]
PAGE = ROOT / "docs" / "paper.md"
ROWS = [[cell.strip() for cell in line.split("|")[1:-1]] for line in PAGE.read_text().splitlines() if line[:2] == "| "]
TABLE = [row for row in ROWS if len(row) == 4 and row[0] != "paper"]
NAMED = sorted(set(re.findall(r"`([^`]+)`", PAGE.read_text())))
TESTS = [name for name in NAMED if name.startswith("test_")]
PUBLIC = [name for name in NAMED if name.startswith(("jg.", "jaxgrasp."))]
FILES = [name for name in NAMED if re.fullmatch(r"[\w/]+\.(py|md|png|gif)", name)]
LINKS = re.findall(r"\]\(([^)#]+)[^)]*\)", PAGE.read_text())

FRICTION, MAX_FORCE = 0.8, 2.0
SAME = 1e-6
"""Of the margins, two certified answers to one program."""


@pytest.fixture(scope="module")
def ring() -> jg.Contacts:
    """Four fingers at the equator of a ball, as in section V-A."""
    normals = jnp.array([[1.0, 0, 0], [0, 1, 0], [-1, 0, 0], [0, -1, 0]])
    return jg.Contacts.from_normals(0.025 * normals, normals, friction=FRICTION, max_force=MAX_FORCE)


UNIT = jg.DisturbanceSet.forces(1.0)


def test_every_number_has_a_row():
    told = {int(number) for row in TABLE for number in re.findall(r"\((\d+)\)", row[0])}
    assert told == set(range(1, 23))


def test_every_row_names_a_place_and_a_test():
    for row in TABLE:
        assert "`" in row[2] and ("`test_" in row[3] or "none" in row[3]), row


@pytest.mark.parametrize("name", TESTS)
def test_the_tests_exist(name):
    file, *inner = name.split("::")
    body = ast.parse(next((ROOT / "tests").rglob(f"{file}.py")).read_text()).body
    for part in inner:
        found = [node for node in body if getattr(node, "name", None) == part]
        assert found, name
        body = found[0].body


@pytest.mark.parametrize("name", PUBLIC)
def test_the_public_names_exist(name):
    parts = name.split("(")[0].replace("jg.", "jaxgrasp.", 1).split(".")
    value = import_module("jaxgrasp")
    for k, part in enumerate(parts[1:], 1):
        value = getattr(value, part) if hasattr(value, part) else import_module(".".join(parts[: k + 1]))


def test_the_files_exist():
    assert FILES and LINKS
    missing = [name for name in FILES if not (ROOT / name).is_file()]
    missing += [link for link in LINKS if not link.startswith("http") and not (PAGE.parent / link).exists()]
    assert not missing


def test_the_printed_sign_of_19_has_no_largest_disturbance(ring):
    S_1, S_2 = (np.asarray(S).reshape(-1) for S in jg.worst_case(ring, UNIT))
    G = np.asarray(jg.grasp_map(ring))
    C, E = np.kron(np.eye(4), pyramid_facets(8) * [1, 1, FRICTION]), np.kron(np.eye(4), [0.0, 0.0, 1.0])
    limits, equal = np.concatenate([np.zeros(len(C)), np.full(4, MAX_FORCE)]), np.hstack([G, np.zeros((6, 1))])
    bounds = [(None, None)] * 12 + [(0, None)]
    best = {}
    for sign in (-1, 1):
        rows = np.block([[C, sign * S_1[:, None]], [-E, S_2[:, None]]])
        best[sign] = linprog(-np.eye(13)[12], rows, limits, equal, np.zeros(6), bounds=bounds)
    np.testing.assert_allclose(best[-1].x[12], jg.largest_disturbance(ring, UNIT).margin, rtol=SAME)
    # Fingers may pull the more the stronger the disturbance is.
    assert best[1].status == 3, best[1].message


def test_nine_does_not_imply_six_with_the_norm_of_six(ring):
    forces = jg.DisturbanceSet.forces(4.8)
    held = [jg.specified_disturbances(ring, forces, equation) for equation in ("9", "6")]
    assert [int(answer.status) for answer in held] == [jg.Status.SOLVED, jg.Status.INFEASIBLE]
    as_nine = jg.specified_disturbances(ring, forces, "6", force_bound="normal")
    assert int(as_nine.status) == jg.Status.SOLVED


def test_what_a_bound_on_the_norm_changes(ring):
    free, fixed = (
        [float(jg.formulation_margin(ring, UNIT, name, force_bound=bound).margin) for bound in ("normal", "norm")]
        for name in ("12", "12_fixed")
    )
    # A push along a finger is answered by the opposite one without any friction.
    np.testing.assert_allclose(fixed[1], fixed[0], rtol=SAME)
    np.testing.assert_allclose(free[1] / free[0], 0.865, atol=5e-4)
    smaller = jg.Contacts.from_frames(
        ring.positions, ring.frames, friction=FRICTION, max_force=MAX_FORCE / np.sqrt(1 + FRICTION**2)
    )
    margins = [float(jg.largest_disturbance(contacts, UNIT).margin) for contacts in (smaller, ring)]
    np.testing.assert_allclose(margins[0] / margins[1], 1 / np.sqrt(1 + FRICTION**2), rtol=SAME)
