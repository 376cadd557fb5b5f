"""Files of `torch.save`, read without PyTorch: a zip archive with a pickle and the numbers of each storage beside it.

The pickle names a storage by a persistent id (type, name, device, length) and a tensor by a call of
`_rebuild_tensor_v2` with storage, offset, shape and strides. Both are checked against the member's bytes, and a tensor
may not have more entries than its storage.
"""

import math
from pathlib import Path
from typing import Any

import numpy as np

from jaxgrasp.files.pickled_arrays import KNOWN, Name
from jaxgrasp.files.pickles import unpickle
from jaxgrasp.storage import FileError, read_members

_WANTED = "a file of torch.save"
_TYPES = {
    "Double": "f8",
    "Float": "f4",
    "Half": "f2",
    "Long": "i8",
    "Int": "i4",
    "Short": "i2",
    "Char": "i1",
    "Byte": "u1",
    "Bool": "b1",
    # The upper half of a Float's bits.
    "BFloat16": "u2",
}


def read_torch(path: Path) -> object:
    """Reads what `torch.save` has written, with NumPy arrays in place of tensors.

    Args:
        path: The file.

    Raises:
        FileError: It is damaged, too large, of the time before PyTorch 1.6, or has anything but data in it.
    """
    members = read_members(path, _WANTED)
    name = next((name for name in members if name.rpartition("/")[2] == "data.pkl"), None)
    if name is None:
        raise FileError(path, None, "an archive without data.pkl", _WANTED)
    folder = name.removesuffix("data.pkl")
    order = ">" if members.get(f"{folder}byteorder", b"").strip() == b"big" else "<"

    storages: dict[tuple[str, str], np.ndarray] = {}

    def storage(given: object) -> np.ndarray:
        if type(given) is not tuple or len(given) != 5 or given[0] != "storage" or not isinstance(given[1], Name):
            raise ValueError("a persistent id that is no storage")
        kind, key, length = given[1].text, given[2], given[4]
        if (kind, key) not in storages:
            content = members.get(f"{folder}data/{key}") if type(key) is str else None
            dtype = np.dtype(_TYPES[kind]).newbyteorder(order)
            if content is None or type(length) is not int or length * dtype.itemsize != len(content):
                raise ValueError(f"a storage of {length} numbers that the file does not have")
            storages[kind, key] = _numbers(kind, np.frombuffer(content, dtype))
        return storages[kind, key]

    return unpickle(path, members[name], known=_KNOWN, persistent=storage)


def _numbers(kind: str, stored: np.ndarray) -> np.ndarray:
    if kind == "BFloat16":
        return (stored.astype("u4") << 16).view("f4")
    return stored != 0 if kind == "Bool" else stored


def _tensor(storage: object, offset: object, shape: object, strides: object, *_: object) -> np.ndarray:
    if not isinstance(storage, np.ndarray) or not _lengths((offset,)) or not (_lengths(shape) and _lengths(strides)):
        raise ValueError("a tensor that is none")
    sizes: Any = shape
    steps: Any = strides
    first: Any = offset
    count = math.prod(sizes)
    last = first + sum((size - 1) * step for size, step in zip(sizes, steps, strict=True))
    if count and (count > len(storage) or last >= len(storage)):
        raise ValueError(f"a tensor of shape {sizes} in a storage of {len(storage):,}")
    width = storage.itemsize
    part = storage[first:] if count else storage[:0]
    # No copy: any number of tensors may lie in one storage.
    return np.lib.stride_tricks.as_strided(part, sizes, [width * step for step in steps], writeable=False)


def _lengths(sizes: object) -> bool:
    return type(sizes) is tuple and len(sizes) <= 32 and all(type(s) is int and 0 <= s < 2**40 for s in sizes)


def _parameter(data: object, *_: object) -> object:
    return data


_KNOWN = KNOWN | {
    ("torch._utils", "_rebuild_tensor_v2"): Name(_tensor),
    ("torch._utils", "_rebuild_parameter"): Name(_parameter),
    ("torch", "Size"): Name(lambda sizes: sizes),
    **{("torch", f"{name}Storage"): Name(text=name) for name in _TYPES},
}
