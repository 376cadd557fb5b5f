"""Sums of products as chains: each product but the first is then part of an addition, rounded once.

Programs add in pairs, for XLA; but only one of the two products of a pair can be part of their sum. Along a chain the
additions wait for each other, which costs nothing, since there are always others to do.
"""

from collections import Counter
from collections.abc import Iterable
from typing import Any

from jaxgrasp.kernels.expressions import Value

# Longer sums are cut in two, for the rounding's sake as well.
_LONGEST = 16


def chain_sums(values: Iterable[Value], count: Counter[Value]) -> None:
    """Turn sums into chains, in place.

    Args:
        values: of a whole program.
        count: how often each is used.
    """
    inner: set[Value] = set()
    sums = [value for value in values if _is_sum(value)]
    for value in sums:
        inner.update(x for x in value.args if type(x) is Value and _is_sum(x) and _belongs(x, value, count))
    for value in sums:
        if value not in inner:
            _chain(value, count)


def _is_sum(value: Value) -> bool:
    return value.op in ("add", "sub") and value.kind == "f"


def _belongs(part: Value, whole: Value, count: Counter[Value]) -> bool:
    """Nothing else needs the part, and it is computed where the whole is."""
    return count[part] == 1 and part.region is whole.region


def _chain(root: Value, count: Counter[Value]) -> None:
    terms: list[tuple[Any, bool]] = []
    stack: list[tuple[Any, bool]] = [(root, True)]
    while stack:
        x, positive = stack.pop()
        if type(x) is Value and _is_sum(x) and (x is root or _belongs(x, root, count)):
            left, right = x.args
            stack += [(right, positive == (x.op == "add")), (left, positive)]
        else:
            terms.append((x, positive))
    products = [t for t in terms if type(t[0]) is Value and t[0].op == "mul" and _belongs(t[0], root, count)]
    if len(terms) < 3 or len(products) < 2:
        return
    chosen = {id(x) for x, _ in products}
    others = [t for t in terms if id(t[0]) not in chosen]
    # Something positive comes first: there always is, as what is leftmost is not subtracted.
    ordered = others + products
    first = next(number for number, (_, positive) in enumerate(ordered) if positive)
    ordered.insert(0, ordered.pop(first))
    root.op, root.args = _added(ordered, root)


def _added(terms: list[tuple[Any, bool]], like: Value) -> tuple[str, tuple]:
    """The operation that ends the sum of all terms, the first of which is positive."""
    if len(terms) > _LONGEST:
        half = len(terms) // 2
        head, tail = terms[:half], terms[half:]
        positive = next((number for number, term in enumerate(tail) if term[1]), None)
        if positive is not None:
            tail.insert(0, tail.pop(positive))
            return "add", (_value(head, like), _value(tail, like))
    *before, (last, positive) = terms
    return "add" if positive else "sub", (_value(before, like), last)


def _value(terms: list[tuple[Any, bool]], like: Value) -> Any:
    return terms[0][0] if len(terms) == 1 else Value(*_added(terms, like), "f", like.region)
