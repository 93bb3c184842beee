"""What the documentation shows is run."""

import re
from pathlib import Path

import pytest

DOCS = Path(__file__).parents[1] / "docs"
SNIPPET = re.compile(r"```python\n(.*?)```", re.DOTALL)


@pytest.mark.parametrize("page", ["drop_ins.md"])
def test_snippets_run_from_the_first_to_the_last(page, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    snippets, names = SNIPPET.findall((DOCS / page).read_text()), {}
    assert snippets
    for snippet in snippets:
        exec(compile(snippet, page, "exec"), names)
