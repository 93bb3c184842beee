"""What the documentation says exists: links, commands, names, examples, numbers."""

import doctest
import importlib
import inspect
import io
import json
import os
import pkgutil
import re
import shlex
import subprocess
import sys
from contextlib import redirect_stdout
from functools import cache
from importlib.util import find_spec
from pathlib import Path

import pytest
import tables as tables_hook
import torch
from tensordict import TensorDict

import torchrl_nerd
from torchrl_nerd import load_scene
from torchrl_nerd.checkpoint import shipped_card, shipped_models
from torchrl_nerd.envs.rendering import find_gl

ROOT = Path(__file__).parents[1]
DOCS, README = ROOT / "docs", ROOT / "README.md"
PAGES = sorted(DOCS.rglob("*.md"))
EXPERIMENTS = sorted((ROOT / "experiments").rglob("*.md"))
EVERYWHERE = [README, ROOT / "CONTRIBUTING.md", ROOT / "CHANGELOG.md", *PAGES]
CODE = re.compile(r"^```(\w*)\n(.*?)^```", re.M | re.S)
LINK = re.compile(r"!?\[([^\]]*)\]\(([^)\s]+)\)")
MAX_WORDS = 25  # of a sentence
MAX_ROW = 100  # characters of a table's row, links as they are shown
MAX_PAGE, MAX_README = 300, 130  # lines
PACKAGES = [
    "torchrl_nerd",
    *(f"torchrl_nerd.{m.name}" for m in pkgutil.iter_modules(torchrl_nerd.__path__)),
]
SOURCES = sorted(Path(torchrl_nerd.__file__).parent.rglob("*.py"))
WITH_EXAMPLES = [path for path in SOURCES if ">>> " in path.read_text()]
SHARED = {"load_scene": load_scene, "torch": torch, "TensorDict": TensorDict}
"""What examples take for granted."""

GENERATED = [
    "reference/cli.md",
    *(
        f"reference/{module.name}.md"
        for module in pkgutil.iter_modules(torchrl_nerd.__path__)
        if module.ispkg and module.name not in ("cli", "pretrained", "policies")
    ),
]
"""Pages that docs/generated.py makes: of each folder of the package, and of commands."""

RESULTS = {  # row of README -> scene, case, learned model
    "Cartpole": ("cartpole", "passive", "cartpole"),
    "double pendulum": ("double_pendulum", "terrain 1", "double_pendulum"),
    "Ant": ("ant", "passive", "ant"),
    "ANYmal": ("anymal", "standing", "anymal"),
    "Franka": ("franka", "random", "franka"),
    "cube": ("cube", "toss", "cube"),
}
QUANTITIES = {
    "cart position": "slider",
    "joint 1": "joint1",
    "joint 2": "joint2",
    "base position": "base_position",
}


def name_of(path: Path) -> str:
    return str(path.relative_to(ROOT))


def each(pages: list[Path]) -> pytest.MarkDecorator:
    return pytest.mark.parametrize("page", pages, ids=name_of)


def blocks(page: Path, language: str) -> list[str]:
    return [code for kind, code in CODE.findall(page.read_text()) if kind == language]


def prose(page: Path) -> str:
    """A page without its blocks of code."""
    return CODE.sub("", page.read_text())


def tables(page: Path) -> list[str]:
    """The rows of a page's tables, links as they are shown."""
    lines = prose(page).splitlines()
    return [LINK.sub(r"\1", line) for line in lines if line.startswith("|")]


def cells(row: str) -> list[str]:
    return [cell.strip() for cell in row.strip("|").split("|")]


def anchors(page: Path) -> set[str]:
    """Names of a page's headings, as links have them."""
    titles = re.findall(r"^#+ (.+)$", prose(page), re.M)
    plain = (re.sub(r"[^\w\s-]", "", title.lower()) for title in titles)
    return {re.sub(r"[\s-]+", "-", title).strip("-") for title in plain}


def sentences(page: Path) -> list[str]:
    """Sentences of paragraphs and list items, without tables, headings and code."""
    text = re.sub(r"^(\||#|    |<!--|>|!\[).*$", "", prose(page), flags=re.M)
    text = re.sub(r"`[^`]*`", "x", LINK.sub(r"\1", text))
    text = re.sub(r"^\s*(?:[-*]|\d+\.) ", "\n", text, flags=re.M)
    found = []
    for paragraph in re.split(r"\n\s*\n|:\n", text):
        found += re.split(r"(?<=[.:!?])\s+", " ".join(paragraph.split()))
    return found


