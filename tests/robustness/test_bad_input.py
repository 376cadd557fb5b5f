"""Bad data is that grasp's own misfortune; bad shapes are the caller's, and are told apart while tracing."""

from __future__ import annotations

from dataclasses import replace
from functools import partial

import harness
import jax
import jax.numpy as jnp
import numpy as np
import problems
import pytest
from problems import sample

import jaxgrasp as jg

largest = partial(harness.largest, cone_edges=4)
least = partial(harness.least, cone_edges=4)

BAD = 3
"""The lane that is spoilt."""


@pytest.fixture(scope="module")
def batch() -> problems.Batch:
    return sample()


@pytest.fixture(scope="module")
def clean(batch):
    return harness.as_numpy(largest(*harness.data_of(batch)))


def spoil(batch: problems.Batch, **changes) -> problems.Batch:
    """A copy with one lane changed; each change is a pair of an index within the lane and a value."""
    spoilt = {}
    for name, (index, value) in changes.items():
        values = np.array(getattr(batch, name))
        values[(BAD, *index)] = value
        spoilt[name] = values
    return replace(batch, **spoilt)


MIRROR = np.diag([1.0, 1.0, -1.0])

BAD_DATA = {
    "NaN position": {"positions": ((0, 1), np.nan)},
    "infinite position": {"positions": ((0, 1), np.inf)},
    "NaN frame": {"frames": ((2, 0, 0), np.nan)},
    "zero frame": {"frames": ((2,), np.zeros((3, 3)))},
    "mirrored frame": {"frames": ((2,), MIRROR)},
    "stretched frame": {"frames": ((2,), 1.01 * np.eye(3))},
    "skew frame": {"frames": ((2,), np.eye(3) + 0.01 * np.eye(3)[[1, 2, 0]])},
    "negative friction": {"friction": ((1,), -0.1)},
    "NaN friction": {"friction": ((1,), np.nan)},
    "infinite friction": {"friction": ((1,), np.inf)},
    "zero max_force": {"max_force": ((1,), 0.0)},
    "negative max_force": {"max_force": ((1,), -5.0)},
    "infinite max_force": {"max_force": ((1,), np.inf)},
    "NaN max_force": {"max_force": ((1,), np.nan)},
    "NaN disturbance": {"vertices": ((0, 0), np.nan)},
    "infinite disturbance": {"vertices": ((0, 0), -np.inf)},
    "NaN load": {"required_wrench": ((4,), np.nan)},
    "infinite load": {"required_wrench": ((4,), np.inf)},
    "NaN cone margin": {"cone_margin": ((), np.nan)},
    "negative cone margin": {"cone_margin": ((), -0.1)},
}


def assert_alone(ours, clean) -> None:
    """The spoilt lane is marked, and every other lane is the same to the last bit."""
    assert ours.status[BAD] == jg.Status.INVALID_INPUT
    assert np.isnan(ours.margin[BAD]) and np.isnan(ours.forces[BAD]).all()
    others = np.arange(len(clean.status)) != BAD
    for name in ("margin", "upper_bound", "forces", "effort", "status", "iterations", "gap", "rank"):
        np.testing.assert_array_equal(getattr(ours, name)[others], getattr(clean, name)[others], err_msg=name)


@pytest.mark.parametrize("name", BAD_DATA)
def test_bad_data_marks_one_lane_alone(batch, clean, name):
    assert_alone(harness.as_numpy(largest(*harness.data_of(spoil(batch, **BAD_DATA[name])))), clean)


def test_a_grasp_without_contacts_holds_nothing(batch, clean):
    ours = harness.as_numpy(largest(*harness.data_of(spoil(batch, active=((), False)))))
    assert not batch.required_wrench[BAD].any()
    assert ours.status[BAD] == jg.Status.SOLVED and ours.margin[BAD] == 0 and ours.rank[BAD] == 0
    assert not ours.forces[BAD].any()
    others = np.arange(len(batch)) != BAD
    np.testing.assert_array_equal(ours.margin[others], clean.margin[others])


@pytest.mark.parametrize("normal", [np.zeros(3), np.array([np.nan, 0, 1]), np.array([0, np.inf, 0])])
def test_a_zero_normal_marks_one_lane_alone(batch, normal):
    normals = np.array(batch.frames[..., 2])
    _, disturbances, load, cone_margin = harness.data_of(batch)

    def solve(normals):
        contacts = jg.Contacts.from_normals(
            jnp.asarray(batch.positions),
            jnp.asarray(normals),
            friction=jnp.asarray(batch.friction),
            max_force=jnp.asarray(batch.max_force),
        )
        return harness.as_numpy(largest(contacts, disturbances, load, cone_margin))

    clean = solve(normals)
    assert not np.any(clean.status == jg.Status.INVALID_INPUT)
    np.testing.assert_allclose(solve(3.0 * normals).margin, clean.margin, rtol=1e-7, atol=1e-7)
    normals[BAD, 1] = normal
    assert_alone(solve(normals), clean)


@pytest.mark.parametrize("margin", [np.nan, -1e-3, np.inf])
def test_a_bad_margin_of_least_effort_marks_one_lane_alone(batch, clean, margin):
    wanted = 0.5 * np.where(clean.margin > 0, clean.margin, 0.0)
    data = harness.data_of(batch)
    good = harness.as_numpy(least(*data, jnp.asarray(wanted)))
    wanted[BAD] = margin
    ours = harness.as_numpy(least(*data, jnp.asarray(wanted)))
    assert_alone(ours, good)


