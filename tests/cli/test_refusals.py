"""A command that is refused says so in exactly one line, and leaves nothing behind, also where it had more to tell."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
import pytest

from jaxgrasp.candidates import sample_grasps
from jaxgrasp.cli import main

# Every file of contacts is doubted, every scene says how contacts were made, and joints of no servo are told of.
PADS = "".join(
    f'<body name="f{k}" pos="{0.065 * x} {0.065 * y} 0"><joint name="j{k}" type="slide" axis="{-x} {-y} 0" '
    f'range="-.05 .05" damping="1"/><geom size="0.015" mass="0.05" condim="4"/></body>'
    for k, (x, y) in enumerate([(1, 0), (-1, 0), (0, 1), (0, -1)])
)
MOTORS = "".join(f'<motor name="m{k}" joint="j{k}" ctrlrange="-5 5"/>' for k in range(4))
HAND = f"""<mujoco><worldbody><body name="palm"><geom type="box" size=".05 .05 .005" pos="0 0 -.06"/>{PADS}</body>
</worldbody><actuator>{MOTORS}</actuator></mujoco>"""
OF_HAND = ["--hand", "hand.xml", "--object", "box", "--grasps", "hands.npz"]
TRIED = [*OF_HAND, "--servo-gain", "50"]
COMMANDS = {
    "rank": ["rank", "inward.npz", "--top", "0"],
    "rank --hand": ["rank", *OF_HAND, "--mass", "0.1", "--top", "0", "--picture", "None"],
    "synthesize": ["synthesize", "--starts", "8", "--steps", "2"],
    "compare": ["compare", "inward.npz", "--metric", "isotropy,smallest_singular_value"],
    "convert": ["convert", "hands.npz", "--to", "dexgraspbench", "--output", "new/folder"],
    "convert to a file": ["convert", "hands.npz", "--to", "isaac_grasp", "--output", "new.yaml"],
    "squeeze": ["squeeze", *TRIED, "--output", "new/folder"],
    "squeeze to files of others": ["squeeze", *TRIED, "--output", "new", "--format", "dexgraspbench"],
    "evaluate": ["evaluate", *TRIED],
}


@pytest.fixture
def folder(tmp_path, monkeypatch) -> Path:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "hand.xml").write_text(HAND)
    found = sample_grasps(32)
    np.savez("inward.npz", positions=found.positions, outward_normals=-found.normals, friction=0.6, max_force=10.0)
    base = np.tile([0.1, 0.2, 0.3, 1, 0, 0, 0], (4, 1))
    np.savez(
        "hands.npz",
        grasp_qpos=np.concatenate([base, np.full((4, 4), 0.0251)], -1),
        joint_names=["j0", "j1", "j2", "j3"],
        obj_pose=base,
        obj_scale=np.full(4, 0.05),
        quality=np.arange(4.0),
    )
    return tmp_path


def files(folder: Path) -> set[str]:
    return {os.fspath(path.relative_to(folder)) for path in folder.rglob("*")}


def fail(*_):
    raise OSError(28, "No space left on device")


@pytest.mark.parametrize("command", COMMANDS)
def test_all_disks_are_full(folder, monkeypatch, capsys, command):
    before = files(folder)
    with open("/dev/full", "w") as full, monkeypatch.context() as patch:
        patch.setattr("sys.stdout", full)
        patch.setattr("os.fsync", fail)
        assert main(COMMANDS[command]) == 2
    said = capsys.readouterr().err
    assert said.count("\n") == 1 and said.startswith("jaxgrasp: ") and "no space left on device" in said.lower()
    assert files(folder) == before


@pytest.mark.parametrize("command", COMMANDS)
def test_what_is_written_is_on_a_full_disk(folder, monkeypatch, capsys, command):
    before = files(folder)
    monkeypatch.setattr("os.fsync", fail)
    assert main(COMMANDS[command]) == 2
    said = capsys.readouterr().err
    assert said.count("\n") == 1 and said.lower().count("(no space left on device)") == 1
    assert files(folder) == before


@pytest.mark.parametrize("command", COMMANDS)
def test_a_command_that_works_tells_its_notices_in_the_end(folder, capsys, command):
    assert main(COMMANDS[command]) == 0
    printed, said = capsys.readouterr()
    lines = said.splitlines()
    assert len(set(lines)) == len(lines) and all(line.startswith("jaxgrasp: ") for line in lines)
    assert bool(lines) == (command != "synthesize") and "written: " in printed


@pytest.mark.parametrize("command", ["squeeze", "convert"])
def test_a_refused_command_makes_no_folder(folder, capsys, command):
    np.savez("hands.npz", grasp_qpos=np.zeros((2, 3)))
    before = files(folder)
    assert main(COMMANDS[command]) == 2
    assert capsys.readouterr().err.count("\n") == 1
    assert files(folder) == before
