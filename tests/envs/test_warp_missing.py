"""MuJoCo Warp is optional: listed where it is installed, asked for in vain elsewhere."""

import sys

import pytest

from torchrl_nerd import load_scene, make_env
from torchrl_nerd.dynamics import MujocoWarpDynamics
from torchrl_nerd.dynamics.warp_setup import is_warp_installed
from torchrl_nerd.envs.ground_truth import GROUND_TRUTH

SENTENCE = r"needs the package mujoco-warp.*: pip install 'torchrl-nerd\[warp\]'"


def test_it_is_listed_where_it_is_installed():
    assert ("mujoco_warp" in GROUND_TRUTH) == is_warp_installed()
    with pytest.raises(ValueError) as caught:
        make_env("cartpole/swingup", dynamics="warp")
    assert ("mujoco_warp" in str(caught.value)) == is_warp_installed()


def test_where_it_is_missing_the_extra_is_named(monkeypatch):
    monkeypatch.setitem(sys.modules, "mujoco_warp", None)  # as if it were not installed
    with pytest.raises(ModuleNotFoundError, match=SENTENCE):
        MujocoWarpDynamics(load_scene("cartpole"), "cpu")
    with pytest.raises(ModuleNotFoundError, match=SENTENCE):
        make_env("cartpole/swingup", dynamics="mujoco_warp")
