"""What the documentation says exists: links, commands, names, examples."""

import doctest
import importlib
import inspect
import io
import os
import pkgutil
import re
import shlex
import subprocess
import sys
from contextlib import redirect_stdout
from importlib.util import find_spec
from itertools import pairwise
from pathlib import Path
from shutil import copyfile

import equal_error
import pytest
import stability_table
import torch
from helpers import EXCERPT
from tensordict import TensorDict

import torchrl_nerd
from torchrl_nerd import load_scene
from torchrl_nerd.cli import COMMANDS, main
from torchrl_nerd.evaluation.policy import Policy, save_policy
from torchrl_nerd.robots import TASKS, make_task

ROOT = Path(__file__).parents[1]
PAGES = [*ROOT.glob("*.md"), *sorted((ROOT / "docs").rglob("*.md"))]
CODE = re.compile(r"^```(\w*)\n(.*?)^```", re.M | re.S)
RUN = [ROOT / "docs" / name for name in ("start.md", "drop_ins.md", "stability.md")]
RUN += sorted((ROOT / "docs" / "howto").glob("*.md"))
PACKAGES = [
    "torchrl_nerd",
    *(f"torchrl_nerd.{m.name}" for m in pkgutil.iter_modules(torchrl_nerd.__path__)),
]
SOURCES = sorted(Path(torchrl_nerd.__file__).parent.rglob("*.py"))
WITH_EXAMPLES = [path for path in SOURCES if ">>> " in path.read_text()]
SHARED = {"load_scene": load_scene, "torch": torch, "TensorDict": TensorDict}
"""What examples take for granted."""

BUDGETS = {
    "data": "--trajectories 300 --steps 20 --quiet",
    "train": "--network mlp-4x64 --steps 2 --rollout-steps 1 --batch-size 16 "
    "--sequence-length 2 --rollout-batch-size 2 --rollout-length 2 --quiet",
    "eval": "--rows 2 --quiet",
    "finetune": "--epochs 1 --quiet",
    "transfer": "--episodes 2 --quiet",
    "play": "--steps 3 --draw drawing --quiet",
    "plot": "--rows 2 --steps 3",
    "bench": "--batches 1 --rows 2 --rounds 1 --steps 2 --no-compile --quiet",
    "stability": "--cases batching --quiet",
    "doctor": "--quiet",
}
"""What commands of the pages get instead of, or beside, their own options."""


def slow_page(page: Path):
    """A page for `pytest.mark.parametrize`, slow where its code takes long."""
    marks = [pytest.mark.slow] * (page.stem in ("pipelines", "drop_ins"))
    return pytest.param(page, marks=marks, id=page.stem)


def prose(page: Path) -> str:
    """A page without its code."""
    return re.sub(r"`[^`\n]*`", "", CODE.sub("", page.read_text()))


def blocks(page: Path, *languages: str) -> list[str]:
    return [code for kind, code in CODE.findall(page.read_text()) if kind in languages]


def anchors(page: Path) -> set[str]:
    """Names of a page's headings, as links have them."""
    titles = re.findall(r"^#+ (.+)$", CODE.sub("", page.read_text()), re.M)
    plain = (re.sub(r"[^\w\s-]", "", title.lower()) for title in titles)
    return {re.sub(r"[\s-]+", "-", title).strip("-") for title in plain}


def leads_somewhere(page: Path, link: str) -> bool:
    """Whether a relative link is to a file, and to a heading if it names one."""
    path, _, anchor = link.partition("#")
    target = (page.parent / path).resolve() if path else page
    if not target.is_file() or not target.is_relative_to(ROOT):
        return False
    return not anchor or anchor in anchors(target)


def test_every_relative_link_leads_somewhere():
    links = [
        (page, link)
        for page in PAGES
        for link in re.findall(r"\]\(([^)\s]+)\)", prose(page))
        if "://" not in link
    ]
    assert len(links) > 50
    dead = [f"{p.name}: {link}" for p, link in links if not leads_somewhere(p, link)]
    assert not dead


