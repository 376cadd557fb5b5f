"""The package is a house with floors: a room imports only from rooms below it, read from the imports themselves."""

import ast
import subprocess
import sys
from pathlib import Path

import pytest

PACKAGE = Path(__file__).resolve().parents[1] / "jaxgrasp"

FLOORS = {
    "process": -2,
    "compiling": -1,
    "cluster": -1,
    "arrays": 0,
    "linalg": 0,
    "storage": 0,
    "records": 0,
    "kernels": 1,
    "lanes": 2,
    "geometry": 3,
    "contact": 3,
    "disturbance": 3,
    "solvers": 3,
    "robustness": 4,
    "metrics": 5,
    "uncertainty": 5,
    "hands": 5,
    "candidates": 5,
    "files": 6,
    "explanation": 6,
    "simulation": 6,
    "synthesis": 7,
    "ranking": 7,
    "squeezing": 7,
    "evaluation": 8,
    "viewer": 9,
    "cli": 10,
}
# The most rooms that a folder may have, a folder inside it counting as one.
MOST_ROOMS = {"robustness": 8, "kernels": 7, "solvers": 6}
# Packages that only some rooms may import.
RESERVED = {
    "mujoco": {"hands", "simulation", "squeezing", "evaluation", "viewer"},
    "optax": {"synthesis"},
    "llvmlite": {"kernels"},
}

FILES = sorted(path for path in PACKAGE.rglob("*.py") if path not in (PACKAGE / "__init__.py", PACKAGE / "face.py"))


def room_of(module: str) -> str:
    return module.split(".")[1]


def module_of(path: Path) -> str:
    parts = path.relative_to(PACKAGE.parent).with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


def imports(source: str, package: str) -> set[str]:
    """Every module that the source imports, wherever in it, by its absolute name; `from a import b` counts as a.b."""
    found = set()
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            parents = package.split(".")[: len(package.split(".")) - node.level + 1] if node.level else []
            base = ".".join(parents + ([node.module] if node.module else []))
            found |= {f"{base}.{alias.name}" for alias in node.names}
    return found


def violations(room: str, imported: set[str]) -> list[str]:
    wrong = []
    for name in sorted(imported):
        top = name.split(".")[0]
        if top in RESERVED and room not in RESERVED[top]:
            wrong.append(f"{room} imports {top}")
        if top != "jaxgrasp":
            continue
        other = room_of(name) if "." in name else ""
        if other not in FLOORS:
            wrong.append(f"{room} imports the package's face ({name})")
        elif other != room and FLOORS[other] >= FLOORS[room]:
            wrong.append(f"{room} imports {name}, which is not below it")
    return wrong


@pytest.mark.parametrize("path", FILES, ids=module_of)
def test_imports_only_from_floors_below(path):
    module = module_of(path)
    package = module if path.name == "__init__.py" else module.rpartition(".")[0]
    assert room_of(module) in FLOORS
    assert violations(room_of(module), imports(path.read_text(), package)) == []


@pytest.mark.parametrize(
    ("room", "source"),
    [
        ("solvers", "from jaxgrasp.contact import Contacts"),
        ("contact", "import jaxgrasp.solvers.block.kkt"),
        ("contact", "from jaxgrasp import solvers"),
        ("contact", "def late():\n    from ..robustness import tightening"),
        ("ranking", "from jaxgrasp import rank"),
        ("ranking", "import jaxgrasp as jg"),
        ("robustness", "import mujoco.mjx"),
        ("hands", "import optax"),
    ],
)
def test_a_wrong_import_is_seen(room, source):
    assert len(violations(room, imports(source, f"jaxgrasp.{room}"))) == 1


@pytest.mark.parametrize(
    ("room", "source"),
    [
        ("robustness", "from jaxgrasp.contact import Contacts\nfrom jaxgrasp.solvers import interior_point"),
        (
            "solvers",
            "from jaxgrasp.solvers.status import Status\nfrom .status import Status\nfrom jaxgrasp import arrays",
        ),
        ("synthesis", "import optax, mujoco_menagerie"),
        ("hands", "from mujoco import mjx"),
    ],
)
def test_a_right_import_passes(room, source):
    assert violations(room, imports(source, f"jaxgrasp.{room}")) == []


def rooms_in(folder: Path) -> dict[str, list[Path]]:
    """The files of every room of a folder: of a module itself, of a folder all that is in it."""
    rooms: dict[str, list[Path]] = {}
    for path in sorted(folder.rglob("*.py")):
        name = path.relative_to(folder).parts[0].removesuffix(".py")
        if name not in ("__init__", "__main__"):
            rooms.setdefault(name, []).append(path)
    return rooms


def circle_in(arrows: dict[str, set[str]]) -> dict[str, set[str]]:
    """What is left of the arrows when rooms that import no other one are taken out again and again."""
    left = dict(arrows)
    while free := [name for name, to in left.items() if not to & left.keys()]:
        for name in free:
            del left[name]
    return {name: to & left.keys() for name, to in left.items()}


FOLDERS = sorted({path.parent for path in PACKAGE.rglob("*.py")} - {PACKAGE})


@pytest.mark.parametrize("folder", FOLDERS, ids=lambda folder: folder.relative_to(PACKAGE).as_posix())
def test_a_folder_has_floors_of_its_own(folder):
    rooms, base = rooms_in(folder), module_of(folder / "__init__.py")
    arrows: dict[str, set[str]] = {name: set() for name in rooms}
    for name, paths in rooms.items():
        for path in paths:
            package = module_of(path) if path.name == "__init__.py" else module_of(path).rpartition(".")[0]
            inside = [
                i.removeprefix(f"{base}.") for i in imports(path.read_text(), package) if i.startswith(f"{base}.")
            ]
            arrows[name] |= {i.split(".")[0] for i in inside} & rooms.keys() - {name}
    assert circle_in(arrows) == {}
    assert len(rooms) <= MOST_ROOMS.get(folder.name, len(rooms))


def test_a_circle_is_seen():
    assert circle_in({"a": {"b"}, "b": {"c"}, "c": set()}) == {}
    assert circle_in({"a": {"b"}, "b": {"a"}, "c": {"a"}, "d": set()}) == {"a": {"b"}, "b": {"a"}, "c": {"a"}}


@pytest.mark.parametrize("module", ["solvers", "robustness.auditing", "ranking"])
def test_a_module_can_be_the_first_that_is_imported(module):
    subprocess.run([sys.executable, "-c", f"import jaxgrasp.{module}"], check=True)
