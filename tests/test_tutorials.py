"""The notebooks of the docs: stored as they were written, and every cell runs."""

import json
import shlex
from pathlib import Path

import pytest

from torchrl_nerd.cli import main

NOTEBOOKS = sorted((Path(__file__).parents[1] / "docs").rglob("*.ipynb"))

each_notebook = pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda p: p.stem)


def code_cells(path: Path) -> list[dict]:
    cells = json.loads(path.read_text())["cells"]
    return [cell for cell in cells if cell["cell_type"] == "code"]


@each_notebook
def test_nothing_but_what_was_written_is_stored(path):
    content = json.loads(path.read_text())
    assert (content["nbformat"], content["nbformat_minor"]) == (4, 5)
    identities = [cell["id"] for cell in content["cells"]]
    assert len(identities) == len(set(identities)) > 5
    for cell in code_cells(path):
        assert cell["outputs"] == [] and cell["execution_count"] is None


@each_notebook
def test_every_cell_runs(path, monkeypatch, tmp_path, capsys):
    """In order, in one namespace; ``!nerd`` is the command itself."""
    monkeypatch.chdir(tmp_path)
    names: dict[str, object] = {"__name__": "__main__"}
    for cell in code_cells(path):
        source = "".join(cell["source"])
        if source.startswith("!"):
            program, *argv = shlex.split(source[1:])
            assert program == "nerd" and main(argv) == 0
        else:
            exec(compile(source, path.name, "exec"), names)
    said = capsys.readouterr()
    assert "nan" not in said.out and len(said.out.splitlines()) > 5


def test_there_are_some():
    assert {path.stem for path in NOTEBOOKS} >= {"first_policy", "own_robot"}
