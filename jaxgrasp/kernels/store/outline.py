"""What a program returns, written down as JSON: shapes and types of arrays in containers and in records."""

import dataclasses
import importlib
import json
from typing import Any

import numpy as np

_PACKAGE = __name__.partition(".")[0]


def written(tree: Any) -> bytes:
    """A tree of arrays, whose contents are left out, and of what is not traced in records: numbers and words.

    Raises:
        TypeError: something in it is none of these, a container, or a record of this package.
    """
    return json.dumps(_told(tree)).encode()


def read(content: bytes) -> Any:
    """The tree again, with arrays of any contents.

    Raises:
        ValueError: this was not written by `written`.
    """
    try:
        return _made(json.loads(content))
    except (AttributeError, ImportError, KeyError, TypeError) as error:
        raise ValueError(f"no outline of a tree: {error}") from error


def _told(x: Any) -> Any:
    if x is None:
        return None
    if isinstance(x, bool | int | float | str):
        return {"plain": x}
    if isinstance(x, np.ndarray):
        return {"shape": x.shape, "dtype": x.dtype.name}
    if isinstance(x, dict):
        return {"dict": {key: _told(value) for key, value in x.items()}}
    if type(x) in (list, tuple):
        return {type(x).__name__: [_told(value) for value in x]}
    names = getattr(x, "_fields", None) or [field.name for field in dataclasses.fields(x)]
    kind = type(x)
    if kind.__module__.partition(".")[0] != _PACKAGE:
        raise TypeError(f"got a {kind.__module__}.{kind.__qualname__}, wanted a record of {_PACKAGE}")
    return {"class": [kind.__module__, kind.__qualname__], "fields": {n: _told(getattr(x, n)) for n in names}}


def _made(x: Any) -> Any:
    if x is None:
        return None
    if "plain" in x:
        return x["plain"]
    if "shape" in x:
        return np.empty(x["shape"], x["dtype"])
    if "dict" in x:
        return {key: _made(value) for key, value in x["dict"].items()}
    if "class" not in x:
        ((kind, values),) = x.items()
        return {"list": list, "tuple": tuple}[kind](map(_made, values))
    module, name = x["class"]
    if module.partition(".")[0] != _PACKAGE:
        raise TypeError(f"got {module}, wanted a module of {_PACKAGE}")
    kind = getattr(importlib.import_module(module), name)
    if not (isinstance(kind, type) and (hasattr(kind, "_fields") or dataclasses.is_dataclass(kind))):
        raise TypeError(f"{module}.{name} is no record")
    return kind(**{n: _made(value) for n, value in x["fields"].items()})
