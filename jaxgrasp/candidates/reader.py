"""Files of candidates: which fields there are, what shape each has, and what is wrong with one that cannot be used."""

import difflib
from collections.abc import Collection, Iterable, Sequence
from pathlib import Path
from typing import NoReturn

import numpy as np

from jaxgrasp.candidates.candidates import Candidates, concatenate
from jaxgrasp.storage import Archive, FileError, open_archive, printable

# A file of candidates, or of wrenches, cannot be used.
CandidateError = FileError
FIELDS = (
    *("positions", "outward_normals", "frames", "friction", "max_force", "mass", "center_of_mass", "active"),
    "torsional_friction",
)

# An unknown column this near to a known field that is absent is a misspelling: 'max_forces' is 0.95 from 'max_force',
# while 'mask' is 0.75 from 'mass'. A field that is required and missing is sought from further away ('normals').
_SURELY_MEANT = 0.8
_PERHAPS_MEANT = 0.55
# Programs are compiled for a number of contacts, and with hundreds of them that has no end.
_MOST_CONTACTS = 64


def read_candidates(
    paths: Sequence[Path | str],
    *,
    friction: float | None = None,
    max_force: float | None = None,
    with_mass: bool = False,
) -> Candidates:
    """Reads candidate grasps from one or more `.npz` files.

    Fields: positions (N, n_c, 3), about the centre of mass, and outward_normals (N, n_c, 3) or frames (N, n_c, 3, 3),
    columns t1, t2, n; optional friction, max_force and torsional_friction (m, of soft fingertips), each (), (N,) or
    (N, n_c), where (N,) is one per candidate;
    mass () or (N,); active (N, n_c) bool. Other columns with a leading axis of N travel along, with center_of_mass.
    Data that is not per candidate is passed over.

    Args:
        paths: The files; they may differ in n_c.
        friction: Coulomb's coefficient for files without any.
        max_force: Largest normal force for files without any, N.
        with_mass: Whether every file must have masses.

    Returns:
        The candidates of all files, in their order.

    Raises:
        CandidateError: A file cannot be used, or the files do not go together.
    """
    parts = [_read_file(Path(path), friction, max_force, with_mass) for path in paths]
    try:
        return concatenate(parts)
    except ValueError as error:
        raise CandidateError(
            ", ".join(str(path) for path in paths), None, str(error), "files that go together"
        ) from error


def _read_file(path: Path, friction: float | None, max_force: float | None, with_mass: bool) -> Candidates:
    with open_archive(path, "an .npz file of candidates (numpy.savez)") as archive:
        fields = fields_of(path, archive)
        arrays = archive.read(fields)
        there = tuple(archive.headers)
    return candidates_of_arrays(path, arrays, there=there, friction=friction, max_force=max_force, with_mass=with_mass)


def candidates_of_arrays(
    path: Path | str,
    arrays: dict[str, np.ndarray],
    *,
    there: Collection[str],
    friction: float | None,
    max_force: float | None,
    with_mass: bool,
) -> Candidates:
    """Makes candidates of a file's arrays, those with a leading axis of N in part or whole.

    Args:
        path: The file, for messages and as the source.
        arrays: Its arrays by name, of `fields_of`.
        there: The names of all fields of the file, for messages.
        friction: Coulomb's coefficient where the file has none.
        max_force: Largest normal force where the file has none, N.
        with_mass: Whether there must be masses.

    Returns:
        The candidates, numbered from 0.

    Raises:
        CandidateError: An array is missing or cannot be used.
    """
    positions = _numbers(path, "positions", arrays["positions"])
    count, contacts = positions.shape[:2]

    def optional(name: str, shapes: Sequence[tuple[int, ...]]) -> np.ndarray | None:
        if name not in arrays:
            return None
        value = _numbers(path, name, arrays[name])
        if value.shape not in shapes:
            raise CandidateError(path, name, f"shape {value.shape}", " or ".join(map(str, shapes)))
        return value

    def per_contact(name: str, given: float | None) -> np.ndarray:
        value = optional(name, ((), (count,), (count, contacts)))
        if value is None and given is None:
            refuse_missing(path, there, name, wanted_for(name))
        value = np.asarray(given if value is None else value, dtype=float)
        return np.broadcast_to(value[:, None] if value.ndim == 1 else value, (count, contacts))

    if "frames" in arrays and "outward_normals" in arrays:
        raise CandidateError(path, "frames", "outward_normals as well", "one of the two")
    frames = optional("frames", ((count, contacts, 3, 3),))
    normals = optional("outward_normals", ((count, contacts, 3),))
    if frames is None and normals is None:
        refuse_missing(path, there, "outward_normals", "outward_normals (N, n_c, 3) or frames (N, n_c, 3, 3)")
    mass = optional("mass", ((), (count,)))
    if mass is None and with_mass:
        refuse_missing(path, there, "mass", wanted_for("mass"))
    return Candidates(
        positions=positions,
        outward_normals=normals,
        frames=frames,
        friction=per_contact("friction", friction),
        max_force=per_contact("max_force", max_force),
        active=_active(path, arrays.get("active"), (count, contacts)),
        torsional_friction=per_contact("torsional_friction", None) if "torsional_friction" in arrays else None,
        mass=np.broadcast_to(np.nan if mass is None else mass, (count,)),
        columns=_travelling(path, arrays, count),
        sources=(printable(path),),
        source=np.zeros(count, dtype=np.int32),
        index=np.arange(count, dtype=np.int64),
    )


