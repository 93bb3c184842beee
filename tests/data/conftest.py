"""Scenes whose torques are drawn at random."""

import pytest

from torchrl_nerd.robots import SCENES, load_scene
from torchrl_nerd.scenes import Scene


def has_random_torques(scene: Scene) -> bool:
    return bool(scene.actuated) and scene.sampling.drive is None


@pytest.fixture(params=[x for x in SCENES if has_random_torques(load_scene(x))])
def motor_scene(request: pytest.FixtureRequest) -> Scene:
    """Each scene with motors whose torques are drawn at random."""
    return load_scene(request.param)
