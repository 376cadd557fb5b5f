"""Trials on a cluster of Ray: as without one, also where a worker is lost. Ray is optional."""

import pickle
import subprocess
import sys
import types
from typing import Any

import numpy as np
import pytest
from ball_grasps import ball_grasps

from jaxgrasp.cluster import Cluster
from jaxgrasp.evaluation import evaluate, evaluation_table
from jaxgrasp.evaluation.on_ray import evaluate_on_ray
from jaxgrasp.files import write_grasps

WITH_RAY = """
import os, signal, sys
from jaxgrasp.cluster import joined
from jaxgrasp.evaluation import evaluate, evaluation_table
from jaxgrasp.evaluation.on_ray import evaluate_on_ray
from jaxgrasp.files import read_grasps
import numpy as np
one = read_grasps("ball.npz", hand="four_fingers")
grasps = one.take(np.arange(80) % len(one))
killed = []

def kill_one(done):
    if not killed:
        workers = [pid for pid in os.listdir("/proc") if pid.isdigit() and command_of(pid).startswith(b"ray::_tried")]
        for pid in workers[:1]:
            os.kill(int(pid), signal.SIGKILL)
            killed.append(pid)

def command_of(pid):
    try:
        return open(f"/proc/{pid}/cmdline", "rb").read()
    except OSError:
        return b""

given = {"hand": "four_fingers", "object": "sphere"}
with joined("local", 2) as cluster:
    found = evaluate_on_ray(cluster, grasps, **given, progress=kill_one)
assert killed
for name, column in evaluation_table(evaluate(grasps, **given)).items():
    np.testing.assert_array_equal(evaluation_table(found)[name], column, err_msg=name)
"""


class Here(types.SimpleNamespace):
    """What is used of Ray, in this process, with arguments and answers that go through pickles."""

    exceptions = types.SimpleNamespace(RayError=ConnectionResetError)

    def remote(self, function):
        self.tasks, self.cancelled = {}, []

        def start(*arguments):
            number = len(self.tasks)
            self.tasks[number] = pickle.dumps(function(*pickle.loads(pickle.dumps(arguments))))
            return number

        return types.SimpleNamespace(options=lambda **_: types.SimpleNamespace(remote=start))

    def wait(self, waiting):
        return waiting[-1:], waiting[:-1]

    def get(self, number):
        return pickle.loads(self.tasks[number])

    def cancel(self, number, force):
        self.cancelled.append(number)


@pytest.fixture
def cluster() -> Cluster:
    return Cluster(ray=Here(), workers=1, gpus=False)


GIVEN: dict[str, Any] = {"hand": "four_fingers", "object": "sphere"}


def test_the_same_table(cluster):
    grasps = ball_grasps(quality=np.arange(5.0)).take(np.array([3, 0, 1] * 20))
    done = []
    found = evaluate_on_ray(cluster, grasps, **GIVEN, progress=done.append)
    plain = evaluation_table(evaluate(grasps, **GIVEN))
    for name, column in evaluation_table(found).items():
        np.testing.assert_array_equal(column, plain[name], err_msg=name)
    assert done[-1] == 60 and len(done) > 1 and not found.interrupted


def test_an_interruption_keeps_what_is_done(cluster):
    grasps = ball_grasps().take(np.array([3] * 60))

    def stop(done):
        raise KeyboardInterrupt

    found = evaluate_on_ray(cluster, grasps, **GIVEN, progress=stop)
    assert found.interrupted and 0 < len(found) < 60 and cluster.ray.cancelled


def test_a_bad_object_is_named(cluster):
    grasps = ball_grasps().take(np.array([3]))
    with pytest.raises(ValueError, match="none.stl"):
        evaluate_on_ray(cluster, grasps, hand="four_fingers", object="none.stl")
    told = []
    found = evaluate_on_ray(cluster, grasps, hand="four_fingers", object="none.stl", skipped=told.append)
    assert found.outcome.tolist() == ["not usable"] and len(told) == 1 and "none.stl" in str(told[0])


def test_a_bad_hand_is_named_before_anything_begins(cluster):
    with pytest.raises(ValueError, match="nobodys_hand"):
        evaluate_on_ray(cluster, ball_grasps(), hand="nobodys_hand", object="sphere")


@pytest.mark.thorough
def test_a_lost_worker_costs_nothing(tmp_path):
    pytest.importorskip("ray")
    write_grasps(ball_grasps(), tmp_path / "ball.npz")
    subprocess.run([sys.executable, "-c", WITH_RAY], cwd=tmp_path, check=True, capture_output=True)
