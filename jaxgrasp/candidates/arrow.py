"""Candidates as Arrow tables: a row each, with lists of contacts that may differ in length from row to row.

The fields are those of archives: positions, list of three numbers each; outward_normals likewise, or frames, three rows
of three numbers; friction, torsional_friction, max_force and active, one value or a list with one a contact; mass. What
is null is NaN, and so the affair of its candidate alone. Lists may be of fixed or variable size, or Arrow's fixed-shape
tensors.
"""

from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from jaxgrasp.candidates.candidates import Candidates
from jaxgrasp.candidates.reader import (
    FIELDS,
    CandidateError,
    candidates_of_arrays,
    check_contacts,
    refuse_missing,
    refuse_misspelt,
)
from jaxgrasp.storage import allowance

_OWN = tuple(name for name in FIELDS if name != "center_of_mass")
# What every contact has beside its own place, and what an absent one gets: no arithmetic on it can then yield a NaN.
_TAILS: dict[str, tuple[int, ...]] = {"positions": (3,), "outward_normals": (3,), "frames": (3, 3)}
_PADDING = {"positions": 0.0, "outward_normals": np.array([0.0, 0.0, 1.0]), "frames": np.eye(3)} | dict.fromkeys(
    ("active", "torsional_friction"), 0.0
)
# Lists of many lengths are filled up to a multiple of this, so that few programs serve them.
_STEP = 4


def candidates_of_table(
    table: pa.Table,
    name: Path | str,
    *,
    friction: float | None = None,
    max_force: float | None = None,
    with_mass: bool = False,
) -> tuple[Candidates, pa.Table]:
    """Takes candidates out of an Arrow table.

    Args:
        table: A row a candidate.
        name: What it is called, for messages and as the source.
        friction: Coulomb's coefficient where the table has none.
        max_force: Largest normal force where the table has none, N.
        with_mass: Whether there must be masses.

    Returns:
        The candidates, without columns, and a table of all other columns, which travel along.

    Raises:
        CandidateError: A column is missing or misspelt, or cannot be used.
    """
    names = table.column_names
    refuse_misspelt(name, names)
    twice = next((column for column in names if names.count(column) > 1), None)
    if twice:
        raise CandidateError(name, twice, "two columns of this name", "one")
    if "positions" not in names:
        refuse_missing(name, names, "positions", "the column")
    found = candidates_of_arrays(
        name, _arrays(table, name), there=names, friction=friction, max_force=max_force, with_mass=with_mass
    )
    return found, table.drop_columns([column for column in names if column in _OWN])


def table_of_candidates(candidates: Candidates) -> pa.Table:
    """The contacts and masses of candidates as an Arrow table, which `candidates_of_table` reads; no other columns.

    Args:
        candidates: Grasps by their contacts; lists are as long as the largest grasp.
    """
    columns = {"positions": candidates.positions, "friction": candidates.friction, "max_force": candidates.max_force}
    columns |= {"outward_normals": candidates.outward_normals, "frames": candidates.frames}
    columns |= {"active": candidates.active, "mass": candidates.mass}
    columns["torsional_friction"] = candidates.torsional_friction
    return pa.table({name: _lists(value) for name, value in columns.items() if value is not None})


def columns_of_table(table: pa.Table) -> dict[str, np.ndarray]:
    """Columns of an Arrow table that NumPy knows: numbers, truth values, text, and arrays of numbers of one size.

    Args:
        table: Any.

    Returns:
        Arrays with a leading axis of rows by name; what is null is NaN or empty.

    Raises:
        CandidateError: Text in it is too long for NumPy, which gives every row as much room as the longest one has.
    """
    found = {}
    for name, column in zip(table.column_names, table.columns, strict=True):
        array = _whole(column)
        if pa.types.is_dictionary(array.type):
            _check_text(array.dictionary, name, len(array))
            array = array.dictionary_decode()
        if pa.types.is_string(array.type) or pa.types.is_large_string(array.type):
            _check_text(array, name, len(array))
            found[name] = np.array(pc.fill_null(array, "").to_pylist(), dtype=str)
        elif _is_number(array.type):
            found[name] = array.to_numpy(zero_copy_only=False)
        elif pa.types.is_fixed_size_list(array.type) and not array.null_count:
            shape, kind = _shape(array.type)
            if _is_number(kind):
                for _ in shape:
                    array = array.flatten()
                found[name] = array.to_numpy(zero_copy_only=False).reshape(table.num_rows, *shape)
        if name in found and found[name].dtype == object:
            found[name] = np.array([np.nan if value is None else value for value in found[name]], dtype=float)
    return found


def _check_text(array: pa.Array, name: str, rows: int) -> None:
    if pa.types.is_string(array.type) or pa.types.is_large_string(array.type):
        longest = pc.call_function("max", [pc.call_function("utf8_length", [array])]).as_py() or 0
        if 4 * longest * rows > allowance():
            got = f"{rows:,} rows of text, of which one has {longest:,} characters"
            raise CandidateError("table", name, got, "shorter text (see --read-limit, or --run FOLDER)")


