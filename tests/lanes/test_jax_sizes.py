"""Direct calls on batches of many sizes: filled up to sizes that have programs, with the same answers."""

from __future__ import annotations

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax_sample import PUSHES, grasps

import jaxgrasp as jg
from jaxgrasp.robustness import auditing
from jaxgrasp.robustness.auditing.pyramids import Verdict
from jaxgrasp.robustness.interface import sizes
from jaxgrasp.robustness.interface.arguments import GraspData, Options
from jaxgrasp.robustness.tightening.margin import _LargestDisturbance


@pytest.fixture(autouse=True)
def no_size_of_its_own(monkeypatch):
    monkeypatch.setattr(sizes, "_OWN", 0)
    monkeypatch.setattr(sizes, "_known", {})


def known_size(contacts, disturbances=PUSHES, margin=None, **given):
    data = GraspData.from_arguments(contacts, disturbances, **given)
    return sizes.fill_to_known_size("a kernel", data, Options(margin=margin))


def test_answers_are_those_of_the_batch_itself():
    contacts, loads = grasps(13), np.random.default_rng(3).normal(size=(13, 6)) * 0.01
    contacts = replace(contacts, positions=contacts.positions.at[-1].set(jnp.nan))

    def solve(contacts):
        return jg.largest_disturbance(contacts, PUSHES, required_wrench=loads, cone_edges=4)

    for found, own in zip(jax.tree.leaves(solve(contacts)), jax.tree.leaves(jax.jit(solve)(contacts)), strict=True):
        assert not found.committed and found.weak_type == own.weak_type
        np.testing.assert_array_equal(found, own)
    assert solve(contacts).status[-1] == jg.Status.INVALID_INPUT


def test_which_batches_are_filled():
    contacts, loads = grasps(13), jnp.zeros((13, 6))
    fill = known_size(contacts, required_wrench=loads, margin=jnp.ones(()))
    assert fill.count == 13 and fill.data.contacts.batch_shape == (32,) and fill.options.margin.shape == ()
    np.testing.assert_array_equal(fill.data.contacts.positions[13:], jnp.stack([contacts.positions[12]] * 19))
    np.testing.assert_array_equal(fill.data.required_wrench.shape, (32, 6))
    # Sizes that have programs, other axes, and what is not a direct call.
    other_axes = jax.tree.map(lambda x: x[None], contacts)
    assert known_size(grasps(32)) is None and known_size(grasps(1)) is None and known_size(other_axes) is None
    assert known_size(contacts, required_wrench=loads[:1]) is None
    # What does not fit is told of with its own shape.
    assert known_size(replace(contacts, frames=contacts.frames[:12])) is None
    assert known_size(contacts, required_wrench=loads[:, :4]) is None
    assert known_size(contacts, jg.DisturbanceSet.ball(jnp.ones(13))) is None
    assert known_size(jax.device_put(contacts, jax.devices("cpu")[0])) is None
    assert jax.jit(lambda x: x if known_size(contacts) is None else -x)(1.0) == 1
    with jax.set_mesh(jax.make_mesh((1,), ("g",), devices=jax.devices("cpu")[:1])):
        assert known_size(grasps(13)) is None


def test_each_grasp_with_its_own_actuation():
    contacts = grasps(13)
    hand = jg.Actuation.from_jacobian(jnp.ones((13, 4, 3, 2)), np.eye(2), -np.ones((13, 2)), np.ones(2))
    fill = known_size(contacts, actuation=hand).data.actuation
    assert fill.jacobian.shape == (32, 4, 3, 2) and fill.lower.shape == (32, 2)
    assert fill.upper.shape == (2,) and fill.transmission.shape == (2, 2)
    short = replace(hand, jacobian=hand.jacobian[:, :3])
    assert known_size(contacts, actuation=short) is None


def test_the_first_large_size_has_its_own(monkeypatch):
    monkeypatch.setattr(sizes, "_OWN", 1)
    filled = [known_size(grasps(count)) for count in (13, 700, 21, 900, 700, 64, 3000)]
    assert [fill and fill.data.contacts.batch_shape for fill in filled] == [
        *((32,), None, (32,), (2048,), None, (128,), (4096,))
    ]


def test_copies_do_not_count_as_failed_answers(monkeypatch):
    told = []
    flags = np.arange(8) % 2 == 0
    verdicts = Verdict(failed=flags, margin=np.zeros(8), upper_bound=np.zeros(8))
    monkeypatch.setattr(auditing, "_JUDGES", dict.fromkeys(auditing._JUDGES, lambda *_: (verdicts, flags.sum())))
    monkeypatch.setattr(auditing, "_corrected", lambda kernel, out, verdicts: out)
    monkeypatch.setattr(auditing.setting, "report", lambda *counts: told.append(counts))
    data = GraspData.from_arguments(grasps(8), PUSHES)
    auditing.audited(_LargestDisturbance(8, False), np.zeros(8), data, Options(), count=5)
    assert told == [(3, 5)]


def test_contacts_from_numpy_are_those_of_a_program():
    normals = np.random.default_rng(1).normal(size=(3, 5, 4, 3)).astype(np.float32)
    normals[0, 0, 0] = 0

    def make(normals):
        return jg.Contacts.from_normals(0.1 * normals, normals, friction=0.5, max_force=np.ones(4))

    for found, own in zip(jax.tree.leaves(make(normals)), jax.tree.leaves(jax.jit(make)(normals)), strict=True):
        assert found.dtype == own.dtype and found.weak_type == own.weak_type
        np.testing.assert_allclose(found, own, rtol=1e-6, atol=1e-6)
    assert make(normals[:0]).positions.shape == (0, 5, 4, 3)
