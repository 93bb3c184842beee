"""Fixtures of every test: random numbers, and all registered robots and tasks.

A test that takes ``scene`` or ``task_id`` runs once for each one registered, so a new
robot is tested by being there. Where a test has several parameters, a few cases cover every
value of each, with one scene and one task of each robot; the rest of the product is marked
slow, see `cover_products`.

Random inputs of a test are the same at every run. ``pytest --seed N`` draws others,
``--seed random`` new ones at every run; a failure shows its seed.
"""

import logging
import secrets
from collections import Counter
from dataclasses import replace
from itertools import groupby
from zlib import crc32

import numpy as np
import pytest
import torch
from helpers import EXCERPT

from torchrl_nerd.data.log_files import read_log
from torchrl_nerd.data.recorded import Recording, complete
from torchrl_nerd.robots import (
    ROBOTS,
    SCENES,
    TASKS,
    EvaluationProtocol,
    load_scene,
    protocol_of,
)
from torchrl_nerd.scenes import Scene

logging.getLogger("torchrl").setLevel(logging.ERROR)


PRODUCT = 8
"""Cases of a test with several parameters up to which all of them run by default."""
OTHERS = [
    name
    for robot in ROBOTS.values()
    for name in (*list(robot.scenes)[1:], *list(robot.tasks)[1:])
]
"""Scenes and tasks of a robot beside its first."""


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption("--seed", help="a number, or 'random'; each test's own otherwise")


@pytest.hookimpl(tryfirst=True)  # before -m selects
def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    for _, cases in groupby(items, lambda item: item.nodeid.partition("[")[0]):
        cover_products([case for case in cases if isinstance(case, pytest.Function)])


def cover_products(cases: list[pytest.Function]) -> None:
    """Mark slow all but a few cases of a test in which every parameter's values occur.

    Which values meet depends on the test's name, so that other pairs meet in other tests.
    """
    expensive = ("slow", "gpu")
    cases = [case for case in cases if not any(map(case.get_closest_marker, expensive))]
    values = {  # the same object in every case that has it
        case: {(name, id(x)) for name, x in case.callspec.params.items()}
        for case in cases
        if hasattr(case, "callspec")
    }
    counts = Counter(name for name, _ in set().union(*values.values()))
    if len(cases) <= PRODUCT or sum(count > 1 for count in counts.values()) < 2:
        return
    missing = {
        (name, id(x))
        for case in values
        for name, x in case.callspec.params.items()
        if (x.name if isinstance(x, Scene) else str(x)) not in OTHERS
    }
    order = sorted(cases, key=lambda case: crc32(case.nodeid.encode()))
    while missing:
        best = max(order, key=lambda case: len(values[case] & missing))
        missing -= values[best]
        order.remove(best)
    for case in order:
        case.add_marker("slow")


@pytest.fixture
def seed(request: pytest.FixtureRequest) -> int:
    """A seed of this test's own, printed if it fails."""
    given = request.config.getoption("--seed")
    if given is None:
        value = crc32(request.node.nodeid.encode()) >> 1
    else:
        value = secrets.randbits(31) if given == "random" else int(given)
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


@pytest.fixture
def short_rollouts(monkeypatch: pytest.MonkeyPatch) -> None:
    """Commands roll out for 5 control steps where no test asks for the errors' size."""

    def short(scene: Scene) -> EvaluationProtocol:
        return replace(protocol_of(scene), horizons=(5,))

    for command in ("train", "eval"):
        monkeypatch.setattr(f"torchrl_nerd.cli.{command}.protocol_of", short)


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
def log(real_cube: Scene) -> Recording:
    """A dozen of its tosses as they were recorded."""
    return read_log(EXCERPT, real_cube)


@pytest.fixture
def recording(log: Recording, real_cube: Scene) -> Recording:
    """The same as states."""
    return complete(log, real_cube)
