"""Files of results: one schema, kept by every file that is committed."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest
from helpers import slow_but

from torchrl_nerd import __version__
from torchrl_nerd.evaluation.results import (
    KEYS,
    commit,
    make_record,
    read_results,
    write_results,
)

RESULTS = Path(__file__).parents[2] / "results"
CUBE = RESULTS.parent / "experiments" / "measured_cube" / "results"
FILES = sorted((*RESULTS.rglob("*.json"), *CUBE.glob("*.json")))


@pytest.mark.parametrize("path", FILES, ids=lambda p: p.stem)
def test_every_committed_file_keeps_the_schema(path):
    record = read_results(path)
    assert set(record) >= set(KEYS) and record["results"]
    assert record["command"].split()[0] in ("nerd", "python", "make"), path.name
    assert "/tmp" not in record["command"] and len(record["commit"]) >= 5


def test_there_is_nothing_but_results():
    assert {path.suffix for path in RESULTS.rglob("*") if path.is_file()} <= {".json"}


def test_what_is_written_is_read(tmp_path):
    path = tmp_path / "new" / "some.json"
    results = {"errors": [{"mean": 0.5}]}
    write_results(path, results, seed=3, command="nerd eval cartpole")
    record = read_results(path)
    assert record["results"] == results and record["seed"] == 3
    assert record["command"] == "nerd eval cartpole" and record["commit"] == commit()
    assert record["machine"]["threads"] >= 1 and record["machine"]["mujoco"]


def test_a_script_names_its_own_command(monkeypatch):
    words = [
        "/some/where/experiments/try.py",
        "ant",
        "--json",
        "/tmp/x.json",
        "--rows",
        "3",
    ]
    monkeypatch.setattr("sys.argv", words)
    assert make_record([])["command"] == "python experiments/try.py ant --rows 3"
    words[0] = str(CUBE.parent / "curves.py")
    monkeypatch.setattr("sys.argv", words[:2])
    named = "python experiments/measured_cube/curves.py ant"
    assert make_record([])["command"] == named
    words[0] = "/some/where/experiments/try.py"
    monkeypatch.setattr("sys.argv", [*words[:2], "--json=/tmp/x.json", *words[4:]])
    assert make_record([])["command"] == "python experiments/try.py ant --rows 3"


def test_a_package_in_another_projects_folder_has_a_version_alone(
    tmp_path, monkeypatch
):
    """As one that is installed in an environment inside of a repository."""
    git = ["git", "-c", "user.name=a", "-c", "user.email=a@b.c"]
    for words in (["init", "-q"], ["commit", "-qm", "theirs", "--allow-empty"]):
        subprocess.run([*git, *words], cwd=tmp_path, check=True)
    copy = tmp_path / "results.py"
    copy.touch()
    assert len(commit()) >= 40
    monkeypatch.setattr("torchrl_nerd.evaluation.results.__file__", str(copy))
    assert commit() == __version__


@pytest.mark.parametrize("name", slow_but(["study.part"], ["study", "study.part"]))
def test_a_module_names_its_own_command(name, tmp_path):
    (tmp_path / "study").mkdir()
    code = "from torchrl_nerd.evaluation.results import script_command as x; print(x())"
    for file in ("__main__", "part"):
        (tmp_path / "study" / f"{file}.py").write_text(code)
    words = [sys.executable, "-m", name, "ant", "--json", "x.json", "--rows", "3"]
    env = {**os.environ, "PYTHONPATH": str(Path(__file__).parents[2])}
    done = subprocess.run(words, cwd=tmp_path, env=env, capture_output=True, text=True)
    assert done.stdout == f"python -m {name} ant --rows 3\n", done.stderr


@pytest.mark.parametrize("key", KEYS)
def test_what_is_missing_or_of_another_type_is_named(key, tmp_path):
    record = make_record({"errors": []}, 3, "nerd eval cartpole")
    path = tmp_path / "y.json"
    path.write_text(json.dumps({k: v for k, v in record.items() if k != key}))
    with pytest.raises(ValueError, match=f"y.json: expected keys .* no '{key}'"):
        read_results(path)
    path.write_text(json.dumps(record | {key: 0.5}))
    with pytest.raises(ValueError, match=f"y.json: expected '{key}' of type"):
        read_results(path)
