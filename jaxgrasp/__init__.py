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
    # Python itself looks for the face, and for names such as __path__.
    if name == "face" or (name.startswith("__") and name != "__all__"):
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    from jaxgrasp import face

    value = getattr(face, name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    from jaxgrasp import face

    return sorted({*globals(), *face.__all__})
