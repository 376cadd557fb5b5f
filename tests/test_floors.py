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
    "arrays": 0,
    "direct": 0,
    "fence": 0,
    "storage": 0,
    "records": 0,
    "kernels": 1,
    "geometry": 2,
    "contact": 2,
    "disturbance": 2,
    "solvers": 2,
    "robustness": 3,
    "metrics": 4,
    "hands": 4,
    "candidates": 4,
    "files": 5,
    "simulation": 5,
    "synthesis": 6,
    "ranking": 6,
    "squeezing": 6,
    "evaluation": 7,
    "viewer": 8,
    "cli": 9,
}
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


@pytest.mark.parametrize("module", ["solvers", "robustness.auditing", "ranking"])
def test_a_module_can_be_the_first_that_is_imported(module):
    subprocess.run([sys.executable, "-c", f"import jaxgrasp.{module}"], check=True)
