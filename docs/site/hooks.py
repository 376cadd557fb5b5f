"""Files outside of docs/ as pages of the site, links as they are in the repository, and formulas as MathML."""

import html
import posixpath
import re
from pathlib import Path

from latex2mathml.converter import convert
from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import File, Files
from mkdocs.structure.pages import Page

ROOT = Path(__file__).resolve().parents[2]
# The repository's files that are pages or pictures of the site. The README is its first page.
PATTERNS = ("*.md", "LICENSE", "CITATION.cff", "benchmarks/**/*.md", "benchmarks/*.png", "tests/README.md")
PATTERNS += ("jaxgrasp/kernels/README.md", "examples/*.*")
LINK = re.compile(r"\]\((?![a-z]+:|#|/)([^)\s#]+)")
TABLE = re.compile(r"<!-- table (\d+) of (\S+) -->")
FORMULA = re.compile(r'<(span|div) class="arithmatex">\\[(\[](.*?)\\[)\]]</\1>', re.DOTALL)


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Add what the repository has outside of docs/."""
    for pattern in PATTERNS:
        for path in sorted(ROOT.glob(pattern)):
            place = _in_site(path.relative_to(ROOT).as_posix())
            files.append(File.generated(config, place, abs_src_path=str(path)))
    return files


def on_page_markdown(markdown: str, page: Page, config: MkDocsConfig, files: Files) -> str:
    """Put tables of benchmarks where comments ask for them, and turn links between files into links between pages."""
    markdown = TABLE.sub(lambda asked: table(int(asked[1]), asked[2]), markdown)
    folder = Path(str(page.file.abs_src_path)).relative_to(ROOT).parent.as_posix()

    def moved(link: re.Match[str]) -> str:
        target = _in_site(posixpath.normpath(posixpath.join(folder, link[1])))
        return "](" + posixpath.relpath(target, posixpath.dirname(page.file.src_uri) or ".")

    return LINK.sub(moved, markdown)


def on_page_content(content: str, page: Page, config: MkDocsConfig, files: Files) -> str:
    """Typeset formulas for the browser, which needs no script for MathML."""

    def typeset(formula: re.Match[str]) -> str:
        display = "block" if formula[1] == "div" else "inline"
        return convert(html.unescape(formula[2]).strip(), display=display)

    return FORMULA.sub(typeset, content)


def table(number: int, path: str) -> str:
    """The table of that number, from 1, in a file of the repository."""
    blocks = (ROOT / path).read_text().split("\n\n")
    return [block for block in blocks if block.startswith("|")][number - 1]


def _in_site(path: str) -> str:
    """The place in the site of a file of the repository."""
    return "index.md" if path == "README.md" else path.removeprefix("docs/")
