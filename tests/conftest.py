"""Fixtures of every test: fresh random numbers, and all registered robots and tasks.

A test that takes ``scene`` or ``task_id`` runs once for each one registered, so a new
robot is tested by being there. Random inputs are drawn anew at every run; a failure shows
its seed, and ``pytest --seed N`` draws the same again.
"""

import logging
import secrets

import numpy as np
import pytest
import torch
from helpers import EXCERPT

from torchrl_nerd.data.cube_tosses import Tosses, TossLog, make_tosses, read_log
from torchrl_nerd.robots import SCENES, TASKS, load_scene
from torchrl_nerd.scenes import Scene

logging.getLogger("torchrl").setLevel(logging.ERROR)


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption("--seed", type=int, help="draw the random inputs of this seed")


@pytest.fixture
def seed(request: pytest.FixtureRequest) -> int:
    """A fresh seed for this test, printed if it fails."""
    given = request.config.getoption("--seed")
    value = secrets.randbits(31) if given is None else given
    request.node.add_report_section("call", "seed", f"--seed {value}")
    torch.manual_seed(value)
    return value


@pytest.fixture
def generator(seed: int) -> torch.Generator:
    """Torch's random numbers of this test."""
    return torch.Generator().manual_seed(seed)


@pytest.fixture
def rng(seed: int) -> np.random.Generator:
    """NumPy's random numbers of this test."""
    return np.random.default_rng(seed)


@pytest.fixture(params=list(SCENES))
def scene(request: pytest.FixtureRequest) -> Scene:
    """Each registered scene."""
    return load_scene(request.param)


@pytest.fixture(params=list(TASKS))
def task_id(request: pytest.FixtureRequest) -> str:
    """Each registered task."""
    return request.param


@pytest.fixture
def real_cube() -> Scene:
    """The cube that was recorded."""
    return load_scene("cube_real")


@pytest.fixture
def log() -> TossLog:
    """A dozen of its tosses as they were recorded."""
    return read_log(EXCERPT)


@pytest.fixture
def tosses(log: TossLog, real_cube: Scene) -> Tosses:
    """The same as states."""
    return make_tosses(log, real_cube)
