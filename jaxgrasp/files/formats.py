"""The formats by name, in the order in which a file's content is held against them."""

from collections.abc import Callable
from dataclasses import dataclass

from jaxgrasp.files import (
    bodex,
    dexgraspbench,
    dexgraspnet,
    dexgraspnet2,
    dexonomy,
    get_a_grip,
    graspit,
    graspqp,
    isaac_grasp,
    multigrippergrasp,
    own,
    parallel,
)
from jaxgrasp.files.content import Content
from jaxgrasp.files.given import Given
from jaxgrasp.files.grasp_set import GraspSet
from jaxgrasp.files.unsupported import NAMES, unsupported
from jaxgrasp.storage import FileError, printable


@dataclass(frozen=True)
class Format:
    """A format that is read."""

    recognises: Callable[[Content], bool]
    """Whether a file's content is of it."""
    read: Callable[[Content, Given], GraspSet]
    """Makes grasps of the content; raises FileError."""


_SINGLE = (dexonomy, dexgraspbench, bodex, dexgraspnet, dexgraspnet2, get_a_grip, graspqp, isaac_grasp)
_SINGLE += (multigrippergrasp, graspit, own)
FORMATS: dict[str, Format] = {
    **{module.NAME: Format(module.recognises, module.read) for module in _SINGLE},
    parallel.ACRONYM: Format(parallel.recognises_acronym, parallel.read_acronym),
    parallel.GRASPGEN: Format(parallel.recognises_graspgen, parallel.read_graspgen),
}
"""What is read, by name."""


def named(name: str) -> Format:
    """The format of a name, in which case and hyphens do not count.

    Raises:
        ValueError: There is none, or it is one of those that are not read.
    """
    plain = name.lower().replace("-", "_")
    if plain.replace("_", "") in NAMES:
        what = NAMES[plain.replace("_", "")]
        raise ValueError(f"format: got {what}, which is not read yet; wanted one of {', '.join(FORMATS)}")
    if plain not in FORMATS:
        raise ValueError(f"format: got {name!r}, wanted one of {', '.join(FORMATS)}")
    return FORMATS[plain]


def format_of(content: Content) -> Format:
    """The format of a file by what is in it.

    Raises:
        FileError: It is of none that is read.
    """
    for format in FORMATS.values():
        if format.recognises(content):
            return format
    known = unsupported(content)
    if known is not None:
        what = f"a file of {NAMES[known]}, which is not read yet"
        raise FileError(content.path, None, what, f"one of {', '.join(FORMATS)}")
    fields = ", ".join(printable(name)[:40] for name in list(content.table)[:12]) or "no named fields"
    raise FileError(content.path, None, f"a file of no format that is known ({fields})", f"one of {', '.join(FORMATS)}")
