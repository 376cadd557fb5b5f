"""Rankings on a cluster of Ray: as without one, also where a worker is lost. Ray is optional."""

import subprocess
import sys

import numpy as np
import pytest

from benchmarks.assaults import lost_worker
from jaxgrasp.candidates import sample_grasps
from jaxgrasp.cli import main

# In a process of its own: Ray's threads and warnings stay there.
DATASET = """
import jax, numpy as np, ray
jax.config.update("jax_enable_x64", True)
from jaxgrasp.candidates import sample_grasps
from jaxgrasp.candidates.arrow import table_of_candidates
from jaxgrasp.ranking import rank, rank_dataset
ray.init(num_cpus=2, include_dashboard=False)
grasps = sample_grasps(200)
found = rank_dataset(ray.data.from_arrow(table_of_candidates(grasps)), gravity=9.81, workers=1, batch=64).to_pandas()
ranking = rank(grasps, gravity=9.81, top=0)
np.testing.assert_allclose(np.sort(found["margin"]), np.sort(ranking.margin), rtol=1e-7, atol=1e-7)
assert set(found["status"]) <= {"SOLVED", "INFEASIBLE"} and "positions" in found
"""


@pytest.mark.thorough
def test_a_lost_worker_costs_nothing(tmp_path):
    pytest.importorskip("ray")
    found = lost_worker.lost(tmp_path, rows=40_000, workers=4, parts=40)
    assert found["workers"] >= 1 and found["parts there"] < 40


@pytest.mark.thorough
def test_a_dataset_of_ray():
    pytest.importorskip("ray")
    subprocess.run([sys.executable, "-c", DATASET], check=True, capture_output=True)


@pytest.mark.thorough
def test_what_is_wrong_with_a_file_is_one_line(tmp_path):
    pytest.importorskip("ray")
    grasps = sample_grasps(4_000)
    np.savez(tmp_path / "a.npz", **{name: getattr(grasps, name) for name in ("positions", "outward_normals")})
    content = (tmp_path / "a.npz").read_bytes()
    place = content.index(grasps.positions[3_000, 0].tobytes())
    (tmp_path / "a.npz").write_bytes(content[:place] + b"\0\0\0" + content[place + 3 :])
    options = ["--friction", "1", "--max-force", "1", "--run", "found", "--ray", "local", "--ray-workers", "1"]
    command = [sys.executable, "-m", "jaxgrasp.cli", "rank", "a.npz", *options]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True)
    lines = [line for line in done.stderr.splitlines() if line.startswith("jaxgrasp: ")]
    assert done.returncode == 2 and len(lines) == 1 and "Traceback" not in done.stderr
    assert "a.npz: positions: got damaged data" in lines[0] and "jaxgrasp rank --resume found goes on" in lines[0]


def test_without_ray_it_says_so(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr("importlib.util.find_spec", lambda _: None)
    assert main(["rank", "a.npz", "--run", str(tmp_path / "found"), "--ray", "local"]) == 2
    assert capsys.readouterr().err == "jaxgrasp: --ray: Ray is not installed; wanted pip install 'jaxgrasp[ray]'\n"
