"""What a user meets first: the built archives, the time of an import, no noise."""

import os
import subprocess
import sys
import sysconfig
import tarfile
from pathlib import Path
from venv import EnvBuilder

import pytest

ROOT = Path(__file__).parents[1]
PACKAGE = ROOT / "torchrl_nerd"
IMPORT_SECONDS = 2.0  # of processor time, beyond torchrl's own

START = """
import time, warnings
import torchrl
warnings.simplefilter("always")
begin = time.process_time()
import torchrl_nerd
print(time.process_time() - begin)
import torch
from tensordict import TensorDict
import torchrl_nerd.cli
from torchrl_nerd import load_scene
from torchrl_nerd.dynamics import DMControlDynamics
load_scene("dm_control/cartpole-swingup")
zero = torch.zeros(1, 2, dtype=torch.float64)
DMControlDynamics(load_scene("cartpole")).reset(TensorDict(qpos=zero, qvel=zero))
"""


def environment(**changes: str) -> dict[str, str]:
    """As on a server: no display, no choice of OpenGL."""
    dropped = ("DISPLAY", "WAYLAND_DISPLAY", "MUJOCO_GL", "PYTHONPATH")
    kept = {k: v for k, v in os.environ.items() if k not in dropped}
    return kept | changes


@pytest.fixture(scope="module")
def start() -> subprocess.CompletedProcess[str]:
    """A fresh process that imports everything and uses dm_control."""
    command, env = [sys.executable, "-c", START], environment(PYTHONPATH=str(ROOT))
    return subprocess.run(command, env=env, capture_output=True, text=True, check=True)


def test_the_import_adds_little_to_that_of_torchrl(start):
    assert float(start.stdout.split()[0]) < IMPORT_SECONDS


def test_nothing_is_said_of_a_missing_display(start):
    assert "GLFW" not in start.stderr


def test_no_warning_is_our_own(start):
    assert str(PACKAGE) not in start.stderr


@pytest.fixture(scope="module")
def dist(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Wheel and source archive of this tree."""
    folder = tmp_path_factory.mktemp("dist")
    command = [sys.executable, "-m", "hatchling", "build", "-d", folder]
    subprocess.run(command, cwd=ROOT, check=True, capture_output=True)
    return folder


def test_the_source_archive_holds_what_building_and_testing_need(dist):
    with tarfile.open(next(dist.glob("*.tar.gz"))) as archive:
        names = {name.partition("/")[2] for name in archive.getnames()}
    for path in PACKAGE.rglob("*"):
        if path.is_file() and "__pycache__" not in path.parts:
            assert path.relative_to(ROOT).as_posix() in names
    assert {"pyproject.toml", "README.md", "LICENSE", "Makefile"} <= names
    assert {"tests/conftest.py", "docs/start.md", "mkdocs.yml"} <= names
    outside = {".venv", "runs", "datasets", "site", ".git"}
    assert not outside & {name.partition("/")[0] for name in names}


@pytest.mark.slow
def test_the_wheel_works_in_an_environment_of_its_own(dist, tmp_path):
    """Installed without dependencies: those are the ones of this environment."""
    EnvBuilder(symlinks=True).create(tmp_path / "env")
    own = tmp_path / "env" / "bin" / "python"
    wheel = next(dist.glob("*.whl"))
    install = [sys.executable, "-m", "pip", "--python", own, "install", "--no-deps"]
    install += ["--no-index", "--ignore-installed", "--quiet", wheel]
    env = environment(PIP_DISABLE_PIP_VERSION_CHECK="1")
    subprocess.run(install, env=env, check=True, capture_output=True, cwd=tmp_path)
    version = f"python{sys.version_info[0]}.{sys.version_info[1]}"
    site = tmp_path / "env" / "lib" / version / "site-packages"
    (site / "rest.pth").write_text(sysconfig.get_path("purelib") + "\n")

    def run(*command: object) -> str:
        done = subprocess.run(
            command, env=env, cwd=tmp_path, capture_output=True, text=True
        )
        assert done.returncode == 0, done.stderr
        return done.stdout

    nerd = own.with_name("nerd")
    assert "play" in run(nerd, "--help")
    code = (
        "import torchrl_nerd as t; print(t.__file__);"
        "print(t.from_pretrained('cartpole').scene.name)"
    )
    path, name = run(own, "-c", code).split()
    assert Path(path).is_relative_to(site) and name == "cartpole"
    run(nerd, "play", "cartpole/swingup", "--steps", "3", "--quiet", "--out", "a.gif")
    assert (tmp_path / "a.gif").stat().st_size > 1000