# -- form ----------------------------------------------------------------------------------


@each([README, *PAGES])
def test_a_page_is_short(page):
    lines = len(page.read_text().splitlines())
    assert lines <= (MAX_README if page == README else MAX_PAGE)


@each([README, *PAGES])
def test_no_table_is_wider_than_the_page(page):
    assert [row for row in tables(page) if len(row) > MAX_ROW] == []


@each([README, *PAGES])
def test_every_row_of_a_table_has_as_many_cells_as_its_header(page):
    for table in re.findall(r"(?:^\|.*\n)+", prose(page), re.M):
        widths = {row.replace("\\|", "").count("|") for row in table.splitlines()}
        assert len(widths) == 1, table


@each([README, ROOT / "CONTRIBUTING.md", *PAGES])
def test_sentences_are_short(page):
    assert [s for s in sentences(page) if len(s.split()) > MAX_WORDS] == []


def test_readme_has_its_parts_in_order():
    text = README.read_text()
    parts = (
        "docs/figures/ant.gif",
        "make demo",
        "make test",
        "make_env",
        "`dynamics=`",
    )
    places = [text.index(part) for part in (*parts, "| robot |", "## Links")]
    assert places == sorted(places)


# -- links and names -----------------------------------------------------------------------


@each([*EVERYWHERE, *EXPERIMENTS])
def test_every_relative_link_leads_somewhere(page):
    """A page that is made of a notebook counts as the notebook."""
    text = re.sub(r"`[^`\n]*`", "", prose(page))
    for _, link in LINK.findall(text):
        if "://" in link:
            continue
        path, _, anchor = link.partition("#")
        target = (page.parent / path).resolve() if path else page
        there = target.is_file() or target.with_suffix(".ipynb").is_file()
        there = there or target in [DOCS / name for name in GENERATED]
        assert there and target.is_relative_to(ROOT), f"{page.name}: {link}"
        if anchor and target.suffix == ".md":
            assert anchor in anchors(target), f"{page.name}: {link}"


@each(EVERYWHERE)
def test_every_file_that_is_named_is_there(page):
    """Files of the repository in `code`, from its root or from the package."""
    pattern = r"`((?:[\w.-]+/)+[\w-]+\.(?:py|md|json|png|xml))`"
    for name in re.findall(pattern, page.read_text()):
        if re.search("[A-Z]{4}", name) or name.startswith(("runs/", "results/")):
            continue
        places = (ROOT / name, ROOT / "torchrl_nerd" / name, page.parent / name)
        assert any(place.exists() for place in places), f"{page.name}: {name}"


def test_the_site_shows_every_page_once():
    """Notebooks too, of which docs/notebooks.py makes pages."""
    nav = (ROOT / "mkdocs.yml").read_text().split("\nnav:")[1]
    named = re.findall(r": ([\w/]+\.md)$", nav, re.M)
    sources = [*PAGES, *DOCS.rglob("*.ipynb")]
    there = [str(p.relative_to(DOCS).with_suffix(".md")) for p in sources]
    assert sorted(named) == sorted([*there, *GENERATED])


# -- commands ------------------------------------------------------------------------------


@cache
def options_of(command: str) -> frozenset[str]:
    """Options of a command, as its ``--help`` names them."""
    from torchrl_nerd.cli import COMMANDS, main

    assert command in COMMANDS, f"no command nerd {command}"
    shown = io.StringIO()
    with redirect_stdout(shown), pytest.raises(SystemExit) as stop:
        main([command, "--help"])
    assert stop.value.code == 0
    return frozenset(re.findall(r"--[a-z0-9][a-z0-9-]*", shown.getvalue()))


@each(EVERYWHERE)
def test_every_command_and_option_exists(page):
    """In blocks of shell and in `code` amid the text."""
    shell = "\n".join(blocks(page, "sh")).replace("\\\n", " ").splitlines()
    found = [line for line in shell if line.startswith("nerd ")]
    found += re.findall(r"`(nerd [a-z]+[^`]*)`", prose(page))
    for line in found:
        words = shlex.split(line, comments=True)
        if not words[1:] or not words[1].islower():  # `nerd COMMAND`
            continue
        asked = {word.partition("=")[0] for word in words if word.startswith("--")}
        asked -= {"--help", "--version"}
        assert not asked - options_of(words[1]), f"{page.name}: {line}"


