"""Killed at random times, nothing is lost beyond the last interval; see the tool."""

import subprocess
import sys
from pathlib import Path

import pytest

from torchrl_nerd.files import read_json

TOOLS = Path(__file__).parent / "tools"


# Fixed moments are in data/test_resume.py and training/test_resume.py.
@pytest.mark.slow
@pytest.mark.parametrize("kills", [1, 100])
def test_nothing_is_lost(kills, seed, tmp_path):
    command = [sys.executable, "kill_trials.py", "--kills", str(kills)]
    results = tmp_path / "kills.json"
    subprocess.run(
        [*command, "--seed", str(seed), "--json", results], check=True, cwd=TOOLS
    )
    rows = read_json(results)["kinds"]
    assert sum(row["kills"] for row in rows.values()) == kills
    for name, row in rows.items():
        assert row["equal"] == row["kills"], f"{name}: {row}"
        assert not row["losses"] and not row["corrupt"] and not row["left over"], name
