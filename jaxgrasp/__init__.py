"""Rank multi-fingered grasps by how strong a disturbance they withstand, in batch, with the forces that do it.

The package's names are those of `jaxgrasp.face`, which is imported when the first of them is used: JAX takes a second
to import, in which the command line could not answer Ctrl-C.
"""

# As in typing, whose import takes longer than all else until the command line can answer.
TYPE_CHECKING = False
if TYPE_CHECKING:
    from jaxgrasp.face import *  # noqa: F403
    from jaxgrasp.face import __all__ as __all__


def __getattr__(name: str) -> object:
    from importlib import import_module
    from importlib.util import find_spec

    if name.startswith("__") and name != "__all__":
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    if find_spec(f"{__name__}.{name}"):
        return import_module(f"{__name__}.{name}")
    face = import_module(f"{__name__}.face")
    try:
        value = getattr(face, name)
    except AttributeError:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}") from None
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    from jaxgrasp import face

    return sorted({*globals(), *face.__all__})
