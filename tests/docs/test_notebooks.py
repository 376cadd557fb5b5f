"""The notebooks run from top to bottom, and print what they show."""

from __future__ import annotations

import json
from contextlib import redirect_stdout
from io import StringIO

import jax
import matplotlib.pyplot as plt
import pytest
from documented import ROOT, assert_printed

# Eighty steps of ascent add up what processors round differently.
SCATTER = {"gradients": 0.02}
NOTEBOOKS = sorted((ROOT / "examples" / "notebooks").glob("*.ipynb"))


def test_there_are_some():
    assert len(NOTEBOOKS) == 4


@pytest.mark.thorough
@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_it_prints_what_it_shows(path, monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    plt.switch_backend("Agg")
    names: dict[str, object] = {"__name__": "__main__"}
    for cell in json.loads(path.read_text())["cells"]:
        if cell["cell_type"] != "code":
            continue
        told = StringIO()
        # A reader's JAX promotes dtypes as usual.
        with redirect_stdout(told), jax.numpy_dtype_promotion("standard"):
            exec(compile("".join(cell["source"]), path.name, "exec"), names)
        shown = "".join(line for output in cell["outputs"] for line in output.get("text", []))
        assert_printed(shown, told.getvalue(), SCATTER.get(path.stem, 0.0))
        plt.close("all")
