"""Where the file of a hand is, by a path or a name: built in, in a copy of mujoco_menagerie, or of robot_descriptions.

The modules of `robot_descriptions` clone a repository when they are imported. So they are read and not run: each says
in a few assignments which repository it is of and where in it the file is. Nothing is downloaded.
"""

import ast
import importlib.util
import os
import re
from collections.abc import Mapping
from os import PathLike
from pathlib import Path

from jaxgrasp.hands.scenes import HAND_FILES

_NAME = re.compile(r"(\w+?)(?:/(left|right))?")
_ENDINGS = ("", "_mj_description", "_description")
_MENAGERIE = "MUJOCO_MENAGERIE"
_FIELDS = ("MJCF_PATH", "URDF_PATH")


def hand_file(hand: str | PathLike) -> Path:
    """The file of a hand.

    Args:
        hand: A path; the name of a built-in hand; FOLDER or FOLDER/FILE of a local copy of mujoco_menagerie, which is
            where the environment variable MUJOCO_MENAGERIE says or where `robot_descriptions` keeps it; or the name of
            an entry of `robot_descriptions` that it has cloned already, with or without `_mj_description` or
            `_description`, and with /left or /right where it has both hands.

    Raises:
        ValueError: There is no such file; what would get it is named.
    """
    name = str(hand)
    if name in HAND_FILES:
        return HAND_FILES[name]()
    path = Path(hand)
    if path.suffix:
        if not path.is_file():
            raise ValueError(f"hand: got {name!r}, and there is no such file; wanted an MJCF or URDF file")
        return path
    folders = [Path(f) for f in (os.environ.get(_MENAGERIE), _cache() / "mujoco_menagerie") if f]
    for folder in folders:
        if (found := folder / f"{name}.xml").is_file():
            return found
        if (folder / name).is_dir():
            return _only_model(folder, name)
    described = _described(name)
    if described is not None:
        return described
    where = "" if _package() else " (not installed: pip install robot_descriptions)"
    raise ValueError(
        f"hand: got {name!r}, wanted an MJCF or URDF file, {', '.join(HAND_FILES)}, FOLDER/FILE in a copy of "
        f"mujoco_menagerie ({' or '.join(map(str, folders))}), or the name of an entry of robot_descriptions{where}"
    )


def _only_model(folder: Path, name: str) -> Path:
    """The model in a folder of mujoco_menagerie that has one, beside scenes with it."""
    files = sorted(file for file in (folder / name).glob("*.xml") if not file.stem.startswith("scene"))
    if len(files) != 1:
        choices = ", ".join(f"{name}/{file.stem}" for file in files) or "a folder with a model"
        raise ValueError(f"hand: got {name!r}, a folder of {folder}; wanted one of {choices}")
    return files[0]


def _described(name: str) -> Path | None:
    """The file of an entry of `robot_descriptions`; None where there is no such entry.

    Raises:
        ValueError: It has no such file yet.
    """
    package, match = _package(), _NAME.fullmatch(name)
    if package is None or match is None:
        return None
    entry = next((e for e in (match[1] + end for end in _ENDINGS) if _is_description(package / f"{e}.py")), None)
    if entry is None:
        return None
    paths = _assigned(package / f"{entry}.py", _repositories(package))
    side = f"_{match[2].upper()}" if match[2] else ""
    found = next((paths[field + side] for field in _FIELDS if field + side in paths), None)
    if found is None:
        raise ValueError(
            f"hand: got {name!r}; {entry} of robot_descriptions has no {_FIELDS[0]}{side} or {_FIELDS[1]}{side}"
        )
    if not Path(found).is_file():
        raise ValueError(
            f"hand: got {name!r}, of which robot_descriptions has no copy yet ({found}); get it with the command "
            f"robot_descriptions pull {entry}"
        )
    return Path(found)


def _is_description(file: Path) -> bool:
    return file.stem.endswith("_description") and file.is_file()


def _cache() -> Path:
    """Where `robot_descriptions` keeps its copies."""
    return Path(
        os.environ.get("ROBOT_DESCRIPTIONS_CACHE") or Path.home() / ".cache" / "robot_descriptions"
    ).expanduser()


def _package() -> Path | None:
    """Where `robot_descriptions` is installed; it is not imported."""
    found = importlib.util.find_spec("robot_descriptions")
    folders = found.submodule_search_locations if found else None
    return Path(folders[0]) if folders else None


def _repositories(package: Path) -> dict[str, str]:
    """The folders in the cache, by the names of repositories."""
    file = package / "_repositories.py"
    calls = {
        key.value: {word.arg: word.value for word in value.keywords}
        for node in ast.walk(_parsed(file))
        if isinstance(node, ast.Dict)
        for key, value in zip(node.keys, node.values, strict=True)
        if isinstance(key, ast.Constant) and isinstance(key.value, str) and isinstance(value, ast.Call)
    }
    folders = {name: words.get("cache_path") for name, words in calls.items()}
    found = {
        name: str(_cache() / x.value)
        for name, x in folders.items()
        if isinstance(x, ast.Constant) and isinstance(x.value, str)
    }
    menagerie = os.environ.get(_MENAGERIE)
    return found | ({"mujoco_menagerie": menagerie} if menagerie else {})


def _assigned(file: Path, repositories: Mapping[str, str]) -> dict[str, str]:
    """The paths that a module assigns to names, as far as they are joined of names and strings."""
    values: dict[str, str] = {}
    for node in _parsed(file).body:
        match node:
            case ast.AnnAssign(target=ast.Name(id=name), value=given) | ast.Assign([ast.Name(id=name)], value=given):
                value = _value(given, values, repositories)
                if value is not None:
                    values[name] = value
    return values


def _value(node: ast.expr | None, values: Mapping[str, str], repositories: Mapping[str, str]) -> str | None:
    if isinstance(node, ast.Constant):
        return node.value if isinstance(node.value, str) else None
    if isinstance(node, ast.Name):
        return values.get(node.id)
    if not isinstance(node, ast.Call):
        return None
    found = [_value(argument, values, repositories) for argument in node.args]
    parts = [part for part in found if part is not None]
    if not parts or len(parts) < len(found):
        return None
    if isinstance(node.func, ast.Name) and node.func.id.endswith("clone_to_cache"):
        return repositories.get(parts[0])
    if isinstance(node.func, ast.Attribute) and node.func.attr == "join":
        return os.path.join(*parts)
    return None


def _parsed(file: Path) -> ast.Module:
    try:
        return ast.parse(file.read_text(encoding="utf-8"))
    except (OSError, SyntaxError, ValueError) as error:
        raise ValueError(f"hand: {file} of robot_descriptions cannot be read: {error}") from error
