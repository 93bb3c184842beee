"""Images show the robot where its state says, on its own terrain."""

import numpy as np
import pytest
import torch
from helpers import FLOATER, make_scene

from torchrl_nerd.evaluation.render.renderer import RobotRenderer, find_gl
from torchrl_nerd.keys import QPOS
from torchrl_nerd.robots import load_scene
from torchrl_nerd.scenes import Scene

SIZE = (120, 96)


@pytest.fixture(scope="module", autouse=True)
def gl() -> None:
    if find_gl() is None:
        pytest.skip("no OpenGL library works on this machine")


def image(scene: Scene, qpos: torch.Tensor, terrain=None) -> np.ndarray:
    renderer = RobotRenderer(scene, *SIZE, terrain)
    pixels = renderer.render(qpos).astype(int)
    renderer.close()
    return pixels


def test_every_robot_is_in_the_image(scene):
    pixels = image(scene, torch.from_numpy(scene.model.qpos0))
    assert pixels.shape == (SIZE[1], SIZE[0], 3)
    is_colored = np.ptp(pixels, -1) > 60  # robots are blue and orange, grounds gray
    assert 0.002 < is_colored.mean() < 0.5


def test_the_camera_follows_a_floating_base(generator):
    scene = load_scene("ant")
    qpos = scene.sample_initial(1, generator)[0][QPOS][0]
    moved, turned = qpos.clone(), qpos.clone()
    moved[:2] += torch.tensor((40.0, -20.0))  # whole squares of the ground
    turned[7:] += 0.5
    here = image(scene, qpos)
    differs = [
        (abs(here - image(scene, x)).max(-1) > 40).mean() for x in (moved, turned)
    ]
    assert differs[0] < 0.01 < differs[1]


@pytest.mark.parametrize("name", ["cube_slope", "double_pendulum"])
def test_the_terrain_of_a_row_is_where_its_parameters_say(name, generator):
    scene = load_scene(name)
    start, _ = scene.sample_initial(1, generator)
    qpos = start[QPOS][0]
    terrain = torch.tensor((0.3, 0.0, 0.91**0.5, -0.2), dtype=torch.float64)
    renderer = RobotRenderer(scene, *SIZE, terrain)
    pixels = renderer.render(qpos).astype(int)
    (plane,) = np.flatnonzero(scene.model.geom_type == 0)
    normal = renderer.data.geom_xmat[plane].reshape(3, 3)[:, 2]
    np.testing.assert_allclose(normal, terrain[:3], atol=1e-9)
    np.testing.assert_allclose(normal @ renderer.data.geom_xpos[plane], -0.2)
    renderer.close()
    level = torch.tensor((0.0, 0.0, 1.0, -0.2), dtype=torch.float64)
    assert (abs(pixels - image(scene, qpos, level)).max(-1) > 20).mean() > 0.02


def test_the_scene_itself_stays_as_it_is(generator):
    scene = make_scene(FLOATER)
    before = scene.model.stat.extent, scene.model.vis.global_.offwidth
    image(scene, scene.sample_initial(1, generator)[0][QPOS][0])
    assert (scene.model.stat.extent, scene.model.vis.global_.offwidth) == before


def test_a_machine_without_opengl_is_told_what_to_install(monkeypatch):
    monkeypatch.setenv("MUJOCO_GL", "off")
    assert find_gl() is None
    with pytest.raises(ValueError, match="install libegl1"):
        RobotRenderer(make_scene(FLOATER), *SIZE)
