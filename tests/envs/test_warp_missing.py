"""MuJoCo Warp is optional: known everywhere, asked for in vain where it is missing."""

import sys

import pytest

from torchrl_nerd import load_scene, make_env
from torchrl_nerd.dynamics import MujocoWarpDynamics

SENTENCE = r"needs the package mujoco-warp.*in the clone, pip install -e '.\[warp\]'"


def test_a_refusal_lists_it_installed_or_not():
    with pytest.raises(ValueError, match="dm_control, mujoco_warp, an analytic step"):
        make_env("cartpole/swingup", dynamics="warp")


def test_where_it_is_missing_the_extra_is_named(monkeypatch):
    monkeypatch.setitem(sys.modules, "mujoco_warp", None)  # as if it were not installed
    with pytest.raises(ModuleNotFoundError, match=SENTENCE):
        MujocoWarpDynamics(load_scene("cartpole"), "cpu")
    with pytest.raises(ModuleNotFoundError, match=SENTENCE):
        make_env("cartpole/swingup", dynamics="mujoco_warp")