def test_every_make_target_exists():
    makefile = (ROOT / "Makefile").read_text()
    for page in EVERYWHERE:
        shell = "\n".join(blocks(page, "sh"))
        named = re.findall(r"^make ([\w-]+)", shell, re.M)
        named += re.findall(r"`make ([\w-]+)", prose(page))
        for target in named:
            assert re.search(rf"^{target}:|\b{target}\b.*:", makefile, re.M), target


# -- code ----------------------------------------------------------------------------------

FIRST = [page for page in PAGES if blocks(page, "python")]


@each([README, *FIRST])
def test_code_of_the_page_runs(page, monkeypatch, tmp_path, capsys):
    """Every block of README, the first one of other pages; all blocks compile."""
    monkeypatch.chdir(tmp_path)
    names = {"__name__": "__main__"}
    codes = [compile(code, page.name, "exec") for code in blocks(page, "python")]
    for code in codes if page == README else codes[:1]:
        exec(code, names)


def test_code_that_uses_it_from_elsewhere_runs(monkeypatch, tmp_path):
    """Every block, in one namespace; skrl's where it is installed."""
    if find_gl() is None:
        pytest.skip("no OpenGL library works on this machine")
    monkeypatch.chdir(tmp_path)
    names = {"__name__": "__main__"}
    for code in blocks(DOCS / "howto" / "using_it_from.md", "python"):
        if "skrl" in code and find_spec("skrl") is None:
            continue
        exec(compile(code, "using_it_from.md", "exec"), names)
    assert len(names["rollout"]) == 16
    assert len(list(tmp_path.rglob("*.mp4"))) == 2


@pytest.mark.slow
@each(FIRST)
def test_all_code_of_the_page_runs(page, monkeypatch, tmp_path, capsys):
    """In order, in one namespace."""
    monkeypatch.chdir(tmp_path)
    names = {"__name__": "__main__"}
    for code in blocks(page, "python"):
        exec(compile(code, page.name, "exec"), names)


@pytest.mark.parametrize("path", WITH_EXAMPLES, ids=lambda p: p.stem)
def test_examples_in_docstrings_run(path):
    parts = path.relative_to(ROOT).with_suffix("").parts
    name = ".".join(parts).removesuffix(".__init__")
    module = importlib.import_module(name)
    failed, tried = doctest.testmod(module, extraglobs=SHARED | vars(module))
    assert tried > 0 and failed == 0


# -- models --------------------------------------------------------------------------------


def test_the_gallery_has_every_shipped_model_under_its_kind():
    shown, kind = {}, ""
    for line in (DOCS / "gallery.md").read_text().splitlines():
        kind = line[3:].lower() if line.startswith("## ") else kind
        if found := re.match(r"\| `([\w-]+)`.*\|", line):
            shown[found[1]] = kind, line
    for name in shipped_models():
        card = shipped_card(name)
        kind, line = shown.pop(name)
        assert kind == card["kind"]
        if (network := card["network"]) is not None:
            kind = {"transformer": "transformer", "mlp": "MLP"}[network["kind"]]
            depth = network.get("layers") or network["depth"]
            assert f"{kind} {depth}x{network['width']}" in line
    assert not shown


# -- results -------------------------------------------------------------------------------


def readme_results() -> list[list[str]]:
    rows = [cells(row) for row in tables(README)]
    header = next(i for i, row in enumerate(rows) if row[0] == "robot")
    return rows[header + 2 : header + 8]


def test_readme_has_a_row_per_robot():
    assert [row[0] for row in readme_results()] == list(RESULTS)


def measured(scene: str, case: str, quantity: str, steps: int) -> dict[str, dict]:
    """Rows of results/eval_SCENE.json by name, and MuJoCo's best of 1 and 4 substeps."""
    record = json.loads((ROOT / "results" / f"eval_{scene}.json").read_text())
    rows = {
        row["name"]: row
        for row in record["results"]["errors"]
        if (row["case"], row["steps"], row["quantity"]) == (case, steps, quantity)
    }
    best = {}
    for count in ("1 substep", "4 substeps"):
        same = (row for name, row in rows.items() if name.endswith(f", {count}"))
        finite = (row for row in same if row["mean"] is not None)
        best[count] = min(finite, key=lambda row: row["mean"])
    return rows | best