def _arrays(table: pa.Table, name: Path | str) -> dict[str, np.ndarray]:
    """The fields as arrays (N, n_c, ...), filled up where grasps have fewer contacts than others."""
    arrays: dict[str, np.ndarray] = {}
    positions = _whole(table.column("positions"))
    dense, lengths = _dense(positions, name, "positions", (3,))
    ragged = len(lengths) > 0 and lengths.min() < lengths.max()
    contacts = -(-dense.shape[1] // _STEP) * _STEP if ragged else dense.shape[1]
    check_contacts(name, contacts)
    present = np.arange(contacts) < lengths[:, None]
    for field in _OWN:
        if field not in table.column_names:
            continue
        array = _whole(table.column(field))
        if field == "mass" or (field not in _TAILS and not _is_list(array.type)):
            arrays[field] = _plain(array, name, field)
            continue
        dense, counts = _dense(array, name, field, _TAILS.get(field, ()))
        if not np.array_equal(np.where(array.is_valid(), counts, lengths), lengths):
            row = int(np.flatnonzero(np.where(array.is_valid(), counts, lengths) != lengths)[0])
            raise CandidateError(name, field, f"{counts[row]} contacts in row {row}", f"{lengths[row]} as in positions")
        tail = dense.shape[2:]
        full = np.full((len(dense), contacts, *tail), np.nan)
        full[:, : dense.shape[1]] = dense[:, :contacts]
        full[~present] = _PADDING.get(field, 1.0)
        arrays[field] = full
    if "active" in arrays:
        active = arrays["active"]
        active = np.broadcast_to(active[:, None] if active.ndim == 1 else active, present.shape)
        arrays["active"] = (np.nan_to_num(active, nan=1.0) != 0) & present
    elif ragged:
        arrays["active"] = present
    return arrays


def _dense(array: pa.Array, name: Path | str, field: str, tail: tuple[int, ...]) -> tuple[np.ndarray, np.ndarray]:
    """Values (N, n_c, *tail) of lists, NaN behind shorter ones, and how many contacts a row has.

    A row that is null is NaN, and has as many contacts as the largest one.
    """
    wanted = "a list of contacts" + "".join(f", {size} each" for size in tail)
    if not _is_list(array.type):
        raise CandidateError(name, field, f"the type {array.type}", wanted)
    valid = np.asarray(array.is_valid())
    lengths = _lengths(array)
    declared = array.type.list_size if pa.types.is_fixed_size_list(array.type) else 0
    largest = int(max(lengths.max(initial=declared), 1))
    flat = array.flatten()
    for size in tail:
        if not _is_list(flat.type):
            raise CandidateError(name, field, f"the type {array.type}", wanted)
        inside = _lengths(flat)
        if (inside != size).any():
            raise CandidateError(name, field, f"lists of {inside.min()} to {inside.max()}", wanted)
        flat = flat.flatten()
    if not _is_number(flat.type):
        raise CandidateError(name, field, f"the type {array.type}", wanted)
    values = _floats(flat).reshape(-1, *tail)
    if valid.all() and (lengths == largest).all():
        return values.reshape(len(lengths), largest, *tail), lengths
    dense = np.full((len(lengths), largest, *tail), np.nan)
    dense[valid[:, None] & (np.arange(largest) < lengths[:, None])] = values
    return dense, np.where(valid, lengths, largest)


def _lengths(array: pa.Array) -> np.ndarray:
    """The lengths of lists, 0 where one is null."""
    lengths = pc.call_function("list_value_length", [array])
    return lengths.fill_null(0).to_numpy(zero_copy_only=False).astype(np.int64)


def _plain(array: pa.Array, name: Path | str, field: str) -> np.ndarray:
    if not _is_number(array.type):
        raise CandidateError(name, field, f"the type {array.type}", "numbers")
    return _floats(array)


def _floats(array: pa.Array) -> np.ndarray:
    """Numbers and truth values as doubles, NaN where null."""
    if pa.types.is_boolean(array.type):
        array = array.cast(pa.uint8())
    values = array.to_numpy(zero_copy_only=False)
    return values.astype(np.float64, copy=False)


def _whole(column: pa.ChunkedArray) -> pa.Array:
    """A column in one piece, of tensors as lists."""
    array = column.combine_chunks()
    if isinstance(array, pa.ChunkedArray):
        array = array.chunk(0) if array.num_chunks else pa.array([], array.type)
    if isinstance(array.type, pa.FixedShapeTensorType):
        return _lists(array.to_numpy_ndarray())
    if isinstance(array, pa.ExtensionArray):
        # Ray's own tensors know NumPy, and nothing of Arrow's.
        values = array.to_numpy(zero_copy_only=False)
        return _lists(values) if values.dtype != object else array.storage
    return array


def _lists(values: np.ndarray) -> pa.Array:
    """Rows of an array as lists, of which the outermost has no fixed size."""
    array = pa.array(np.ascontiguousarray(values).ravel())
    for size in reversed(values.shape[2:]):
        array = pa.FixedSizeListArray.from_arrays(array, size)
    if values.ndim > 1:
        offsets = np.arange(len(values) + 1, dtype=np.int32) * values.shape[1]
        array = pa.ListArray.from_arrays(pa.array(offsets), array)
    return array


def _shape(kind: pa.DataType) -> tuple[tuple[int, ...], pa.DataType]:
    shape: tuple[int, ...] = ()
    while pa.types.is_fixed_size_list(kind):
        shape, kind = (*shape, kind.list_size), kind.value_type
    return shape, kind


def _is_list(kind: pa.DataType) -> bool:
    return pa.types.is_list(kind) or pa.types.is_large_list(kind) or pa.types.is_fixed_size_list(kind)


def _is_number(kind: pa.DataType) -> bool:
    return pa.types.is_floating(kind) or pa.types.is_integer(kind) or pa.types.is_boolean(kind)
