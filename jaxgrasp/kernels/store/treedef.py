"""The structure of a program's results as JSON: shapes and types of arrays in containers and in records."""

import dataclasses
import importlib
import json
from typing import Any

import numpy as np

_PACKAGE = __name__.partition(".")[0]


def write(tree: Any) -> bytes:
    """Serialise a pytree's structure: shapes and dtypes of arrays, values of static numbers and strings.

    Raises:
        TypeError: the tree holds something else than these, lists, tuples, dictionaries and records of this package.
    """
    return json.dumps(_encode(tree)).encode()


def read(content: bytes) -> Any:
    """Build the tree again, with arrays of arbitrary contents.

    Raises:
        ValueError: the content was not written by `write`.
    """
    try:
        return _decode(json.loads(content))
    except (AttributeError, ImportError, KeyError, TypeError) as error:
        raise ValueError(f"no structure of a tree: {error}") from error


def _encode(x: Any) -> Any:
    if x is None:
        return None
    if isinstance(x, bool | int | float | str):
        return {"plain": x}
    if isinstance(x, np.ndarray):
        return {"shape": x.shape, "dtype": x.dtype.name}
    if isinstance(x, dict):
        return {"dict": {key: _encode(value) for key, value in x.items()}}
    if type(x) in (list, tuple):
        return {type(x).__name__: [_encode(value) for value in x]}
    names = getattr(x, "_fields", None) or [field.name for field in dataclasses.fields(x)]
    kind = type(x)
    if kind.__module__.partition(".")[0] != _PACKAGE:
        raise TypeError(f"got a {kind.__module__}.{kind.__qualname__}, wanted a record of {_PACKAGE}")
    return {"class": [kind.__module__, kind.__qualname__], "fields": {n: _encode(getattr(x, n)) for n in names}}


def _decode(x: Any) -> Any:
    if x is None:
        return None
    if "plain" in x:
        return x["plain"]
    if "shape" in x:
        return np.empty(x["shape"], x["dtype"])
    if "dict" in x:
        return {key: _decode(value) for key, value in x["dict"].items()}
    if "class" not in x:
        ((kind, values),) = x.items()
        return {"list": list, "tuple": tuple}[kind](map(_decode, values))
    module, name = x["class"]
    if module.partition(".")[0] != _PACKAGE:
        raise TypeError(f"got {module}, wanted a module of {_PACKAGE}")
    kind = getattr(importlib.import_module(module), name)
    if not (isinstance(kind, type) and (hasattr(kind, "_fields") or dataclasses.is_dataclass(kind))):
        raise TypeError(f"{module}.{name} is no record")
    return kind(**{n: _decode(value) for n, value in x["fields"].items()})
