"""Rank multi-fingered grasps by how strong a disturbance they withstand, in batch, with the forces that do it.

The package's names are those of `jaxgrasp.face`, which is imported when the first of them is used: JAX takes a second
to import, in which the command line could not answer Ctrl-C.
"""

from importlib import import_module
from importlib.util import find_spec
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from jaxgrasp.face import *  # noqa: F403
    from jaxgrasp.face import __all__ as __all__


def __getattr__(name: str) -> Any:
    if name.startswith("__") and name != "__all__":
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    if find_spec(f"{__name__}.{name}"):
        return import_module(f"{__name__}.{name}")
    from jaxgrasp import face

    value = getattr(face, name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    from jaxgrasp import face

    return sorted({*globals(), *face.__all__})
