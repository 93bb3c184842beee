"""Generating data costs little beyond the physics itself."""

import runpy
from pathlib import Path

import pytest

from torchrl_nerd.robots import SCENES, load_scene

BENCHMARK = Path(__file__).parents[2] / "benchmarks" / "data_rate.py"


# where torques follow the state, no one bare call makes them
DRAWN_AHEAD = [name for name in SCENES if load_scene(name).sampling.drive is None]


@pytest.mark.slow
@pytest.mark.parametrize("name", DRAWN_AHEAD)
def test_at_least_four_fifths_of_bare_rollout(name, seed):
    benchmark = runpy.run_path(str(BENCHMARK))
    assert benchmark["main"](benchmark["Options"](scene=name, seed=seed)) >= 0.8