@pytest.mark.parametrize("row", readme_results(), ids=lambda row: row[0])
def test_readme_s_results_are_what_was_measured(row):
    """Means to two digits."""
    robot, what, unit, network, *shown = row
    scene, case, model = RESULTS[robot]
    quantity, steps = what.rsplit(", ", 1)
    errors = measured(scene, case, QUANTITIES[quantity], int(steps))
    named = [model, "analytic", "1 substep", "4 substeps", "paper (NeRD)"]
    assert shown == [f"{errors[n]['mean']:.2g}" if n in errors else "-" for n in named]
    assert unit == errors[model]["unit"] and errors[model]["kind"] == "learned"
    card = shipped_card(model)
    assert card["network"]["kind"] == network.lower()


def test_readme_s_error_of_the_hybrid_is_what_was_measured():
    mean = measured("double_pendulum", "terrain 1", "joint2", 100)[
        "double_pendulum-hybrid"
    ]["mean"]
    assert f"has an error of {mean:.2g} rad" in README.read_text()


ANTS = {  # row of README -> names in bench_ant.json and in time_to_policy_ant_run.json
    '`"ant-mlp"`': ("ant-mlp, compiled", "ant-mlp"),
    '`"nerd"`, which is `"ant"`': ("ant, compiled", "ant"),
    '`"analytic"`': ("analytic, compiled", "analytic"),
    '`"mujoco"`, its own 16 substeps': ("MuJoCo Euler, 16 substeps", "mujoco"),
    "MuJoCo with 4 substeps": ("MuJoCo Euler, 4 substeps", "mujoco-4"),
}


def test_readme_s_rates_of_the_ant_are_what_was_measured():
    """Thousands of control steps per second, m, and minutes to the return wanted."""
    bench, learned = (
        json.loads((ROOT / "results" / f"{name}.json").read_text())["results"]
        for name in ("bench_ant", "time_to_policy_ant_run")
    )
    rates = {x["name"]: x["steps_per_s"] for x in bench["rates"] if x["batch"] == 512}
    errors = {
        x["name"]: x["mean"]
        for x in bench["errors"]
        if x["quantity"] == "base_position"
    }
    rows = {row[0]: row[1:] for row in map(cells, tables(README)) if row[0] in ANTS}
    assert rows == {
        row: [
            f"{round(rates[name], -3):,.0f}",
            f"{errors[name]:.3f}",
            f"{learned['seconds'][dynamics] / 60:.1f}",
        ]
        for row, (name, dynamics) in ANTS.items()
    }


