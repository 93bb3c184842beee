"""Pages of the reference that are made of the code: a hook of MkDocs, see mkdocs.yml.

One page per folder of the package, for mkdocstrings, and one of every command's ``--help``.
"""

import io
import os
import pkgutil
from contextlib import redirect_stdout
from importlib import import_module
from pathlib import Path

from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import File, Files

PACKAGE = Path(__file__).parents[1] / "torchrl_nerd"
TITLES = {
    "envs": "Envs",
    "dynamics": "Dynamics",
    "analytic": "Analytic steps",
    "modules": "Learned models",
    "transforms": "Transforms",
    "scenes": "Scenes",
    "robots": "Robots",
    "tasks": "Tasks",
    "data": "Data",
    "training": "Training",
    "evaluation": "Evaluation",
    "geometry": "Geometry",
}
"""Folder of the package -> title of its page."""
WIDTH = 88  # columns of a command's help


def modules(folder: str) -> list[str]:
    """Dotted names of the modules of a folder, its own folders after its files.

    Robots are named by their folders, hard cases of the stability command not at all.
    """
    found, later = [], []
    for module in pkgutil.iter_modules([str(PACKAGE / folder)]):
        if module.name in ("cases", "__main__"):
            continue
        name = f"{folder}/{module.name}"
        if module.ispkg:
            later += modules(name)
        else:
            found.append(f"torchrl_nerd.{name.replace('/', '.')}")
    return found + later


def reference(folder: str) -> str:
    """The page of a folder: its first sentence, then every module."""
    about = (import_module(f"torchrl_nerd.{folder}").__doc__ or "").splitlines()[0]
    parts = [f"# {TITLES[folder]}", about]
    parts += [f"::: {name}" for name in modules(folder)]
    return "\n\n".join(parts) + "\n"


def command_line() -> str:
    """The page of every command, as its ``--help`` shows it."""
    from torchrl_nerd.cli import COMMANDS, main

    os.environ["COLUMNS"] = str(WIDTH)
    parts = [
        "# Command line",
        "Bad input gives one sentence on the error stream and exit status 2. `--dry-run` "
        "prints what a command would do, and all its settings. `--json FILE` writes "
        "results with command, commit, machine and seed.",
    ]
    for name in COMMANDS:
        shown = io.StringIO()
        try:
            with redirect_stdout(shown):
                main([name, "--help"])
        except SystemExit:
            pass
        text = "\n".join(line.rstrip() for line in shown.getvalue().splitlines())
        parts += [f"## nerd {name}", f"```text\n{text.strip()}\n```"]
    return "\n\n".join(parts) + "\n"


def pages() -> dict[str, str]:
    """Path of every generated page -> its Markdown."""
    found = {f"reference/{folder}.md": reference(folder) for folder in TITLES}
    return {**found, "reference/cli.md": command_line()}


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """The pages beside those that are written by hand."""
    for name, content in pages().items():
        files.append(File.generated(config, name, content=content))
    return files
