"""Hands by name: copies of mujoco_menagerie and robot_descriptions are found; nothing is run or fetched."""

from __future__ import annotations

import pytest
from test_scene_build import HAND

from jaxgrasp.hands import Scene
from jaxgrasp.hands.hand_names import hand_file

REPOSITORIES = """
REPOSITORIES: Dict[str, Repository] = {
    "menagerie": Repository(url="https://nowhere.invalid/m.git", commit="0", cache_path="mujoco_menagerie"),
    "other": Repository(url="https://nowhere.invalid/o.git", commit="0", cache_path="other_models"),
}
"""
MODULE = """
from os import getenv as _getenv
from os import path as _path
from ._cache import clone_to_cache as _clone_to_cache
raise RuntimeError("this was run")
REPOSITORY_PATH: str = _clone_to_cache("{repository}", commit=_getenv("ROBOT_DESCRIPTION_COMMIT", None))
PACKAGE_PATH: str = _path.join(REPOSITORY_PATH, "{folder}")
{paths}
"""


@pytest.fixture
def installed(tmp_path, monkeypatch):
    """A package like robot_descriptions and its cache; yields a function that makes an entry."""
    package, cache = tmp_path / "site" / "robot_descriptions", tmp_path / "cache"
    package.mkdir(parents=True)
    (package / "__init__.py").write_text("raise RuntimeError('this was run')")
    (package / "_repositories.py").write_text(REPOSITORIES)
    monkeypatch.syspath_prepend(package.parent)
    monkeypatch.setenv("ROBOT_DESCRIPTIONS_CACHE", str(cache))
    monkeypatch.delenv("MUJOCO_MENAGERIE", raising=False)

    def entry(name: str, files: dict[str, str], repository="other", folder="claw", written=True):
        paths = "\n".join(f'{field}: str = _path.join(PACKAGE_PATH, "{file}")' for field, file in files.items())
        module = MODULE.format(repository=repository, folder=folder, paths=paths)
        (package / f"{name}.py").write_text(module)
        root = cache / {"other": "other_models", "menagerie": "mujoco_menagerie"}[repository] / folder
        for file in files.values() if written else ():
            root.mkdir(parents=True, exist_ok=True)
            (root / file).write_text(HAND)
        return root

    return entry


def test_entries_that_are_there_are_found(installed):
    sides = {"MJCF_PATH": "left.xml", "MJCF_PATH_LEFT": "left.xml", "MJCF_PATH_RIGHT": "right.xml"}
    root = installed("claw_mj_description", sides)
    for name in ("claw", "claw_mj_description", "claw/left"):
        assert hand_file(name) == root / "left.xml"
    assert hand_file("claw_mj_description/right") == root / "right.xml"
    urdf = installed("hook_description", {"URDF_PATH": "hook.urdf"})
    assert hand_file("hook") == urdf / "hook.urdf"
    assert Scene.build(hand="claw", object="box", scale=0.05, mass=0.1).joint_names == ("a", "b")


def test_entries_that_are_not_there_say_how_to_get_them(installed):
    installed("claw_mj_description", {"MJCF_PATH": "claw.xml"}, written=False)
    with pytest.raises(ValueError, match="no copy yet .*claw.xml.; get it with the .* pull claw_mj_description$"):
        hand_file("claw")
    installed("hook_description", {"XACRO_PATH": "hook.xacro"})
    for name, message in (
        ("hook", "hook_description of robot_descriptions has no MJCF_PATH or URDF_PATH$"),
        ("claw/right", "has no MJCF_PATH_RIGHT or URDF_PATH_RIGHT"),
        ("_cache", "wanted an MJCF or URDF file, shadow_hand.* or the name of an entry of robot_descriptions$"),
        ("../claw", "wanted an MJCF or URDF file, shadow_hand"),
    ):
        with pytest.raises(ValueError, match=message) as caught:
            hand_file(name)
        assert "\n" not in str(caught.value)


def test_folders_of_a_menagerie(installed, tmp_path, monkeypatch):
    root = installed("claw_mj_description", {"MJCF_PATH": "left.xml"}, repository="menagerie")
    (root / "scene_left.xml").write_text(HAND)
    assert hand_file("claw") == hand_file("claw/left") == root / "left.xml"
    (root / "right.xml").write_text(HAND)
    with pytest.raises(ValueError, match="wanted one of claw/left, claw/right$"):
        hand_file("claw")
    mine = tmp_path / "mine"
    (mine / "claw").mkdir(parents=True)
    (mine / "claw" / "left.xml").write_text(HAND)
    monkeypatch.setenv("MUJOCO_MENAGERIE", str(mine))
    assert hand_file("claw") == hand_file("claw/left") == mine / "claw" / "left.xml"


def test_without_robot_descriptions_it_is_said(monkeypatch):
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    with pytest.raises(ValueError, match="not installed: pip install robot_descriptions"):
        hand_file("claw")
