"""A disk that is full or read-only: one sentence, and what was there stays as it was."""

import json
import os
import subprocess
import sys
import tempfile
from pathlib import Path

import pytest

KINDS = ("checkpoint", "data", "training", "policy")
HOWS = ("limited", "full", "locked")
SCRIPT = """
import json, os, resource, subprocess, sys
from pathlib import Path
from file_kinds import *
from file_kinds import _trainer
from fuzz_files import in_child

def write(kind, folder):
    scene = load_scene(SCENE)
    if kind == "checkpoint":
        model = NeRD(scene, NO_PREDICTIONS, NETWORKS["transformer-2x64"])
        return lambda: save_checkpoint(model, folder, make_card(model))
    if kind == "data":
        config = DataConfig(trajectories=100, steps=100, seed=1)
        return lambda: generate(scene, config, folder / "new", quiet=True)
    if kind == "training":
        return _trainer(folder).save
    return lambda: save_policy(Policy((5, 64, 64, 1)), folder)

def limited(folder):
    resource.setrlimit(resource.RLIMIT_FSIZE, (1024, 1024))

def full(folder):
    with open(folder / "filler", "wb", buffering=0) as file:
        try:
            while file.write(bytes(1024)):
                pass
        except OSError:
            pass

def locked(folder):
    for path in (folder, *folder.rglob("*")):
        path.chmod(0o555 if path.is_dir() else 0o444)
    if not os.geteuid():
        os.seteuid(65534)  # root may write anywhere

def attempt(how, kind, folder):
    KINDS[kind].make(folder)
    work = write(kind, folder)
    before = {p: p.read_bytes() for p in folder.rglob("*") if p.is_file()}
    globals()[how](folder)
    try:
        work()
        yield "written"
    except ValueError as error:
        yield str(error)
    changed = [str(p) for p, content in before.items() if p.read_bytes() != content]
    yield ", ".join(changed + [str(p) for p in folder.rglob("*.tmp")])

said = {}
root = Path(sys.argv[1])
for how in sys.argv[2].split():
    for kind in sys.argv[3].split():
        folder = root / how / kind
        folder.mkdir(parents=True)
        mount = ["mount", "-t", "tmpfs", "-o", "size=4m", "tmpfs", str(folder)]
        if how == "full" and subprocess.run(mount, capture_output=True).returncode:
            continue
        said[f"{how} {kind}"] = in_child(lambda: attempt(how, kind, folder))
        if how == "full":
            subprocess.run(["umount", str(folder)], check=True)
print(json.dumps(said))
"""
TOOLS, ROOT = Path(__file__).parent / "tools", Path(__file__).parents[1]


@pytest.fixture(scope="module")
def said() -> dict[str, list[str]]:
    """By how and kind, the sentence of each attempt to write, and which files changed."""
    with tempfile.TemporaryDirectory() as root:
        os.chmod(root, 0o755)
        done = subprocess.run(
            [sys.executable, "-c", SCRIPT, root, " ".join(HOWS), " ".join(KINDS)],
            capture_output=True,
            text=True,
            env={**os.environ, "PYTHONPATH": f"{TOOLS}:{ROOT}"},
        )
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout)


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("how", HOWS)
def test_what_cannot_be_written_is_one_sentence(how, kind, said):
    if f"{how} {kind}" not in said:
        pytest.skip("no tmpfs may be mounted here")
    sentence, changed = said[f"{how} {kind}"]
    assert "written" in sentence and sentence != "written", sentence
    assert len(sentence.splitlines()) == 1 and not changed
    cause = {"limited": "large", "full": "No space left", "locked": "denied"}[how]
    assert cause in sentence
