"""What `benchmarks.truth` found, as lines and tables."""

from __future__ import annotations

import os
import platform
from collections import Counter

import jax

from benchmarks.suite.families import FAMILIES

PROGRAMS = ("margin", "effort")
STATUSES = {
    "solved": (0,),
    "infeasible": (1,),
    "unbounded": (2,),
    "undecided": (3, 4),
    "not verified": (7,),
}
FAULTS = ("wrong", "wrong, rank in doubt", "crossed", "false_status", "harmed", "invalid")
MOST_DECADES = 4
"""float32 promises nothing of forces that spread over more."""


def faults(line: dict) -> dict[str, int]:
    """The counts of a batch, or of a total, that ought to be zero."""
    promised = line["dtype"] == "float64" or FAMILIES[line["family"]].decades <= MOST_DECADES
    names = [f"{program} {fault}" for program in PROGRAMS for fault in FAULTS]
    if not promised:
        names = [name for name in names if "wrong" not in name]
    return {name: line["counts"][name] for name in names if line["counts"].get(name)}


def told(line: dict) -> str:
    """One batch in a line."""
    lanes, (solve, check) = line["counts"]["lanes"], line["seconds"]
    bad = ", ".join(f"{name} {n}" for name, n in faults(line).items()) or "no faults"
    rate = lanes / (solve + check)
    return f"{line['dtype']} {line['family']} {line['seed']}: {bad}; {rate:,.0f} lanes/s, solving {solve:.2f} s"


def totals(lines: list[dict]) -> list[dict]:
    """One line for each precision and family, in the order of the families."""
    order = {name: k for k, name in enumerate(FAMILIES)}
    found: dict[tuple[str, str], Counter] = {}
    for line in lines:
        found.setdefault((line["dtype"], line["family"]), Counter()).update(line["counts"])
    keys = sorted(found, key=lambda key: (key[0] != "float64", order[key[1]]))
    return [{"dtype": dtype, "family": family, "counts": found[dtype, family]} for dtype, family in keys]


def report(lines: list[dict]) -> str:
    """The whole report."""
    parts = [HEAD]
    for dtype in ("float64", "float32"):
        own = [total for total in totals(lines) if total["dtype"] == dtype]
        if own:
            seconds = [sum(line["seconds"][k] for line in lines if line["dtype"] == dtype) for k in (0, 1)]
            parts += [f"## {dtype}", summary(own, seconds), table(own)]
    parts.append(f"Python {platform.python_version()}, JAX {jax.__version__}, {os.cpu_count()} cores ({processor()}).")
    return "\n\n".join(parts) + "\n"


def summary(own: list[dict], seconds: list[float]) -> str:
    """Lanes and faults of a precision."""
    counts = sum((total["counts"] for total in own), Counter())
    bad = sum((Counter(faults(total)) for total in own), Counter())
    lanes = counts["lanes"]
    text = ", ".join(f"{name.replace('_', ' ')} {n:,}" for name, n in bad.items()) or "none"
    return (
        f"{lanes:,} lanes, {counts['spoilt']:,} of them spoilt, each through both programs. **Faults: {text}.**\n"
        f"HiGHS was asked about {counts['highs open']:,} lanes that their own forces and multipliers do not settle\n"
        f"and {counts['highs sample']:,} others; {counts['unsettled']:,} stayed unsettled. Some bit depends on\n"
        f"neighbours in {counts['margin bits differ']:,} lanes of (21), {counts['effort bits differ']:,} of (22).\n"
        f"Solving took {seconds[0]:,.0f} s, compiling included, checking {seconds[1]:,.0f} s: "
        f"{lanes / sum(seconds):,.0f} lanes a second."
    )


def table(own: list[dict]) -> str:
    """A row for each family."""
    head = (
        "| family | lanes | solved, % | undecided, % | not verified | wrong | crossed | false status | harmed "
        "| spoilt, told wrong | in doubt: wrong | within rounding | not proved least |"
    )
    rows = [head, "|---" * (head.count("|") - 1) + "|"]
    for total in own:
        counts = total["counts"]
        sound = counts["lanes"] - counts["spoilt"]

        def share(name: str, counts: Counter = counts, sound: int = sound) -> str:
            return " / ".join(
                f"{100 * sum(counts[f'{p} status {s}'] for s in STATUSES[name]) / max(sound, 1):.3g}" for p in PROGRAMS
            )

        def number(name: str, counts: Counter = counts) -> str:
            return " / ".join(f"{counts[f'{p} {name}']}" for p in PROGRAMS)

        cells = [total["family"], f"{counts['lanes']:,}", share("solved"), share("undecided")]
        cells += [number("status 7"), *[number(f) for f in FAULTS if f != FAULTS[1]]]
        cells += [f"{counts['doubtful']:,}: {number(FAULTS[1])}"]
        cells += [number("rounding"), f"{counts['effort suboptimal']}"]
        rows.append("| " + " | ".join(cells) + " |")
    return "\n".join(rows)


def processor() -> str:
    """The processor's name and widest vectors, where Linux tells."""
    try:
        with open("/proc/cpuinfo") as file:
            text = file.read()
    except OSError:
        return platform.machine()
    names = [line.split(":")[1].strip() for line in text.splitlines() if line.startswith("model name")]
    vectors = "AVX-512" if " avx512f " in text else "AVX2" if " avx2 " in text else "no AVX2"
    return f"{names[0] if names else platform.machine()}, {vectors}"


HEAD = """# Whether answers are true

`JAXGRASP_AUDIT=strict python -m benchmarks.truth --dtype float64 --lanes 4000000` and
`--dtype float32 --lanes 1000000`, with `--seed 47` and one `--record`: lanes of the families in
`benchmarks/suite/families.py`, one in eight spoilt, solved by `largest_disturbance` (21) and by `least_effort` (22) at
0 to 1.5 times the margin found. Two figures stand for (21) / (22).

- **Wrong**: SOLVED and, in float64 NumPy, G f misses b by more than 1e-7 (float32: 3e-5) of the larger of |b| and the
  sum of |f_i|, moments over the grasp's size; or a pyramid or bound row is exceeded, at the margin claimed or at the
  one asked for, by more than 1e-7 (3e-5) of its max_force; or margin or upper bound is off the optimum by more than
  1e-6 (1e-4) of the mean max_force. S_1 and S_2 come from a pseudo-inverse by singular values. The optimum lies
  between what the lane's forces attain and what its multipliers exclude, both put into NumPy's own rows; where these do
  not settle it, and for a random sample, HiGHS finds it.
- **In doubt**: lanes with a singular value of G between 1e-13 and 1e-6 (1e-7 and 3e-3) of the largest, or with a load
  or disturbance of which a share between 1e-12 and 1e-6 (1e-6 and 3e-3) is out of reach. They stand apart; wrong are
  those that break the first two rules with the rank that the package says.
- **Within rounding**: a row is exceeded, but only by what rounding makes of S_1 and S_2 in NumPy itself.
- **Crossed**: the upper bound is below the margin by more than 1e-11 (1e-5) of the larger of both and of the margin's
  natural scale, whatever the status but NOT_VERIFIED.
- **False status**: INFEASIBLE or UNBOUNDED where it is not.
- **Harmed**: status or some field depends, by more than 1e-12 (1e-5) of it, on whether other lanes are spoilt.
- **Spoilt, told wrong**: a spoilt lane is not INVALID_INPUT with NaN for margin and forces, or a sound one is.
- **Not proved least**: the multipliers of (22) do not prove the effort to 1e-6 (1e-3).

Of float32, lanes whose forces spread over more than four decades are shown but not promised."""
