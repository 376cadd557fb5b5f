"""Immutable records of arrays that JAX takes as trees, equal where their contents are."""

from dataclasses import dataclass
from typing import Any, TypeVar, dataclass_transform

import jax
import numpy as np

T = TypeVar("T")


@dataclass_transform(frozen_default=True, kw_only_default=True)
def record(cls: type[T]) -> type[T]:
    """Make a class a frozen dataclass with keyword arguments, a tree for JAX, and equal by value.

    Two records are equal where their classes, shapes, dtypes and all numbers are; NaN equals NaN. Inside a program
    that JAX traces numbers are not known, and comparing them is the error that it is for arrays.
    """
    cls.__eq__ = _equal  # type: ignore[method-assign, assignment]
    cls.__hash__ = _hash  # type: ignore[method-assign, assignment]
    return jax.tree_util.register_dataclass(dataclass(frozen=True, kw_only=True, eq=False)(cls))


def _equal(self: Any, other: object) -> bool:
    if type(self) is not type(other):
        return NotImplemented
    if self is other:
        return True
    ours, theirs = jax.tree.leaves(self), jax.tree.leaves(other)
    if _hash(self) != _hash(other):
        return False
    return all(_same(a, b) for a, b in zip(ours, theirs, strict=True))


def _same(a: Any, b: Any) -> bool:
    a, b = np.asarray(a), np.asarray(b)
    return bool(np.array_equal(a, b, equal_nan=np.issubdtype(a.dtype, np.inexact)))


def _hash(self: Any) -> int:
    leaves, structure = jax.tree.flatten(self)
    return hash((type(self), structure, tuple((np.shape(x), str(getattr(x, "dtype", type(x)))) for x in leaves)))