def commands(page: Path) -> list[list[str]]:
    """Words of every line of a page's shell blocks."""
    lines = "\n".join(blocks(page, "sh")).replace("\\\n", " ").splitlines()
    return [shlex.split(line, comments=True) for line in lines]


def gives_commands(page: Path) -> bool:
    """Whether a page shows a command of the package."""
    return any(words[:1] == ["nerd"] for words in commands(page))


WITH_COMMANDS = [page for page in PAGES if gives_commands(page)]


@pytest.mark.parametrize("page", WITH_COMMANDS, ids=lambda p: p.name)
def test_every_command_can_be_given(page, tmp_path, monkeypatch, capsys):
    """Dry: of what it reads, the recorded tosses and policies alone must be there."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(torch.cuda, "device_count", lambda: 1)
    for words in commands(page):
        if words[:1] != ["nerd"]:
            continue
        for name in (word for word in words if word.endswith(".npz")):
            copyfile(EXCERPT, name)
        for option, folder in pairwise(words):
            if option == "--policy":
                scene = words[2] if words[1] == "data" else "ant"
                name = next(name for name in TASKS if name.startswith(f"{scene}/"))
                task = make_task(name)
                sizes = [task.observation_size, task.controller.num_actions]
                save_policy(Policy(sizes), Path(folder), {"task": name})
        assert main([*words[1:], "--dry-run"]) == 0, capsys.readouterr().err


@pytest.mark.slow
@pytest.mark.parametrize("page", ["docs/start.md", "docs/howto/robot.md", "README.md"])
def test_a_new_users_commands_work_one_after_the_other(
    page, tmp_path, monkeypatch, capsys
):
    """From an empty folder, with tiny budgets."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(str(ROOT / "examples"))
    copyfile(EXCERPT, "cube_tosses.npz")
    ran = 0
    for words in commands(ROOT / page):
        if words == ["make", "demo"]:
            ppo = importlib.import_module("ppo")
            sizes = {"num_envs": 8, "horizon": 4, "total_frames": 32}
            ppo.main(ppo.Run(episodes=2, **sizes))
        elif words[:1] == ["nerd"]:
            if words[1] == "train":  # else it draws all that the preset asks for
                fine = [w for w in words if w in ("--reference", "rk4")]
                assert main(within_budget(["data", words[2], *fine])) == 0
            assert main(within_budget(words[1:])) == 0, capsys.readouterr().err
            ran += 1
    assert ran > 3


def within_budget(words: list[str]) -> list[str]:
    """A command with its budget in place of its own numbers."""
    budget, command = BUDGETS[words[0]].split(), list(words)
    while budget:
        option, value = budget.pop(0), []
        if budget and not budget[0].startswith("--"):
            value = [budget.pop(0)]
        if option in command:
            command[command.index(option) + 1] = value[0]
        else:
            command += [option, *value]
    return command


def help_of(command: str) -> str:
    """What a command says of its options."""
    said = io.StringIO()
    with pytest.raises(SystemExit), redirect_stdout(said):
        main([command, "--help"])
    return said.getvalue()


def test_every_option_that_is_named_exists():
    """In `code` amid the text, where commands are cut short."""
    unknown, known = [], {name: help_of(name) for name in COMMANDS}
    for page in PAGES:
        for name, options in re.findall(r"`nerd ([a-z]+)([^`]*)`", page.read_text()):
            unknown += [
                f"{page.name}: nerd {name} {option}"
                for option in re.findall(r"--[a-z0-9-]+", options)
                if not re.search(rf"{option}(?![\w-])", known.get(name, ""))
            ]
    assert not unknown


def is_there(page: Path, name: str) -> bool:
    """Whether a page names a file of the repository, from its root or the package."""
    if "NAME" in name or "SCENE" in name or name.startswith(("runs/", "results/")):
        return True
    places = (ROOT / name, ROOT / "torchrl_nerd" / name, page.parent / name)
    return any(place.exists() for place in places)


