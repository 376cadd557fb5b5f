"""The code blocks of README and docs/: where they are, how they run, and how their output is compared."""

from __future__ import annotations

import re
import shlex
from collections.abc import Iterator
from contextlib import redirect_stdout
from dataclasses import dataclass
from io import StringIO
from pathlib import Path

import jax

from jaxgrasp.cli import main
from jaxgrasp.cli.subcommands import parsed

ROOT = Path(__file__).resolve().parents[2]
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md"))]
FENCE = re.compile(r"^```(\w*)\n(.*?)^```$", re.MULTILINE | re.DOTALL)
NUMBER = re.compile(r"(?<![\w.])[-+]?\d[\d,]*(?:\.\d*)?(?:e[-+]?\d+)?")


@dataclass(frozen=True)
class Block:
    language: str
    code: str
    printed: str | None
    """What the page says that it prints; None where it says nothing."""


def blocks(page: Path) -> list[Block]:
    """The blocks of a page in their order. A `text` block right below another one is what that one prints."""
    text = page.read_text()
    found: list[Block] = []
    end = None
    for fence in FENCE.finditer(text):
        language, code = fence.groups()
        if language == "text" and end is not None and not text[end : fence.start()].strip():
            found[-1] = Block(found[-1].language, found[-1].code, code)
            end = None
        else:
            found.append(Block(language, code, None))
            end = fence.end() if language in ("python", "sh") else None
    return found


def run(block: Block, names: dict[str, object]) -> str:
    """Run a block in the working folder, and return what it prints; `names` are those of the blocks before it."""
    told = StringIO()
    with redirect_stdout(told):
        if block.language == "python":
            # A reader's JAX promotes dtypes as usual.
            with jax.numpy_dtype_promotion("standard"):
                exec(compile(block.code, "block.py", "exec"), names)
        else:
            for command in commands(block.code):
                execute(command)
    return told.getvalue()


def commands(code: str) -> Iterator[list[str]]:
    """The commands of a `sh` block, each as its words."""
    for line in code.replace("\\\n", " ").splitlines():
        words = shlex.split(line, comments=True)
        while words:
            end = words.index("&&") if "&&" in words else len(words)
            yield words[:end]
            words = words[end + 1 :]


def execute(command: list[str]) -> None:
    """Run a command of this package here; make sure of other commands that some other test runs what they name."""
    program, *words = command
    match program.removeprefix(".venv/bin/"):
        case "jaxgrasp" if words[0] == "view" and "--export" not in words:
            # A page is there until somebody ends it: tests/viewer opens some.
            assert parsed(words) is not None
        case "jaxgrasp":
            # The command writes to the standard output of its process.
            assert main(words) == 0, command
        case "python" if words[0].startswith("examples/"):
            assert (ROOT / words[0]).exists(), command
        case "python" if words[:2] == ["-m", "pytest"]:
            assert shlex.join(command[1:]).replace("'", '"') in (ROOT / ".ci" / "run").read_text(), command
        case "python3.11":
            assert words == ["-m", "venv", ".venv"]
        case "pip":
            wanted = re.findall(r"\[(.*?)\]", words[-1])
            offered = (ROOT / "pyproject.toml").read_text()
            assert words[0] == "install" and all(f"\n{extra} = [" in offered for extra in wanted), command
        case "mkdocs":
            assert words == ["serve"]
        case _:
            raise AssertionError(f"{command}: no test runs this")


def assert_printed(expected: str, printed: str, scatter: float = 0.0) -> None:
    """Compare words one by one, and numbers to a unit of the last digit that the page has.

    Args:
        expected: What the page says; `...` stands for anything.
        printed: What came.
        scatter: By how much of themselves numbers may differ besides.
    """
    pattern, position, wanted = "", 0, []
    text = " ".join(expected.split())
    for number in NUMBER.finditer(text):
        pattern += literal(text[position : number.start()]) + f"({NUMBER.pattern})"
        wanted.append(number.group())
        position = number.end()
    found = re.fullmatch(pattern + literal(text[position:]), " ".join(printed.split()), re.DOTALL)
    assert found, f"wanted\n{expected}\ngot\n{printed}"
    for one, other in zip(wanted, found.groups(), strict=True):
        a, b = (float(each.replace(",", "")) for each in (one, other))
        assert abs(a - b) <= 1.001 * last_digit(one) + scatter * abs(a), f"wanted {one}, got {other} in\n{printed}"


def literal(text: str) -> str:
    # Columns of tables and arrays are as wide as their numbers.
    words = [re.escape(part) for part in text.split("...")]
    return re.sub(r"[━─═]+", "[━─═]+", ".*?".join(words).replace(r"\ ", r"\s*"))


def last_digit(number: str) -> float:
    """The unit of the last digit; nothing for whole numbers, which are counts."""
    mantissa, _, exponent = number.replace(",", "").partition("e")
    digits = len(mantissa.partition(".")[2])
    return 10.0 ** (int(exponent or 0) - digits) if digits or exponent else 0.0
