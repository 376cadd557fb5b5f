"""Names of joints that mean the same joint: with a prefix of the hand's side, or numbered along the Allegro hand."""

import re
from collections.abc import Sequence

# The URDF of the Allegro hand numbers its joints from the index finger's to the thumb's; MJCF files of it, whose axes
# and zeros are the same, name them by finger. Other hands' names of one joint differ in axis or zero, too.
_ALLEGRO = {
    f"joint_{4 * k + j}.0": f"{finger}j{j}" for k, finger in enumerate(("ff", "mf", "rf", "th")) for j in range(4)
}
_PREFIX = re.compile(r"[a-z]{1,5}[_/]", re.IGNORECASE)


def renamed(names: Sequence[str], hand: Sequence[str]) -> tuple[str, ...]:
    """The hand's names of a file's joints.

    Args:
        names: The file's.
        hand: The hand's.

    Returns:
        The file's own names where the hand has them all; else those that differ by one prefix (`rh_FFJ4` for `FFJ4`)
        or in the way of counting the Allegro hand's joints, where the hand has all of these.

    Raises:
        LookupError: A joint that the hand does not have; it is the only argument.
    """
    there = set(hand)
    back = {new: old for old, new in _ALLEGRO.items()}
    ways = [list(names), *([table.get(name, name) for name in names] for table in (_ALLEGRO, back))]
    prefixes = sorted({match.group() for name in hand if (match := _PREFIX.match(name))})
    ways += [[prefix + name for name in names] for prefix in prefixes]
    own = {match.group() if (match := _PREFIX.match(name)) else "" for name in names}
    if len(own) == 1:
        (prefix,) = own
        ways.append([name.removeprefix(prefix) for name in names])
    for way in ways:
        if there.issuperset(way) and len(set(way)) == len(way):
            return tuple(way)
    raise LookupError(next(name for name in names if name not in there))