def test_every_file_that_is_named_is_there():
    pattern = r"`((?:[\w.-]+/)+[\w-]+\.(?:py|md|json|png))`"
    named = [(p, name) for p in PAGES for name in re.findall(pattern, p.read_text())]
    assert named
    assert not [f"{p.name}: {name}" for p, name in named if not is_there(p, name)]


@pytest.mark.parametrize("page", [slow_page(page) for page in RUN])
def test_code_of_the_pages_runs(page, monkeypatch, tmp_path, capsys):
    monkeypatch.chdir(tmp_path)
    names = {"__name__": "__main__"}  # a page's blocks follow on each other
    for code in blocks(page, "python"):
        exec(compile(code, page.name, "exec"), names)
    assert not list(tmp_path.iterdir())


def test_code_of_every_page_can_be_read():
    for page in PAGES:
        for code in blocks(page, "python"):
            compile(code, page.name, "exec")


def test_every_public_name_says_what_it_is():
    for name in PACKAGES:
        module = importlib.import_module(name)
        assert module.__doc__, name
        for public in getattr(module, "__all__", []):
            value = getattr(module, public)
            if inspect.isclass(value) or inspect.isfunction(value):
                assert inspect.getdoc(value), f"{name}.{public}"


def test_every_public_name_is_in_the_reference():
    pages = "".join(p.read_text() for p in (ROOT / "docs" / "reference").glob("*.md"))
    shown = re.findall(r"^::: ([\w.]+)$", pages, re.M)
    missing = []
    for name in PACKAGES:
        module = importlib.import_module(name)
        for public in getattr(module, "__all__", []):
            value = getattr(module, public)
            home = getattr(value, "__module__", name)
            if not any(
                part in (f"{name}.{public}", f"{home}.{public}")
                or getattr(sys.modules.get(part), public, None) is value
                for part in shown
            ):
                missing.append(f"{name}.{public}")
    assert not missing


@pytest.mark.parametrize("path", WITH_EXAMPLES, ids=lambda p: p.stem)
def test_examples_in_docstrings_run(path):
    parts = path.relative_to(ROOT).with_suffix("").parts
    name = ".".join(parts).removesuffix(".__init__")
    module = importlib.import_module(name)
    failed, tried = doctest.testmod(module, extraglobs=SHARED | vars(module))
    assert tried > 0 and failed == 0


def test_the_tables_of_hard_cases_are_what_was_measured():
    found = stability_table.read(ROOT / "docs" / "figures")
    page = (ROOT / "docs" / "stability.md").read_text()
    assert stability_table.graded(found) in page
    assert stability_table.informative(found) in page


def test_the_table_of_equal_error_is_what_was_measured():
    found = equal_error.read(ROOT / "docs" / "figures")
    page = (ROOT / "docs" / "performance.md").read_text()
    assert equal_error.table(found) in page


def test_the_site_shows_every_page_once():
    """Notebooks too, of which docs/notebooks.py makes pages."""
    nav, docs = (ROOT / "mkdocs.yml").read_text().split("\nnav:")[1], ROOT / "docs"
    named = re.findall(r": ([\w/]+\.md)$", nav, re.M)
    sources = [*docs.rglob("*.md"), *docs.rglob("*.ipynb")]
    there = [str(p.relative_to(docs).with_suffix(".md")) for p in sources]
    assert len(named) > 15 and sorted(named) == sorted(there)


@pytest.mark.slow
def test_the_site_builds_without_a_warning(tmp_path):
    if find_spec("mkdocs") is None:
        pytest.skip("no mkdocs: make docs")
    command = [
        sys.executable,
        "-m",
        "mkdocs",
        "build",
        "--strict",
        "-d",
        tmp_path / "s",
    ]
    env = {**os.environ, "NO_MKDOCS_2_WARNING": "1"}
    done = subprocess.run(command, cwd=ROOT, env=env, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    for page in (tmp_path / "s").rglob("*.html"):
        text = page.read_text()
        loaded = r'<(?:script|img)[^>]+src="https?:|<link[^>]+stylesheet[^>]+https?:'
        assert not re.search(loaded, text), f"{page.name} fetches something"
