"""Model files that nobody vouches for: which files they may name, and a process of their own to be compiled in.

MuJoCo's compiler ends the process on some files, a model that attaches itself for example, and takes as much time and
memory as a count in a file says. No list of such files is ever complete, so that a file is compiled in a child process
with limits, which hands over the compiled model. What a file may make MuJoCo read is looked at before: a pipe has no
end, and would only run into the limit.
"""

import os
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any
from xml.parsers import expat

import mujoco

from jaxgrasp.storage import FileError, allowance, open_regular

_WANTED = "a model in MJCF or URDF"
# The compiler may have an eighth of the budget, beside what it takes itself, and three seconds for each GiB of it.
_SHARE, _OWN, _SECONDS = 8, 250 << 20, 3.0
# On the clock, for whatever keeps it waiting without computing.
_PATIENCE = 60.0
# Elements of XML take more than their text.
_XML_COST = 16
_FOLDERS = ("meshdir", "texturedir", "assetdir")


def compile_file(path: str | os.PathLike) -> mujoco.MjModel:
    """Compiles a model from a file.

    Args:
        path: MJCF or URDF.

    Raises:
        FileError: It, or a file that it names, cannot be used, or MuJoCo cannot compile it.
    """
    path = Path(path)
    check_files(path)
    with tempfile.TemporaryDirectory(prefix="jaxgrasp-") as folder:
        model = Path(folder, "model.mjb")
        limits = [str(allowance() // _SHARE + _OWN), str(max(1, round(_SECONDS * allowance() / 2**30)))]
        command = [sys.executable, "-P", str(Path(__file__).with_name("compiler.py")), str(path.absolute()), str(model)]
        try:
            child = subprocess.run(
                [*command, *limits],
                cwd=folder,
                timeout=_PATIENCE,
                stdin=subprocess.DEVNULL,
                stdout=subprocess.PIPE,
                stderr=subprocess.DEVNULL,
            )
        except subprocess.TimeoutExpired as error:
            raise FileError(path, None, f"a model that takes more than {_PATIENCE:g} s to compile", _WANTED) from error
        if child.returncode == 0:
            return mujoco.MjModel.from_binary_path(str(model))
    said = child.stdout.decode("utf-8", "replace").strip()
    if child.returncode != 1 or not said:
        said = f"a model on which MuJoCo's compiler ends (code {child.returncode}), or that takes too much"
        raise FileError(path, None, said, f"{_WANTED}, or more room (see --read-limit)")
    raise FileError(path, None, f"what MuJoCo cannot compile or run ({said})", _WANTED)


def check_files(path: str | os.PathLike) -> None:
    """Looks at a model file and at the files that it names, before MuJoCo reads any of them.

    All of them are to be regular files within the budget, included ones beside the model file or in a folder there.

    Args:
        path: MJCF or URDF.

    Raises:
        FileError: One of them cannot be used, the XML is not well-formed or has a document type, or a model is part of
            itself.
    """
    look = _Look(Path(path).parent)
    look.at(Path(path), ())
    for place in (folder / name for folder in look.folders for name in look.names):
        if os.path.lexists(place):
            with open_regular(place):
                pass


class _Look:
    """A look at a model file and at all models that it names."""

    def __init__(self, root: Path):
        self.folders: set[Path] = {root}
        """Where files may be looked for: what one model says of that may hold for another."""
        self.names: set[str] = set()
        """Of meshes, height fields, textures and the like."""
        self._root = root
        self._seen: set[str] = set()

    def at(self, path: Path, above: tuple[str, ...]) -> None:
        """Looks at a file of XML, which those above have named."""
        name = os.path.realpath(path)
        if name in above:
            raise FileError(path, None, "a model that is part of itself", "models that are not")
        if name in self._seen:
            return
        self._seen.add(name)
        elements = _elements(path)
        given = {attributes[key] for _, attributes in elements for key in _FOLDERS if key in attributes}
        self.folders |= {path.parent} | {folder / other for folder in (self._root, path.parent) for other in given}
        for tag, attributes in elements:
            named = [value for key, value in attributes.items() if key.startswith("file") or key == "url"]
            if tag not in ("include", "model"):
                self.names |= {value.removeprefix("file://") for value in named}
                continue
            for other in named:
                if tag == "include" and (os.path.isabs(other) or ".." in Path(other).parts):
                    raise FileError(path, "include", repr(other), "a file beside this one or in a folder there")
                for place in (folder / other for folder in tuple(self.folders)):
                    if os.path.lexists(place):
                        self.at(place, (*above, name))


def _elements(path: Path) -> list[tuple[str, dict[str, str]]]:
    """Tags and attributes of a file of XML; a folder or an entity is no part of a model."""
    with open_regular(path, _WANTED, cost=_XML_COST) as stream:
        content = stream.read()
    found: list[tuple[str, dict[str, str]]] = []

    def refuse(*_: Any) -> None:
        raise FileError(path, None, "a document type, in which entities are defined", "XML without any")

    parser = expat.ParserCreate()
    parser.StartDoctypeDeclHandler = refuse
    parser.StartElementHandler = lambda tag, attributes: found.append((tag, attributes))
    try:
        parser.Parse(content, True)
    except (expat.ExpatError, ValueError, LookupError) as error:
        if isinstance(error, FileError):
            raise
        raise FileError(path, None, f"XML that is not well-formed ({error})", _WANTED) from error
    return found
