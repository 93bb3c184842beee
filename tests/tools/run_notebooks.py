"""Run the notebooks of the docs and store what their cells print.

    python tests/tools/run_notebooks.py

``!nerd`` is the command itself, in this process.
"""

import io
import json
import os
import shlex
import sys
import tempfile
from contextlib import redirect_stdout
from pathlib import Path
from typing import Any

NOTEBOOKS = sorted((Path(__file__).parents[2] / "docs").rglob("*.ipynb"))


def code_cells(notebook: dict[str, Any]) -> list[dict[str, Any]]:
    """Its cells of code, in order."""
    return [cell for cell in notebook["cells"] if cell["cell_type"] == "code"]


def run_cells(notebook: dict[str, Any]) -> list[str]:
    """What every cell of code prints, run in the current folder and one namespace."""
    from torchrl_nerd.cli import main

    names: dict[str, object] = {"__name__": "__main__"}
    printed = []
    for cell in code_cells(notebook):
        source, shown = "".join(cell["source"]), io.StringIO()
        with redirect_stdout(shown):
            if source.startswith("!"):
                program, *argv = shlex.split(source[1:])
                if program != "nerd" or main(argv) != 0:
                    raise RuntimeError(f"the command failed: {source}")
            else:
                exec(compile(source, "cell", "exec"), names)
        printed.append(shown.getvalue())
    return printed


def stored(cell: dict[str, Any]) -> str:
    """What is stored of a cell's output."""
    return "".join(line for output in cell["outputs"] for line in output["text"])


def with_outputs(notebook: dict[str, Any], printed: list[str]) -> dict[str, Any]:
    """The notebook with these outputs."""
    for number, (cell, text) in enumerate(
        zip(code_cells(notebook), printed, strict=True), 1
    ):
        lines = [line.rstrip() + "\n" for line in text.splitlines()]
        stream = {"name": "stdout", "output_type": "stream", "text": lines}
        cell["outputs"] = [stream] if lines else []
        cell["execution_count"] = number
    return notebook


if __name__ == "__main__":
    os.environ["COLUMNS"] = "88"
    for path in NOTEBOOKS:
        notebook = json.loads(path.read_text())
        with tempfile.TemporaryDirectory() as folder:
            os.chdir(folder)
            printed = run_cells(notebook)
            os.chdir("/")
        text = json.dumps(with_outputs(notebook, printed), indent=1, ensure_ascii=False)
        path.write_text(text + "\n")
        print(f"{path}: {len(printed)} cells", file=sys.stderr)