def fields_of(path: Path | str, archive: Archive) -> tuple[str, ...]:
    """The arrays of an archive that have something to say of each candidate.

    Raises:
        CandidateError: There are no positions, or not of that shape, or a name is misspelt.
    """
    headers = archive.headers
    refuse_misspelt(path, headers)
    if "positions" not in headers:
        refuse_missing(path, headers, "positions", "the column")
    shape = headers["positions"].shape
    if len(shape) != 3 or shape[2] != 3 or shape[1] == 0:
        raise CandidateError(path, "positions", f"shape {shape}", "(N, n_c, 3)")
    if shape[0] == 0:
        raise CandidateError(path, "positions", f"no candidates (shape {shape})", "at least one")
    check_contacts(path, shape[1])
    return tuple(name for name in headers if name in FIELDS or headers[name].shape[:1] == shape[:1])


def check_contacts(path: Path | str, contacts: int) -> None:
    """Refuses candidates with too many contacts.

    Raises:
        CandidateError: There are more than 64.
    """
    if contacts > _MOST_CONTACTS:
        raise CandidateError(path, "positions", f"{contacts:,} contacts", f"at most {_MOST_CONTACTS} a candidate")


def wanted_for(name: str) -> str:
    """The words for an error about a missing field."""
    if name == "mass":
        return "the column, because gravity needs it"
    option = "--" + name.replace("_", "-")
    return f"the column, or one value for all with {name}= ({option})"


def refuse_missing(path: Path | str, there: Collection[str], name: str, wanted: str) -> NoReturn:
    """Refuses a file without a field, and names what is similar in it.

    Raises:
        CandidateError: Always.
    """
    unknown = [other for other in there if other not in FIELDS]
    near = _nearest(name, unknown, _PERHAPS_MEANT)
    got = f"no such column (there is {f'a similar {near!r}' if near else ', '.join(there) or 'nothing'})"
    raise CandidateError(path, name, got, wanted)


def refuse_misspelt(path: Path | str, there: Collection[str]) -> None:
    """Refuses names that are nearly those of fields which are absent.

    Raises:
        CandidateError: There is one.
    """
    # Passed over in silence, 'max_forces' would mean a ranking by other forces than the file's.
    absent = [name for name in FIELDS if name not in there]
    if "frames" in there or "outward_normals" in there:
        absent = [name for name in absent if name not in ("frames", "outward_normals")]
    for name in there:
        near = None if name in FIELDS else _nearest(name, absent, _SURELY_MEANT)
        if near:
            raise CandidateError(path, name, "an unknown field", f"{near!r}, the nearest known one, or another name")


def _nearest(name: str, others: Iterable[str], cutoff: float) -> str | None:
    by_lower = {other.lower(): other for other in others}
    found = difflib.get_close_matches(name.lower(), by_lower, n=1, cutoff=cutoff)
    return by_lower[found[0]] if found else None


def _numbers(path: Path | str, name: str, value: np.ndarray) -> np.ndarray:
    if value.dtype.kind not in "iuf":
        raise CandidateError(path, name, f"dtype {value.dtype}", "real numbers")
    return value.astype(np.float64, copy=False)


def _active(path: Path | str, value: np.ndarray | None, shape: tuple[int, int]) -> np.ndarray:
    if value is None:
        return np.broadcast_to(True, shape)
    if value.dtype != np.bool_ or value.shape != shape:
        raise CandidateError(path, "active", f"dtype {value.dtype}, shape {value.shape}", f"bool {shape}")
    return value


def _travelling(path: Path | str, arrays: dict[str, np.ndarray], count: int) -> dict[str, np.ndarray]:
    columns = {}
    for name, value in arrays.items():
        known = name in FIELDS and name != "center_of_mass"
        if known or value.size == 0 or value.ndim == 0 or value.shape[0] != count:
            continue
        if value.dtype.kind == "S":
            value = np.char.decode(value, "utf-8", "replace")
        if value.dtype.kind not in "biufU":
            raise CandidateError(path, name, f"dtype {value.dtype}", "numbers, booleans or text")
        plain = (
            np.float64 if value.dtype.kind == "f" and value.itemsize not in (4, 8) else value.dtype.newbyteorder("=")
        )
        columns[name] = value.astype(plain, copy=False)
    if "center_of_mass" in arrays and columns.get("center_of_mass", np.empty(0)).shape != (count, 3):
        raise CandidateError(path, "center_of_mass", f"shape {arrays['center_of_mass'].shape}", f"({count}, 3)")
    return columns
