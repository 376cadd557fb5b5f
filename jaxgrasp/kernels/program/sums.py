"""Sums of products as chains: each product but the first is then part of an addition, rounded once.

Programs add in pairs, for XLA; but only one of the two products of a pair can be part of their sum. Along a chain the
additions wait for each other, which costs nothing, since there are always others to do. Of terms that have a constant
in common, it is taken out: processors add beside multiplying, and multiplications are what takes the time.
"""

from collections import Counter
from collections.abc import Iterable
from typing import Any

from jaxgrasp.kernels.program.expressions import Value

# Longer sums are cut in two, for the rounding's sake as well.
_LONGEST = 16


def chain_sums(values: Iterable[Value], count: Counter[Value]) -> list[Value]:
    """Turn sums into chains, in place.

    Args:
        values: of a whole program.
        count: how often each is used; stays right for all but sums.

    Returns:
        The sums that are left.
    """
    inner: set[Value] = set()
    sums = [value for value in values if _is_sum(value)]
    for value in sums:
        inner.update(x for x in value.args if type(x) is Value and _is_sum(x) and _belongs(x, value, count))
    left: list[Value] = []
    for value in sums:
        if value not in inner:
            _chain(value, count, left)
    return left


def _is_sum(value: Value) -> bool:
    return value.op in ("add", "sub") and value.kind == "f"


def _belongs(part: Value, whole: Value, count: Counter[Value]) -> bool:
    """Nothing else needs the part, and it is computed where the whole is."""
    return count[part] == 1 and part.region is whole.region


def _chain(root: Value, count: Counter[Value], left: list[Value]) -> None:
    terms: list[tuple[Any, bool]] = []
    parts: list[Value] = []
    stack: list[tuple[Any, bool]] = [(root, True)]
    while stack:
        x, positive = stack.pop()
        if x is root or (type(x) is Value and _is_sum(x) and _belongs(x, root, count)):
            parts.append(x)
            first, second = x.args
            stack += [(second, positive == (x.op == "add")), (first, positive)]
        else:
            terms.append((x, positive))
    count_before = len(terms)
    terms = _constants_taken_out(terms, root, count, left)
    if len(terms) == 1:
        # Something positive was first, so that this is.
        root.op, root.args = "mul", terms[0][0].args
        return
    products = [t for t in terms if type(t[0]) is Value and t[0].op == "mul" and _belongs(t[0], root, count)]
    if len(terms) == count_before and (len(terms) < 3 or len(products) < 2):
        left += parts
        return
    chosen = {id(x) for x, _ in products}
    # Something positive comes first: there always is, as what is leftmost is not subtracted.
    ordered = _positive_first([t for t in terms if id(t[0]) not in chosen] + products)
    root.op, root.args = _added(ordered, root, left)
    left.append(root)


def _constants_taken_out(
    terms: list[tuple[Any, bool]], root: Value, count: Counter[Value], left: list[Value]
) -> list[tuple[Any, bool]]:
    """Terms, those with the same constant as one: it times their sum."""
    alike: dict[Any, list[tuple[Value, Any, bool]]] = {}
    kept: list[tuple[Any, bool]] = []
    for x, positive in terms:
        constant, other = _constant_of(x, root, count)
        if constant is None:
            kept.append((x, positive))
        else:
            alike.setdefault(constant, []).append((x, other, positive))
    for constant, some in alike.items():
        if len(some) == 1:
            kept.append((some[0][0], some[0][2]))
            continue
        sign = any(positive for *_, positive in some)
        parts = []
        for _, other, positive in some:
            if isinstance(other, tuple):
                other = Value("mul", other, "f", root.region)
                count[other] = 1
            parts.append((other, positive == sign))
        total = _value(_positive_first(parts), root, left)
        product = Value("mul", (constant, total), "f", root.region)
        count[product] = count[total] = 1
        kept.append((product, sign))
    return kept


def _constant_of(x: Any, root: Value, count: Counter[Value]) -> tuple[Any, Any]:
    """What a product has of a constant, and the rest: a value, or the factors of a new product."""
    if type(x) is not Value or x.op != "mul" or not _belongs(x, root, count):
        return None, None
    first, second = x.args
    if type(first) is not Value:
        return first, second
    for factor, other in ((first, second), (second, first)):
        if factor.op == "mul" and type(factor.args[0]) is not Value and _belongs(factor, root, count):
            return factor.args[0], (factor.args[1], other)
    return None, None


def _positive_first(terms: list[tuple[Any, bool]]) -> list[tuple[Any, bool]]:
    number = next(number for number, (_, positive) in enumerate(terms) if positive)
    return [terms[number], *terms[:number], *terms[number + 1 :]]


def _added(terms: list[tuple[Any, bool]], like: Value, left: list[Value]) -> tuple[str, tuple]:
    """The operation that ends the sum of all terms, the first of which is positive."""
    half = len(terms) // 2
    if len(terms) > _LONGEST and any(positive for _, positive in terms[half:]):
        return "add", (_value(terms[:half], like, left), _value(_positive_first(terms[half:]), like, left))
    *before, (last, positive) = terms
    return "add" if positive else "sub", (_value(before, like, left), last)


def _value(terms: list[tuple[Any, bool]], like: Value, left: list[Value]) -> Any:
    if len(terms) == 1:
        return terms[0][0]
    value = Value(*_added(terms, like, left), "f", like.region)
    left.append(value)
    return value