def test_tables_of_the_site_are_rendered_from_results(tmp_path):
    entry = {"case": "passive", "steps": 100, "kind": "learned", "unit": "m"}
    errors = [
        {**entry, "name": name, "quantity": quantity, "mean": mean}
        for name, mean in (("a", 0.12345), ("b", float("inf")))
        for quantity in ("x", "y", "z", "w")
    ]
    machine = {"processor": "CPU", "threads": 1, "mujoco": "3.17.0"}
    record = {
        "command": "nerd eval r",
        "commit": "0" * 40,
        "seed": 1,
        "machine": machine,
    }
    rate = {"name": "a", "batch": 512, "steps_per_s": 12345.6}
    earned = {"dynamics": "nerd", "kind": "learned", "mean": 9.96, "difference": -0.02}
    earned |= {"difference_interval": 0.01}
    chain = {"scene": "ant", "library": "own", "compiled": True}
    checked = {key: {"x": 0.12345} for key in ("cpu_float32", "float32", "bf16_inside")}
    precise = {"steps": 5, "float64": {"x": 0.1}, "float32": {"x": 0.2}}
    precise |= {"float64_us": 3.0, "float32_us": 1.5}
    chain |= {"positions_ms": 0.123, "with_velocities_ms": 1.5}
    fell = {"passes": False, "tolerances": {"lowest, m": 0.01}}
    fell |= {"tested": {"lowest, m": 0.25}, "ground_truth": {"lowest, m": 0.002}}
    robot = {"source": "suite", "robot": "dog"}
    loaded = {"source": "suite", "robot": "cat", "loads": True, "contact_points": 5}
    loaded |= {"contact_error_m": 0.0021, "difference": 0.0, "dropped": 0.04}
    loaded |= {"speed_p99": {"rad_per_s": 12.0}}
    for name, results in (
        ("eval_robot", {"errors": errors}),
        ("bench_robot", {"errors": errors, "rates": [rate], "steps": 100}),
        ("stability_robot", {"model": "robot-mlp", "kind": "learned", "drop": fell}),
        ("kinematics_libraries", [chain]),
        (
            "transfer_franka_reach_osc_x",
            {"task": "t", "policy": "runs/p", "returns": [earned]},
        ),
        ("state_dtype", {"ant": precise}),
        ("robots_that_load", [loaded, {**robot, "loads": False, "why": "b: muscles"}]),
        (
            "gpu/b_rates",
            {"items": {"tiny streaming, graph, 512": {"steps_per_s": 2e6}}},
        ),
        ("gpu/c_mjx_rates", {"items": {"MJX ant, 4096": {"steps_per_s": 5e4}}}),
        ("gpu/a_correctness", {"items": {"model a": checked}}),
    ):
        path = tmp_path / f"{name}.json"
        path.parent.mkdir(exist_ok=True)
        path.write_text(json.dumps({**record, "results": results}))
    page = "\n".join(f"<!-- table: {name} -->" for name in tables_hook.TABLES)
    shown = tables_hook.render(page, tmp_path)
    assert "| a | learned | 0.12 | 0.12 | 0.12 |" in shown
    assert "| b | learned | diverges | diverges | diverges |" in shown
    assert "| a | learned | 0.12 | 0.12 | 0.12 | 12,346 |" in shown
    assert "| drop | **fail** |" in shown
    assert "| robot-mlp | drop | lowest, m | 0.25 | 0.002 | 0.01 |" in shown
    assert "| t, p | nerd | learned | 9.96 | -2 ± 1 |" in shown
    assert "| ant | own | compiled | 0.12 | 1.5 |" in shown
    assert "| tiny | graph | 2 | - |" in shown and "| ant | MJX | - | 0.05 |" in shown
    assert "| ant | x, 5 | 0.1 | 0.2 | 3.0 | 1.5 |" in shown
    assert "| a | x | 0.123 | 0.123 | 0.123 |" in shown
    assert "| suite | 2 | 1 |" in shown and "- suite: dog: muscles." in shown
    assert "**suite**" in shown and "| cat | 5 | 2.1 mm | 0 | 4% | 12 |" in shown
    assert "not measured" in tables_hook.render(page, tmp_path / "nowhere")


def test_numbers_have_two_digits_and_no_power_of_ten_that_a_reader_must_count():
    values = 0.01234, 99.4, 128.26, 2149.0, float("inf"), None
    shown = [tables_hook.number(value) for value in values]
    assert shown == ["0.012", "99", "130", "2,100", "diverges", "-"]


@each(PAGES)
def test_a_page_asks_for_tables_that_exist(page):
    asked = re.findall("<!-- table: (.*) -->", page.read_text())
    assert set(asked) <= tables_hook.TABLES.keys()


# -- reference -----------------------------------------------------------------------------


def test_every_public_name_is_described():
    for name in PACKAGES:
        module = importlib.import_module(name)
        assert module.__doc__, name
        for public in getattr(module, "__all__", []):
            value = getattr(module, public)
            if inspect.isclass(value) or inspect.isfunction(value):
                assert inspect.getdoc(value), f"{name}.{public}"


def test_everything_that_the_reference_names_exists():
    pages = "".join(page.read_text() for page in PAGES)
    names = re.findall(r"^::: ([\w.]+)$", pages, re.M)
    assert names and all(find_spec(name) for name in names)


@pytest.mark.slow
def test_the_site_builds_without_a_warning(tmp_path):
    if find_spec("mkdocs") is None:
        pytest.skip("no mkdocs: make docs")
    command = [sys.executable, "-m", "mkdocs", "build", "--strict", "-d"]
    env = {**os.environ, "NO_MKDOCS_2_WARNING": "1"}
    site = tmp_path / "s"
    done = subprocess.run(
        [*command, site], cwd=ROOT, env=env, capture_output=True, text=True
    )
    assert done.returncode == 0, done.stderr
    for page in site.rglob("*.html"):
        text = page.read_text()
        loaded = r'<(?:script|img)[^>]+src="https?:|<link[^>]+stylesheet[^>]+https?:'
        assert not re.search(loaded, text), f"{page.name} fetches something"
