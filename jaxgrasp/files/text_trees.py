"""JSON, YAML and XML of strangers, as dicts, lists, text and numbers.

None of the three may say what it is read as: YAML's tags and anchors and XML's document types, with their entities,
are refused. How many entries a file has is counted before they are made; how deep they are, on the way.
"""

import json
import re
from pathlib import Path
from typing import Any
from xml.parsers import expat

from jaxgrasp.storage import FileError, allowance, open_regular

# An entry of a list takes some hundred bytes of memory: together a sixteenth of the budget.
_PER_ENTRY = 16 * 128
_DEPTH = 16
# One character beyond the first 65,536 makes four bytes of every other one of its text, and parsers keep that twice.
_COST = 64
_NUMBER = re.compile(r"[-+]?(\d+\.?\d*|\.\d+)([eE][-+]?\d+)?")
_WORDS = {"true": True, "false": False, "null": None, "~": None, "": None}
_REALS = {".nan": "nan", ".inf": "inf", "-.inf": "-inf", "+.inf": "inf"}


def read_json(path: Path) -> object:
    """Reads a file of JSON.

    Raises:
        FileError: It is damaged, too large or too deep.
    """
    wanted = "intact JSON"
    content = _content(path, wanted, _COST)
    _check_count(path, content.count(b",") + content.count(b"[") + content.count(b"{"))
    try:
        return json.loads(content)
    except (ValueError, RecursionError) as error:
        what = "lists that are too deep" if isinstance(error, RecursionError) else f"damaged JSON ({error})"
        raise FileError(path, None, what, wanted) from error


def read_yaml(path: Path) -> object:
    """Reads a file of YAML; every scalar is a number, a truth value, nothing or text.

    Raises:
        FileError: It is damaged, too large or too deep, has a tag or an anchor, or PyYAML is not installed.
    """
    try:
        import yaml
    except ImportError as error:
        raise FileError(path, None, "YAML, which PyYAML reads", "pip install 'jaxgrasp[files]'") from error
    wanted = "intact YAML without tags and anchors"
    content = _content(path, wanted, _COST)
    loader = getattr(yaml, "CSafeLoader", yaml.SafeLoader)
    try:
        return _built(path, yaml.parse(content, Loader=loader), wanted)
    except (yaml.YAMLError, ValueError) as error:
        if isinstance(error, FileError):
            raise
        raise FileError(path, None, f"damaged YAML ({str(error)[:200]})", wanted) from error


def read_xml(path: Path) -> list[tuple[str, str]]:
    """Reads the text of a file of XML.

    Returns:
        For each element, in the order in which they end, its tags from the outermost one on (`world/robot/filename`)
        and its text.

    Raises:
        FileError: It is damaged, too large or too deep, or has a document type.
    """
    wanted = "well-formed XML without a document type"
    content = _content(path, wanted, _COST)
    _check_count(path, content.count(b"<"))
    found: list[tuple[str, str]] = []
    open_tags: list[str] = []
    texts: list[list[str]] = []

    def refuse(*_: Any) -> None:
        raise FileError(path, None, "a document type, in which entities are defined", wanted)

    def start(tag: str, _: Any) -> None:
        if len(open_tags) >= _DEPTH:
            raise FileError(path, None, f"elements more than {_DEPTH} deep", wanted)
        open_tags.append(tag)
        texts.append([])

    def end(_: str) -> None:
        found.append(("/".join(open_tags), "".join(texts.pop()).strip()))
        open_tags.pop()

    parser = expat.ParserCreate()
    parser.StartDoctypeDeclHandler = refuse
    parser.StartElementHandler, parser.EndElementHandler = start, end
    parser.CharacterDataHandler = lambda text: texts[-1].append(text) if texts else None
    try:
        parser.Parse(content, True)
    except (expat.ExpatError, ValueError, LookupError) as error:
        if isinstance(error, FileError):
            raise
        raise FileError(path, None, f"XML that is not well-formed ({error})", wanted) from error
    return found


def _content(path: Path, wanted: str, cost: int) -> bytes:
    with open_regular(path, wanted, cost) as stream:
        return stream.read()


def _check_count(path: Path, count: int) -> None:
    most = allowance() // _PER_ENTRY
    if count > most:
        raise FileError(path, None, f"{count:,} entries", f"at most {most:,} (see --read-limit)")


def _built(path: Path, events: Any, wanted: str) -> object:
    """The tree of YAML's events, of the first document alone."""
    root: list = []
    # Containers that are open, and for each the key that waits for its value.
    around: list[list | dict] = [root]
    keys: list[Any] = [None]
    count, most = 0, allowance() // _PER_ENTRY
    for event in events:
        kind = type(event).__name__
        count += 1
        if count > most:
            raise FileError(path, None, f"more than {most:,} entries", "fewer (see --read-limit)")
        if kind == "AliasEvent" or getattr(event, "anchor", None):
            raise FileError(path, None, "an anchor or an alias", wanted)
        tag = getattr(event, "tag", None)
        if tag not in (None, "!") or (tag == "!" and kind != "ScalarEvent"):
            raise FileError(path, None, f"the tag {tag[:80]}", wanted)
        if kind in ("MappingEndEvent", "SequenceEndEvent"):
            around.pop()
            keys.pop()
            continue
        if kind == "DocumentEndEvent":
            break
        if kind not in ("ScalarEvent", "MappingStartEvent", "SequenceStartEvent"):
            continue
        value = _scalar(event) if kind == "ScalarEvent" else {} if kind == "MappingStartEvent" else []
        _put(path, around[-1], keys, value, kind == "ScalarEvent", wanted)
        if kind != "ScalarEvent":
            if len(around) > _DEPTH:
                raise FileError(path, None, f"lists more than {_DEPTH} deep", wanted)
            around.append(value)  # type: ignore[arg-type]
            keys.append(None)
    return root[0] if root else None


def _put(path: Path, into: list | dict, keys: list[Any], value: Any, scalar: bool, wanted: str) -> None:
    if isinstance(into, list):
        into.append(value)
    elif keys[-1] is None:
        if not scalar:
            raise FileError(path, None, "a key that is no word", wanted)
        # In a tuple, so that the key null is a key, too.
        keys[-1] = (str(value),)
    else:
        (key,) = keys[-1]
        into[key] = value
        keys[-1] = None


def _scalar(event: Any) -> object:
    text = event.value
    if not event.implicit[0]:
        return text
    if text.lower() in _WORDS:
        return _WORDS[text.lower()]
    if len(text) < 64 and _NUMBER.fullmatch(text):
        return float(text) if re.search(r"[.eE]", text) else int(text)
    return float(_REALS[text.lower()]) if text.lower() in _REALS else text
