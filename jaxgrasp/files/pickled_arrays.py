"""What stands for NumPy's names in pickles: arrays, scalars and their types, made of the bytes that a file has.

`np.save` and `pickle` write an array as a call of `_reconstruct` and a state: shape, type, order and bytes. The state
is checked against the number of bytes before an array is made of them.
"""

import math
import re
from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

from jaxgrasp.storage import Header, array_of_bytes

_TYPE = re.compile(r"[<>=|]?(?:b1|[iu][1248]|f[248]|[US]\d{1,6}|O8?)")
_DIMENSIONS = 32


@dataclass(frozen=True)
class Name:
    """What a pickle's name stands for."""

    make: Callable[..., object] | None = None
    """What a call of it gives; None where it cannot be called."""
    text: str = ""
    """What it says where it is no more than a word."""


@dataclass
class Unbuilt:
    """Something that a state comes for."""

    kept_as: list[int] = field(default_factory=list)
    """Numbers in the memo."""

    def built(self, state: object) -> object:
        """What the state makes of it.

        Raises:
            ValueError: The state is none of its kind.
        """
        raise NotImplementedError


@dataclass
class _Type(Unbuilt):
    dtype: np.dtype = field(default_factory=lambda: np.dtype("u1"))

    def built(self, state: object) -> object:
        """A type of the same kind with the state's order of bytes."""
        if type(state) is not tuple or len(state) < 5 or state[1] not in ("<", ">", "=", "|"):
            raise ValueError("a state that is no type's")
        if any(part is not None for part in state[2:5]) or (len(state) > 8 and state[8]):
            raise ValueError("a type with fields")
        if state[1] in "<>":
            self.dtype = self.dtype.newbyteorder(state[1])
        return self


@dataclass
class _Array(Unbuilt):
    def built(self, state: object) -> object:
        """The array of a state."""
        if type(state) is not tuple or len(state) != 5:
            raise ValueError("a state that is no array's")
        _, shape, kind, fortran, data = state
        return _array(shape, kind, fortran is True, data)


ARRAY, TYPE = Name(), Name(lambda *arguments: _type(*arguments))


def _type(text: object, *_: object) -> _Type:
    if type(text) is not str or not _TYPE.fullmatch(text):
        raise ValueError("a type that is neither number, truth value nor text")
    return _Type(dtype=np.dtype(text))


def _reconstruct(kind: object, *_: object) -> _Array:
    if kind is not ARRAY:
        raise ValueError("a kind of array that is not NumPy's own")
    return _Array()


def _array(shape: object, kind: object, fortran: bool, data: object) -> object:
    if type(shape) is not tuple or len(shape) > _DIMENSIONS or not all(_is_length(size) for size in shape):
        raise ValueError("no shape")
    if not isinstance(kind, _Type):
        raise ValueError("no type")
    if kind.dtype.hasobject:
        return _objects(shape, data)
    data = _as_bytes(data)
    header = Header(shape, kind.dtype, fortran, 0)
    if header.size != len(data):
        raise ValueError(f"{len(data):,} bytes for the shape {shape} of {kind.dtype}")
    return array_of_bytes("pickle", None, header, np.frombuffer(data, np.uint8))


def _objects(shape: tuple[int, ...], data: object) -> object:
    if type(data) is not list or len(shape) > 1 or math.prod(shape) != len(data):
        raise ValueError(f"objects of shape {shape}")
    return data if shape else data[0]


def _scalar(kind: object, data: object) -> object:
    if not isinstance(kind, _Type) or kind.dtype.hasobject:
        raise ValueError("no type")
    array = _array((), kind, False, data)
    assert isinstance(array, np.ndarray)
    return array[()]


def _from_buffer(data: object, kind: object, shape: object, order: object = "C", *_: object) -> object:
    if isinstance(kind, _Type) and kind.dtype.hasobject:
        raise ValueError("objects in a buffer")
    return _array(shape, kind, order == "F", data)


def _encoded(text: object, encoding: object = "latin1", *_: object) -> bytes:
    """The bytes that Python 3 writes as text in the protocols of Python 2."""
    if type(text) is not str or encoding not in ("latin1", "latin-1"):
        raise ValueError("an encoding")
    return text.encode("latin-1")


def _as_bytes(data: object) -> bytes:
    # In pickles of Python 2 bytes are text.
    if type(data) is str:
        return data.encode("latin-1")
    if type(data) is not bytes:
        raise ValueError("no bytes")
    return data


def _is_length(size: object) -> bool:
    # Truth values are whole numbers to Python.
    return type(size) is int and 0 <= size < 2**62


def _table(pairs: object = ()) -> dict:
    if type(pairs) not in (list, tuple):
        raise ValueError("no pairs")
    table = {}
    for key, value in pairs:  # type: ignore[union-attr]
        if type(key) is not str:
            raise ValueError("a key that is no text")
        table[key] = value
    return table


_CORES = ("numpy.core", "numpy._core")
KNOWN: dict[tuple[str, str], Name] = {
    ("numpy", "ndarray"): ARRAY,
    ("numpy", "dtype"): TYPE,
    ("_codecs", "encode"): Name(_encoded),
    # So no bytes at all are written in the protocols of Python 2.
    ("__builtin__", "bytes"): Name(lambda: b""),
    ("collections", "OrderedDict"): Name(_table),
    **{(f"{core}.multiarray", "_reconstruct"): Name(_reconstruct) for core in _CORES},
    **{(f"{core}.multiarray", "scalar"): Name(_scalar) for core in _CORES},
    **{(f"{core}.numeric", "_frombuffer"): Name(_from_buffer) for core in _CORES},
}
"""What stands for each module and name that may be in a pickle."""
