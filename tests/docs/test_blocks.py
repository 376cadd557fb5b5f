"""Every block of code in README and docs/ runs, and prints what stands below it."""

from __future__ import annotations

import importlib.util
import shutil
from pathlib import Path

import jax
import pytest
from documented import PAGES, ROOT, assert_printed, blocks, run
from workplace import write_candidates, write_grasps_of_a_can

# Pages whose blocks take long.
SLOW = {
    "docs/compliance.md",
    "docs/evaluation.md",
    "docs/grasp_files.md",
    "docs/hand_synthesis.md",
    "docs/hands.md",
    "docs/how_to/add_my_hand.md",
    "docs/how_to/held_but_no_margin.md",
    "docs/how_to/why_is_my_margin_zero.md",
    "docs/many_candidates.md",
    "docs/metrics.md",
    "docs/scenes.md",
    "docs/synthesis.md",
    "docs/tutorial.md",
    "docs/uncertainty.md",
}
# Hundreds of steps from random starts make other grasps of other roundings, which depend on the processor.
SCATTER = {"docs/hand_synthesis.md": 0.2, "docs/synthesis.md": 0.1, "docs/tutorial.md": 0.2}


def name_of(page: Path) -> str:
    return page.relative_to(ROOT).as_posix()


WITH_CODE = [page for page in PAGES if any(block.language in ("python", "sh") for block in blocks(page))]


@pytest.fixture(scope="module")
def light(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("candidates")
    write_candidates(folder)
    return folder


@pytest.fixture(scope="module")
def heavy(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("grasps")
    write_grasps_of_a_can(folder)
    return folder


@pytest.mark.parametrize(
    "page",
    [
        pytest.param(page, id=name_of(page), marks=[pytest.mark.thorough] if name_of(page) in SLOW else [])
        for page in WITH_CODE
    ],
)
def test_it_prints_what_it_says(page, light, request, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for folder in (light, request.getfixturevalue("heavy")) if name_of(page) in SLOW else (light,):
        shutil.copytree(folder, tmp_path, dirs_exist_ok=True)
    # The tests have two devices already, and JAX has started.
    update = jax.config.update
    monkeypatch.setattr(jax.config, "update", lambda name, value: None if "num_cpu" in name else update(name, value))
    names = {"__name__": "__main__"}
    for block in blocks(page):
        if block.language not in ("python", "sh"):
            continue
        if "--ray" in block.code and importlib.util.find_spec("ray") is None:
            continue
        printed = run(block, names)
        if block.printed is not None:
            assert_printed(block.printed, printed, SCATTER.get(name_of(page), 0.0))


def test_the_comparison_finds_what_differs():
    told = "margin 4.535 N of 12 grasps, in ... s"
    assert_printed(told, "margin  4.536 N of 12 grasps, in 0.3 s\n")
    for other in ("margin 4.538 N of 12 grasps, in 0.3 s", "margin 4.535 N of 13 grasps, in 0.3 s", "nothing"):
        with pytest.raises(AssertionError):
            assert_printed(told, other)
    assert_printed("5.00 best", "5.4 best", scatter=0.1)


def test_all_blocks_have_a_language():
    for page in PAGES:
        assert {block.language for block in blocks(page)} <= {"python", "sh", "text", "json"}, page
