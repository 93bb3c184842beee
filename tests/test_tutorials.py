"""The notebooks of the docs: every cell runs, and prints what is stored."""

import json
import re
from pathlib import Path

import pytest
from helpers import slow_but
from run_notebooks import NOTEBOOKS, code_cells, run_cells, stored

each_notebook = pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda p: p.stem)
NUMBER = re.compile(r"-?\d+(?:[.,]\d+)*(?:e[+-]?\d+)?%?")


def outline(text: str) -> list[str]:
    """Lines without their numbers, which differ in the last digits between machines."""
    return [" ".join(NUMBER.sub("0", line).split()) for line in text.splitlines()]


@each_notebook
def test_its_form_is_a_notebook_s(path: Path):
    content = json.loads(path.read_text())
    assert (content["nbformat"], content["nbformat_minor"]) == (4, 5)
    identities = [cell["id"] for cell in content["cells"]]
    assert len(identities) == len(set(identities)) > 5


@pytest.mark.parametrize(
    "path", slow_but(NOTEBOOKS[:1], NOTEBOOKS), ids=lambda p: p.stem
)
def test_every_cell_prints_what_is_stored(path: Path, monkeypatch, tmp_path):
    """To store outputs anew: python tests/tools/run_notebooks.py."""
    monkeypatch.chdir(tmp_path)
    notebook = json.loads(path.read_text())
    printed = run_cells(notebook)
    for cell, text in zip(code_cells(notebook), printed, strict=True):
        assert outline(stored(cell)) == outline(text)
        assert "nan" not in text
    assert sum(len(text.splitlines()) for text in printed) > 5


def test_there_are_some():
    assert {path.stem for path in NOTEBOOKS} >= {"first_policy", "own_robot"}
