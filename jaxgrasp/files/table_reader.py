"""The process in which a table is read, see `tables_apart`; it imports nothing else of the package.

Arguments: the kind, the file, where its arrays go (`.npz`), how many bytes these may have, and how many bytes and
seconds the process may take. It exits with 1, and says why on standard output, where the file cannot be used.
"""

import re
import sys
import zipfile
from typing import Any

import numpy as np

_COLUMNS = 2_000
_NUMBERED = re.compile(r"(.+?)((?:_\d+)+)")


class _Refused(Exception):
    pass


def _limit(memory: int, seconds: int) -> None:
    try:
        import resource
    except ImportError:  # Windows has no such limits.
        return
    for kind, limit in ((resource.RLIMIT_AS, memory), (resource.RLIMIT_CPU, seconds), (resource.RLIMIT_CORE, 0)):
        hardest = resource.getrlimit(kind)[1]
        limit = limit if hardest == resource.RLIM_INFINITY else min(limit, hardest)
        resource.setrlimit(kind, (limit, limit))


def _hdf5(path: str, budget: int) -> dict[str, np.ndarray]:
    import h5py

    found: dict[str, np.ndarray] = {}
    left = budget
    with h5py.File(path, "r") as file:
        # Groups to look into; addresses, since a group may be linked into itself.
        waiting: list[tuple[str, Any]] = [("", file)]
        seen: set[int] = set()
        while waiting:
            prefix, group = waiting.pop()
            if group.id.__hash__() in seen or len(seen) > _COLUMNS:
                raise _Refused("groups that are part of themselves or too many")
            seen.add(group.id.__hash__())
            for name in group:
                link = group.get(name, getlink=True)
                if not isinstance(link, h5py.HardLink):
                    raise _Refused(f"a link to elsewhere ({prefix}{name})")
                part: Any = group[name]
                if isinstance(part, h5py.Group):
                    waiting.append((f"{prefix}{name}/", part))
                elif isinstance(part, h5py.Dataset):
                    if part.external or part.is_virtual:
                        raise _Refused(f"data that lie in other files ({prefix}{name})")
                    left -= 8 * (part.size or 0)
                    if left < 0 or len(found) >= _COLUMNS:
                        raise _Refused("data that are too large or too many (see --read-limit)")
                    value = _dataset(h5py, part)
                    if value is not None:
                        found[prefix + name] = value
    return found


def _dataset(h5py, part) -> np.ndarray | None:
    """Numbers, truth values or text; None where they are something else."""
    if h5py.check_string_dtype(part.dtype) is not None:
        if part.shape == ():
            return np.array(part.asstr(errors="replace")[()])
        return np.array(part.asstr(errors="replace")[...].tolist(), dtype=str)
    return part[()] if part.dtype.kind in "biuf" and part.shape is not None else None


def _parquet(path: str, budget: int) -> dict[str, np.ndarray]:
    from pyarrow import parquet

    with parquet.ParquetFile(path, memory_map=False) as file:
        about = file.metadata
        groups = [about.row_group(k) for k in range(about.num_row_groups)]
        size = sum(group.total_byte_size for group in groups)
        # Lists have more values than rows, and numbers that repeat take hardly any bytes.
        count = sum(group.column(j).num_values for group in groups for j in range(about.num_columns))
        if max(size, 8 * count) > budget or about.num_columns > _COLUMNS:
            raise _Refused("data that are too large or too many (see --read-limit)")
        table = file.read(use_threads=False)
    return _joined(table, budget)


def _arrays(table, budget: int) -> dict[str, np.ndarray | None]:
    import pyarrow as pa

    def array(column, count: int) -> np.ndarray | None:
        kind = column.type
        if pa.types.is_dictionary(kind):
            return array(column.dictionary_decode(), count)
        if pa.types.is_list(kind) or pa.types.is_large_list(kind) or pa.types.is_fixed_size_list(kind):
            inner = column.flatten()
            if column.null_count or not count or len(inner) % count:
                return None
            lengths = set(column.value_lengths().unique().to_pylist()) if not pa.types.is_fixed_size_list(kind) else ()
            below = array(inner, len(inner)) if len(lengths) <= 1 else None
            return None if below is None else below.reshape(count, len(inner) // count, *below.shape[1:])
        if pa.types.is_string(kind) or pa.types.is_large_string(kind):
            texts = ["" if text is None else text for text in column.to_pylist()]
            if 4 * count * max(map(len, texts), default=0) > budget:
                raise _Refused("text that is too long (see --read-limit)")
            return np.array(texts, dtype=str)
        if pa.types.is_boolean(kind) or pa.types.is_integer(kind) or pa.types.is_floating(kind):
            return (
                column.to_numpy(zero_copy_only=False)
                if not column.null_count
                else column.cast("float64").to_numpy(zero_copy_only=False)
            )
        return None

    whole = {name: table.column(name).combine_chunks() for name in dict.fromkeys(table.column_names)}
    return {name: array(column, len(column)) for name, column in whole.items()}


def _csv(path: str, budget: int) -> dict[str, np.ndarray]:
    from pyarrow import csv

    options = csv.ReadOptions(use_threads=False)
    table = csv.read_csv(path, options, convert_options=csv.ConvertOptions(strings_can_be_null=False))
    if 8 * table.num_rows * table.num_columns > budget or table.num_columns > 10 * _COLUMNS:
        raise _Refused("data that are too large or too many (see --read-limit)")
    return _joined(table, budget)


def _joined(table, budget: int) -> dict[str, np.ndarray]:
    """The columns, those that are numbered (`grasp_qpos_0`, `grasp_qpos_1` ...) as one array."""
    flat = {name: value for name, value in _arrays(table, budget).items() if value is not None}
    found: dict[str, np.ndarray] = {}
    parts: dict[str, list[str]] = {}
    for name in flat:
        match = _NUMBERED.fullmatch(name)
        parts.setdefault(match.group(1) if match else name, []).append(name)
    for name, names in parts.items():
        places = [tuple(map(int, part[len(name) + 1 :].split("_"))) for part in names if part != name]
        shape = tuple(np.max(places, axis=0) + 1) if places and len({len(place) for place in places}) == 1 else ()
        if len(places) != len(names) or not shape or np.prod(shape) != len(names) or len(set(places)) != len(names):
            found |= {part: flat[part] for part in names}
            continue
        found[name] = np.stack([flat[part] for _, part in sorted(zip(places, names, strict=True))], -1).reshape(
            -1, *shape
        )
    return found


def main(kind: str, path: str, result: str, budget: int, memory: int, seconds: int) -> int:
    """Reads a table and writes its arrays; returns the exit code."""
    _limit(memory, seconds)
    try:
        found = {"hdf5": _hdf5, "parquet": _parquet, "csv": _csv}[kind](path, budget)
    except ImportError:
        return 3
    except _Refused as error:
        sys.stdout.buffer.write(str(error).encode("utf-8", "replace"))
        return 1
    except Exception as error:
        # Whatever the libraries make of damage.
        text = f"damaged data ({' '.join(str(error).split())[:200] or type(error).__name__})"
        sys.stdout.buffer.write(text.encode("utf-8", "replace"))
        return 1
    # numpy.savez takes names as keyword arguments, of which it has some itself.
    with zipfile.ZipFile(result, "w") as archive:
        for name, value in found.items():
            with archive.open(f"{name}.npy", "w", force_zip64=True) as member:
                np.lib.format.write_array(member, value, allow_pickle=False)
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1], sys.argv[2], sys.argv[3], *map(int, sys.argv[4:7])))
