"""Malicious and broken files of grasps, by the hundred: one line each; the command itself is tried under benchmarks."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pytest

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))

from benchmarks.assaults import grasp_cases  # noqa: E402
from benchmarks.assaults.grasp_samples import HAND, JOINTS  # noqa: E402
from benchmarks.assaults.hostile_pickles import CANARY  # noqa: E402
from jaxgrasp.files import read_grasps  # noqa: E402
from jaxgrasp.storage import FileError  # noqa: E402


@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize("kind", grasp_cases.KINDS)
def test_every_file_is_refused_in_one_line_and_nothing_in_it_runs(kind, tmp_path, monkeypatch):
    for package in ("h5py", "yaml"):
        pytest.importorskip(package)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(grasp_cases, "KINDS", {kind: grasp_cases.KINDS[kind]})
    Path("hand.xml").write_text(HAND)
    found = grasp_cases.cases(tmp_path / "inputs")
    for case in found:
        with pytest.raises(FileError) as caught:
            read_grasps(case.path, hand="hand.xml").for_hand(JOINTS)
        assert str(caught.value).isprintable(), case.name
        assert not Path(CANARY).exists(), case.name
    # The good ones among them are still read.
    np.savez("good.npz", grasp_qpos=np.zeros((2, 10)), joint_names=np.array(JOINTS))
    said: list[FileError] = []
    paths = [case.path for case in found if not case.path.is_dir()]
    assert len(read_grasps([*paths, "good.npz"], hand="hand.xml", skipped=said.append)) >= 2
    assert len(said) >= 10
