"""What a user gets from the wheel, and that every file tells the same version."""

import os
import re
import subprocess
import sys
from pathlib import Path
from shutil import copyfile
from zipfile import ZipFile

import pytest

import torchrl_nerd

ROOT = Path(__file__).parents[1]
PACKAGE = ROOT / "torchrl_nerd"


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> ZipFile:
    """The wheel of this tree."""
    folder = tmp_path_factory.mktemp("dist")
    command = [sys.executable, "-m", "hatchling", "build", "-t", "wheel", "-d", folder]
    subprocess.run(command, cwd=ROOT, check=True, capture_output=True)
    return ZipFile(next(folder.glob("*.whl")))


def read(wheel: ZipFile, name: str) -> str:
    """A file of the wheel's ``.dist-info`` folder."""
    ending = f".dist-info/{name}"
    path = next(path for path in wheel.namelist() if path.endswith(ending))
    return wheel.read(path).decode()


def test_wheel_holds_every_file_of_the_package(wheel):
    source = {
        path.relative_to(ROOT).as_posix()
        for path in PACKAGE.rglob("*")
        if path.is_file() and "__pycache__" not in path.parts
    }
    packed = {path for path in wheel.namelist() if ".dist-info/" not in path}
    assert packed == source
    assert "torchrl_nerd/py.typed" in packed
    assert any(re.fullmatch(r"torchrl_nerd/robots/\w+/\w+\.xml", p) for p in packed)


def test_every_shipped_model_is_small_and_complete(wheel):
    sizes = {
        Path(info.filename).relative_to("torchrl_nerd/pretrained"): info.file_size
        for info in wheel.infolist()
        if info.filename.startswith("torchrl_nerd/pretrained/")
    }
    models = {path.parent for path in sizes}
    assert models
    for model in models:
        assert model / "card.json" in sizes
        is_simple = model.name.startswith(("cartpole", "double_pendulum"))
        limit = 2_000_000 if is_simple else 4_000_000  # bytes
        assert 0 < sizes[model / "model.safetensors"] < limit


def test_wheel_installs_the_nerd_command_and_the_licence(wheel):
    assert "nerd = torchrl_nerd.cli:main" in read(wheel, "entry_points.txt")
    assert "The torchrl_nerd authors" in read(wheel, "licenses/LICENSE")


def test_version_is_the_same_everywhere(wheel):
    version = torchrl_nerd.__version__
    assert f"\nVersion: {version}\n" in read(wheel, "METADATA")
    assert f"\nversion: {version}\n" in (ROOT / "CITATION.cff").read_text()
    assert f"\n## [{version}]" in (ROOT / "CHANGELOG.md").read_text()


def test_package_works_from_the_wheel_alone(wheel, tmp_path):
    wheel.extractall(tmp_path)
    code = (
        "import torchrl_nerd; print(torchrl_nerd.__file__);"
        "print(torchrl_nerd.load_scene('cartpole').model.nq)"
    )
    result = subprocess.run(
        [sys.executable, "-c", code],
        cwd=tmp_path,
        env={**os.environ, "PYTHONPATH": str(tmp_path)},
        check=True,
        capture_output=True,
        text=True,
    )
    path, nq = result.stdout.split()
    assert Path(path) == tmp_path / "torchrl_nerd" / "__init__.py"
    assert nq == "2"


def test_a_second_make_installs_nothing_until_the_pins_change(tmp_path):
    for name in ("Makefile", "pyproject.toml", "constraints.txt"):
        copyfile(ROOT / name, tmp_path / name)

    def plan() -> str:
        # quiet: make says where it is when another make runs the tests
        command = ["make", "--no-print-directory", "-n", "demo"]
        done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True)
        assert done.returncode == 0, done.stderr
        return done.stdout

    first = plan()
    assert first.count("pip install") == 3
    stamp = tmp_path / re.findall(r"touch (\S+)", first)[0]
    stamp.parent.mkdir()
    stamp.touch()
    spins = "GOMP_SPINCOUNT=${GOMP_SPINCOUNT:-1000}"  # another value is kept
    assert plan() == f"{spins} .venv/bin/python examples/ppo.py\n"
    with open(tmp_path / "constraints.txt", "a") as file:
        file.write("# newer\n")
    assert plan().count("pip install") == 3
