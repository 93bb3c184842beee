"""Notebooks of the tutorials as pages: a hook of MkDocs, see mkdocs.yml."""

import json
import re
from pathlib import PurePosixPath
from typing import Any

from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import File, Files


def as_markdown(notebook: str, own: str) -> str:
    """The cells in order, each with its stored output; ``!`` commands as commands.

    Links to other notebooks lead to their pages; to its ``own`` file, to that file.
    """
    parts = []
    for cell in json.loads(notebook)["cells"]:
        text = "".join(cell["source"])
        if cell["cell_type"] == "code":
            is_shell = text.startswith("!")
            language = "sh" if is_shell else "python"
            text = f"```{language}\n{text.removeprefix('!')}\n```"
            printed = "".join(line for out in cell["outputs"] for line in out["text"])
            text += f"\n\n```text\n{printed}```" if printed else ""
        parts.append(text)
    page = "\n\n".join(parts)
    return re.sub(rf"\((?!{re.escape(own)}\))(\S+)\.ipynb\)", r"(\1.md)", page)


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """A page beside every notebook, which stays there to be downloaded."""
    for file in list(files):
        if file.src_uri.endswith(".ipynb"):
            page = as_markdown(file.content_string, PurePosixPath(file.src_uri).name)
            name = file.src_uri.replace(".ipynb", ".md")
            files.append(File.generated(config, name, content=page))
    return files


def on_page_markdown(markdown: str, **_: Any) -> str:
    """Links to notebooks, which work in the repository, lead to their pages on the site."""
    return re.sub(r"(tutorials/\w+)\.ipynb\)", r"\1.md)", markdown)
