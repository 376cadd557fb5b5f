"""The README is short, its numbers are measured, links lead somewhere, and the site builds without a warning."""

from __future__ import annotations

import os
import re
import subprocess
import sys

import pytest
from documented import FENCE, PAGES, ROOT

LINK = re.compile(r"\]\((?![a-z]+:|#)([^)\s#]+)")
# What a page loads when it is opened: scripts, style sheets, pictures, frames. Links to click on may lead anywhere.
LOADED = re.compile(r"<(?:script|img|iframe|link)\b[^>]*?(?:src|href)=\"?((?:https?:)?//[^\">\s]+)")


def test_the_readme_is_short():
    assert len((ROOT / "README.md").read_text().splitlines()) <= 150


def test_the_rows_of_speed_are_those_of_the_benchmark():
    measured = (ROOT / "benchmarks" / "kernels.md").read_text()
    rates = {
        (precision, what): int(rate.replace(",", ""))
        for precision, what, rate in re.findall(r"\| 16,384 \| (float\d\d) \| ([^|]+) \| ([\d,]+) \|", measured)
    }
    rows = re.findall(r"^\| (.*) \| ([\d,]+) \| ([\d,]+) \|$", (ROOT / "README.md").read_text(), re.MULTILINE)
    for (_, *told), what in zip(rows, ("fused kernel", "XLA", "C++, 10 steps"), strict=True):
        assert [int(number.replace(",", "")) for number in told] == [
            round(rates[precision, what], -3) for precision in ("float64", "float32")
        ]
    first, kept = re.findall(r"takes ([\d.]+) s where .*?, and\s+([\d.]+) s", (ROOT / "README.md").read_text())[0]
    assert f"| nothing compiled before | {first} |" in measured and f"| kernel kept on disk | {kept} |" in measured


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.relative_to(ROOT).as_posix())
def test_links_lead_to_files(page):
    for link in LINK.findall(FENCE.sub("", page.read_text())):
        assert (page.parent / link).exists(), link


def test_the_site_builds_and_loads_nothing_from_other_hosts(tmp_path):
    pytest.importorskip("mkdocs")
    command = [sys.executable, "-m", "mkdocs", "build", "--quiet", "--site-dir", str(tmp_path / "site")]
    built = subprocess.run(command, cwd=ROOT, env={**os.environ, "NO_MKDOCS_2_WARNING": "1"}, capture_output=True)
    assert built.returncode == 0, built.stderr.decode()
    pages = list((tmp_path / "site").rglob("*.html"))
    assert len(pages) > len(PAGES)
    for page in pages:
        text = page.read_text()
        assert not LOADED.findall(text), page
        assert 'class="arithmatex"' not in text, page
