"""Contraction of sums of products to chains of fused multiply-adds.

Programs add in pairs, for XLA; but only one of the two products of a pair can be part of a fused multiply-add. In a
chain ((a b + c d) + e f) + ... each product but the first can, and is rounded once with its sum. The additions of a
chain wait for each other, which costs nothing, since there are always others to do. A constant factor that several
terms have in common is factored out, since multiplications are what takes the time.
"""

from collections import Counter
from collections.abc import Iterable
from typing import Any

from jaxgrasp.kernels.program.expressions import Value

# Sums of more terms are cut in two, also for the sake of rounding.
_LONGEST = 16
# Chains whose later half is only subtracted are cut above this, before Python's recursion ends.
_DEEPEST = 200
# A scalar, and whether it is added rather than subtracted.
Term = tuple[Any, bool]


def chain_sums(values: Iterable[Value], count: Counter[Value]) -> list[Value]:
    """Turn sums into chains, in place.

    Args:
        values: all values of a program.
        count: how often each value is used; it stays right for all but sums.

    Returns:
        The sums that the program then has.
    """
    inner: set[Value] = set()
    sums = [value for value in values if _is_sum(value)]
    for value in sums:
        inner.update(x for x in value.args if type(x) is Value and _is_sum(x) and _belongs(x, value, count))
    chained: list[Value] = []
    for value in sums:
        if value not in inner:
            _chain(value, count, chained)
    return chained


def _is_sum(value: Value) -> bool:
    return value.op in ("add", "sub") and value.kind == "f"


def _belongs(part: Value, whole: Value, count: Counter[Value]) -> bool:
    """Tell whether nothing else needs the part, and it is computed in the region of the whole."""
    return count[part] == 1 and part.region is whole.region


def _chain(root: Value, count: Counter[Value], chained: list[Value]) -> None:
    """Make a sum and all sums within it one chain, where that saves something."""
    # Collect the terms.
    terms: list[Term] = []
    parts: list[Value] = []
    stack: list[Term] = [(root, True)]
    while stack:
        x, positive = stack.pop()
        if x is root or (type(x) is Value and _is_sum(x) and _belongs(x, root, count)):
            parts.append(x)
            first, second = x.args
            stack += [(second, positive == (x.op == "add")), (first, positive)]
        else:
            terms.append((x, positive))
    # Factor constants out.
    count_before = len(terms)
    terms = _factor_constants(terms, root, count, chained)
    if len(terms) == 1:
        # The first term is never subtracted, so that this one is not.
        root.op, root.args = "mul", terms[0][0].args
        return
    products = [t for t in terms if type(t[0]) is Value and t[0].op == "mul" and _belongs(t[0], root, count)]
    if len(terms) == count_before and (len(terms) < 3 or len(products) < 2):
        chained += parts
        return
    # Products go to the end: the first term is in no fused multiply-add.
    chosen = {id(x) for x, _ in products}
    ordered = _positive_first([t for t in terms if id(t[0]) not in chosen] + products)
    root.op, root.args = _last_addition(ordered, root, chained)
    chained.append(root)


def _factor_constants(terms: list[Term], root: Value, count: Counter[Value], chained: list[Value]) -> list[Term]:
    """Replace terms with the same constant factor by the product of the constant and their sum."""
    alike: dict[Any, list[tuple[Value, Any, bool]]] = {}
    kept: list[Term] = []
    for x, positive in terms:
        constant, other = _split_constant(x, root, count)
        if constant is None:
            kept.append((x, positive))
        else:
            alike.setdefault(constant, []).append((x, other, positive))
    for constant, group in alike.items():
        if len(group) == 1:
            kept.append((group[0][0], group[0][2]))
            continue
        sign = any(positive for *_, positive in group)
        parts = []
        for _, other, positive in group:
            if isinstance(other, tuple):
                other = Value("mul", other, "f", root.region)
                count[other] = 1
            parts.append((other, positive == sign))
        total = _add_in_turn(_positive_first(parts), root, chained)
        product = Value("mul", (constant, total), "f", root.region)
        count[product] = count[total] = 1
        kept.append((product, sign))
    return kept


def _split_constant(x: Any, root: Value, count: Counter[Value]) -> tuple[Any, Any]:
    """Split a product into a constant and the rest: a value, or the factors of a new product. None if there is none."""
    if type(x) is not Value or x.op != "mul" or not _belongs(x, root, count):
        return None, None
    first, second = x.args
    if type(first) is not Value:
        return first, second
    for factor, other in ((first, second), (second, first)):
        if factor.op == "mul" and type(factor.args[0]) is not Value and _belongs(factor, root, count):
            return factor.args[0], (factor.args[1], other)
    return None, None


def _positive_first(terms: list[Term]) -> list[Term]:
    """Move a term that is added to the front; there always is one, since the leftmost term of a sum is added."""
    number = next(number for number, (_, positive) in enumerate(terms) if positive)
    return [terms[number], *terms[:number], *terms[number + 1 :]]


def _last_addition(terms: list[Term], like: Value, chained: list[Value]) -> tuple[str, tuple]:
    """Return operation and operands of the last addition of a chain, whose first term is added."""
    half = len(terms) // 2
    if len(terms) > _LONGEST and any(positive for _, positive in terms[half:]):
        return "add", (
            _add_in_turn(terms[:half], like, chained),
            _add_in_turn(_positive_first(terms[half:]), like, chained),
        )
    if len(terms) > _DEEPEST:
        subtracted = [(x, True) for x, _ in terms[half:]]
        return "sub", (_add_in_turn(terms[:half], like, chained), _add_in_turn(subtracted, like, chained))
    *before, (last, positive) = terms
    return "add" if positive else "sub", (_add_in_turn(before, like, chained), last)


def _add_in_turn(terms: list[Term], like: Value, chained: list[Value]) -> Any:
    """Return the sum of terms as a chain in the region of `like`."""
    if len(terms) == 1:
        return terms[0][0]
    value = Value(*_last_addition(terms, like, chained), "f", like.region)
    chained.append(value)
    return value
