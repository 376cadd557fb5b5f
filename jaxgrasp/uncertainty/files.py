"""Uncertainties in files: JSON, or an archive of NumPy arrays."""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from jaxgrasp.storage import FileError, open_archive, open_regular
from jaxgrasp.uncertainty.spec import QUANTITIES, Distribution, Samples, Uncertainty, normal, samples, uniform

_OPTIONS = {"std", "mean", "lower", "upper", "correlation", "half_width", "samples"}
_OF_UNIFORM = {"half_width", "mean", "correlation"}
# A matrix of 64 contacts' positions has 36,864 numbers.
_LARGEST, _COST = 1 << 22, 16


def read_uncertainty(path: Path | str) -> Uncertainty:
    """Reads the distributions of what is not known of grasps.

    Quantities and units are those of `Uncertainty`. In JSON a quantity is a number, the standard deviation of a normal
    distribution, or an object with the arguments of `normal` (std, mean, lower, upper, correlation), of `uniform`
    (half_width, mean, correlation), or samples; numbers may be nested lists. In an `.npz` archive arrays are called
    like quantities, which are samples, or quantity.argument (`friction.std`).

    Args:
        path: The file, `.json` or `.npz`.

    Raises:
        FileError: The file cannot be read, a name in it is unknown, or what it has is no distribution.

    Example:
        >>> spec = read_uncertainty("errors.json")  # doctest: +SKIP
        >>> jg.margin_distribution(grasp, pushes, spec)  # doctest: +SKIP
    """
    path = Path(path)
    given = _of_archive(path) if path.suffix == ".npz" else _of_json(path)
    found: dict[str, Distribution | Samples] = {}
    for name, options in given.items():
        if name not in QUANTITIES:
            raise FileError(path, name, "an unknown quantity", f"one of {', '.join(QUANTITIES)}")
        try:
            found[name] = _distribution(path, name, options)
            Uncertainty.of(**{name: found[name]})
        except FileError:
            raise
        except (ValueError, TypeError, OverflowError) as error:
            field, _, rest = str(error).partition(": got ")
            got, _, wanted = rest.partition(", wanted ")
            raise FileError(path, f"{name}.{field}" if wanted else name, got or field, wanted or "numbers") from error
    if not found:
        raise FileError(path, None, "no quantity", f"at least one of {', '.join(QUANTITIES)}")
    try:
        return Uncertainty.of(**found)
    except ValueError as error:
        got = str(error).partition("got ")[2].partition(", wanted")[0]
        raise FileError(path, None, got, "as many samples of each") from error


def _distribution(path: Path, name: str, options: Mapping[str, Any]) -> Distribution | Samples:
    unknown = sorted(set(options) - _OPTIONS)
    if unknown:
        raise FileError(path, f"{name}.{unknown[0]}", "an unknown field", f"one of {', '.join(sorted(_OPTIONS))}")
    kinds = [kind for kind in ("std", "half_width", "samples") if kind in options]
    if len(kinds) != 1:
        got = " and ".join(kinds) or "none of std, half_width and samples"
        raise FileError(path, name, got, "exactly one of std, half_width and samples")
    numbers = {field: _numbers(path, f"{name}.{field}", value) for field, value in options.items()}
    allowed = {"std": _OPTIONS - {"half_width", "samples"}, "half_width": _OF_UNIFORM, "samples": {"samples"}}[kinds[0]]
    others = sorted(set(options) - allowed)
    if others:
        raise FileError(path, f"{name}.{others[0]}", f"{kinds[0]}, too", f"no {others[0]} with {kinds[0]}")
    if kinds[0] == "samples":
        return samples(numbers["samples"])
    return normal(**numbers) if kinds[0] == "std" else uniform(**numbers)


def _numbers(path: Path, field: str, value: Any) -> np.ndarray:
    try:
        found = np.asarray(value)
    except ValueError:
        found = np.array(None)
    if found.dtype.kind not in "iuf":
        raise FileError(path, field, "no numbers, or lists of different lengths", "a number, or nested lists of them")
    return found.astype(float)


def _of_json(path: Path) -> dict[str, Mapping[str, Any]]:
    with open_regular(path, "an uncertainty, .json or .npz", _COST) as stream:
        content = stream.read(_LARGEST + 1)
    if len(content) > _LARGEST:
        raise FileError(path, None, f"more than {_LARGEST:,} bytes", "an .npz archive for so much")
    try:
        found = json.loads(content)
    except (ValueError, RecursionError) as error:
        raise FileError(path, None, f"no JSON ({' '.join(str(error).split())})", "an object of quantities") from error
    if not isinstance(found, dict):
        raise FileError(path, None, f"JSON that is a {type(found).__name__}", "an object of quantities")
    return {name: options if isinstance(options, dict) else {"std": options} for name, options in found.items()}


def _of_archive(path: Path) -> dict[str, Mapping[str, Any]]:
    with open_archive(path, "an uncertainty, .json or .npz") as archive:
        arrays = archive.read(archive.headers)
    found: dict[str, Any] = {}
    for full, array in arrays.items():
        name, _, option = full.partition(".")
        found.setdefault(name, {})[option or "samples"] = array
    return found