def test_bad_data_of_sets_and_of_compliances(batch):
    contacts = harness.contacts_of(batch)
    one = np.where(np.arange(len(batch)) == BAD, np.nan, 1.0)
    nans = one[:, None] * np.ones(6)
    sets = [
        jg.DisturbanceSet.box(jnp.asarray(nans)),
        jg.DisturbanceSet.ellipsoid(jnp.asarray(nans[..., None] * np.eye(6))),
        jg.DisturbanceSet.ball(force=jnp.asarray(one), torque=0.0),
        jg.DisturbanceSet.box(jnp.asarray(np.where(np.isnan(nans), -1.0, nans))),
        jg.DisturbanceSet.ball(force=jnp.asarray(np.where(np.isnan(one), -1.0, one)), torque=0.0),
    ]
    for disturbances in sets:
        status = np.asarray(jg.largest_disturbance(contacts, disturbances, cone_edges=4).status)
        assert np.flatnonzero(status == jg.Status.INVALID_INPUT).tolist() == [BAD]
    for spoilt in (np.nan * np.eye(3), -np.eye(3), np.zeros((3, 3))):
        Q = np.tile(np.eye(3), (len(batch), 4, 1, 1))
        Q[BAD, 0] = spoilt
        ours = jg.largest_disturbance(contacts, jg.DisturbanceSet.forces(1.0), compliance=jnp.asarray(Q), cone_edges=4)
        assert np.flatnonzero(np.asarray(ours.status) == jg.Status.INVALID_INPUT).tolist() == [BAD]


def shaped(**shapes) -> jg.Contacts:
    given = {"positions": (2, 4, 3), "frames": (2, 4, 3, 3), "friction": (2, 4), "max_force": (2, 4)} | shapes
    arrays = {name: jnp.ones(shape) for name, shape in given.items()}
    return jg.Contacts.from_frames(
        arrays["positions"], arrays["frames"], friction=arrays["friction"], max_force=arrays["max_force"]
    )


@pytest.mark.parametrize(
    ("name", "got", "wanted"),
    [
        ("positions", (2, 4, 2), "n_c, 3"),
        ("positions", (3,), "n_c, 3"),
        ("frames", (2, 4, 3), "n_c, 3, 3"),
        ("frames", (2, 5, 3, 3), "n_c, 3, 3"),
        ("friction", (2, 5), "4"),
        ("max_force", (3,), "4"),
    ],
)
def test_contacts_of_the_wrong_shape(name, got, wanted):
    with pytest.raises(ValueError) as error:
        shaped(**{name: got})
    message = str(error.value)
    assert name in message and wanted in message
    assert ", ".join(map(str, got)) in message, "the message says what came"


def large(contacts, disturbances=None, **options):
    return jg.largest_disturbance(contacts, disturbances or jg.DisturbanceSet.forces(1.0), **options)


MISMATCHES = {
    "frames of another batch": (lambda c: shaped(frames=(7, 4, 3, 3)), "7"),
    "wrenches": (lambda c: jg.DisturbanceSet.vertices(jnp.ones((4, 5))), "5"),
    "half_extents": (lambda c: jg.DisturbanceSet.box(jnp.ones(5)), "5"),
    "shape_matrix": (lambda c: jg.DisturbanceSet.ellipsoid(jnp.ones((6, 5))), "6, 5"),
    "required_wrench": (lambda c: large(c, required_wrench=jnp.ones((2, 5))), "2, 5"),
    "required_wrench of another batch": (lambda c: large(c, required_wrench=jnp.ones((7, 6))), "7"),
    "disturbances": (lambda c: large(c, jg.DisturbanceSet.vertices(jnp.ones((7, 3, 6)))), "7"),
    "compliance": (lambda c: large(c, compliance=jnp.ones((2, 4, 2, 2))), "2, 4, 2, 2"),
    "cone_edges": (lambda c: large(c, cone_edges=2), "2"),
    "cone_margin": (lambda c: large(c, cone_margin=jnp.ones(7)), "7"),
    "margin": (lambda c: jg.least_effort(c, jg.DisturbanceSet.forces(1.0), jnp.ones(7)), "7"),
    "effort_weights": (
        lambda c: jg.least_effort(c, jg.DisturbanceSet.forces(1.0), 0.1, effort_weights=jnp.ones((2, 4, 3))),
        "2, 4, 3",
    ),
}


@pytest.mark.parametrize("name", MISMATCHES)
def test_mismatched_shapes_name_the_argument_and_what_came(name):
    provoke, got = MISMATCHES[name]
    with pytest.raises(ValueError) as error:
        provoke(shaped())
    message = str(error.value)
    assert name.split()[0] in message and got in message


def test_one_compliance_a_direction_needs_vertices():
    contacts = shaped()
    Q = jg.Compliance.per_direction(jnp.tile(jnp.eye(12), (2, 6, 1, 1)))
    with pytest.raises(ValueError, match="compliance"):
        jg.largest_disturbance(contacts, jg.DisturbanceSet.ball(), compliance=Q)


def test_wrong_dtypes():
    with pytest.raises(ValueError, match="active"):
        jg.Contacts.from_frames(jnp.ones((4, 3)), jnp.ones((4, 3, 3)), friction=0.5, max_force=1.0, active=jnp.ones(4))
    with pytest.raises(ValueError, match="positions"):
        shaped_complex = jnp.ones((4, 3), complex)
        jg.Contacts.from_frames(shaped_complex, jnp.ones((4, 3, 3)), friction=0.5, max_force=1.0)


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_no_vertex_that_is_nan_is_passed_over_in_large_batches(dtype):
    wrenches = np.ones((4096, 12, 6), dtype)
    wrenches[np.arange(4096), np.arange(4096) % 12, np.arange(4096) % 6] = np.nan
    extent = jax.jit(lambda w: jg.DisturbanceSet.vertices(w).terms[0].extent())(wrenches)
    assert (np.isnan(extent).sum(-1) == 1).all()
