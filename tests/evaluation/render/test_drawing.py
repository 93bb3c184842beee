"""Outlines have the area of what they show; pictures follow the robot."""

import mujoco
import numpy as np
import pytest
import torch
from helpers import FLOATER, make_scene, moved_rows
from tensordict import TensorDict

from torchrl_nerd.evaluation.render.camera import Camera, aim
from torchrl_nerd.evaluation.render.drawing import DrawingRenderer
from torchrl_nerd.evaluation.render.film import make_renderer
from torchrl_nerd.evaluation.render.opengl import OpenGLRenderer, find_gl
from torchrl_nerd.evaluation.render.outline import grid, patches, profile
from torchrl_nerd.evaluation.render.pair import Pair
from torchrl_nerd.evaluation.render.poser import Poser
from torchrl_nerd.robots import load_scene

SIZE = (240, 180)


@pytest.fixture
def camera(rng) -> Camera:
    """From anywhere, looking anywhere."""
    azimuth, elevation = rng.uniform(-180, 180), rng.uniform(-89, 89)
    return Camera(rng.normal(size=(1, 3)), 3.0, azimuth, elevation)


def area(corners: np.ndarray) -> float:
    x, y = corners.T
    return 0.5 * abs(x @ np.roll(y, 1) - y @ np.roll(x, 1))


def seen_area(geom: str, camera: Camera, rng) -> tuple[float, np.ndarray]:
    """Area of a shape in the picture, and its axes in the world."""
    quat = " ".join(map(str, rng.normal(size=4)))
    xml = f'<mujoco><worldbody><geom {geom} quat="{quat}" pos="1 2 3"/>'
    model = mujoco.MjModel.from_xml_string(xml + "</worldbody></mujoco>")
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    seen = patches(model, data, 0, camera, 0)
    return sum(area(corners) for corners, _ in seen), data.geom_xmat[0].reshape(3, 3)


def test_outlines_have_the_area_of_the_shape(camera, rng):
    forward = camera.axes[2]
    r, h = rng.uniform(0.1, 1.0, 2)
    got, _ = seen_area(f'type="sphere" size="{r}"', camera, rng)
    assert got == pytest.approx(np.pi * r**2, rel=0.01)
    got, turn = seen_area(f'type="capsule" size="{r} {h}"', camera, rng)
    along = abs(turn[:, 2] @ forward)
    length = 2.0 * h * np.sqrt(1.0 - along**2)
    assert got == pytest.approx(np.pi * r**2 + 2.0 * r * length, rel=0.01)
    got, turn = seen_area(f'type="cylinder" size="{r} {h}"', camera, rng)
    along = abs(turn[:, 2] @ forward)
    expected = np.pi * r**2 * along + 4.0 * r * h * np.sqrt(1.0 - along**2)
    assert got == pytest.approx(expected, rel=0.01)
    a, b, c = rng.uniform(0.1, 1.0, 3)
    got, turn = seen_area(f'type="box" size="{a} {b} {c}"', camera, rng)
    faces = 4.0 * np.array((b * c, a * c, a * b))
    assert got == pytest.approx(faces @ abs(turn.T @ forward))
    got, turn = seen_area(f'type="ellipsoid" size="{a} {b} {c}"', camera, rng)
    pull = (turn.T @ forward) * (b * c, a * c, a * b)
    assert got == pytest.approx(np.pi * np.linalg.norm(pull), rel=0.02)


def test_camera_axes_are_those_of_mujoco(camera):
    assert np.allclose(camera.axes @ camera.axes.T, np.eye(3))
    model = mujoco.MjModel.from_xml_string("<mujoco/>")
    data, scene = mujoco.MjData(model), mujoco.MjvScene(model, 10)
    free = mujoco.MjvCamera()
    free.lookat[:], free.distance = camera.lookat[0], camera.distance
    free.azimuth, free.elevation = camera.azimuth, camera.elevation
    mujoco.mj_forward(model, data)
    option, pert, every = mujoco.MjvOption(), mujoco.MjvPerturb(), mujoco.mjtCatBit
    mujoco.mjv_updateScene(
        model, data, option, pert, free, every.mjCAT_ALL.value, scene
    )
    assert np.allclose(scene.camera[0].forward, camera.axes[2], atol=1e-5)
    assert np.allclose(scene.camera[0].up, camera.axes[1], atol=1e-5)


def test_lines_on_the_ground_lie_on_it(camera, rng):
    quat = " ".join(map(str, rng.normal(size=4)))
    xml = f'<mujoco><worldbody><geom type="plane" size="0 0 1" quat="{quat}"/>'
    model = mujoco.MjModel.from_xml_string(xml + "</worldbody></mujoco>")
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    normal = data.geom_xmat[0].reshape(3, 3)[:, 2]
    assert abs(grid(data, 0, camera.lookat[0], 0.5) @ normal).max() < 1e-9
    line = profile(data, 0, camera, 0)
    if line is not None:
        points = camera.lookat[0] + line @ camera.axes[:2]
        assert abs(points @ normal).max() < 1e-6 * abs(points).max()


def picture(scene, qpos: torch.Tensor) -> np.ndarray:
    poser = Poser(scene)
    camera = aim(poser, qpos, 0.02, SIZE[0] / SIZE[1])
    return DrawingRenderer(poser, camera, SIZE).frame(0, qpos[0], qpos[-1])


def assert_seen(scene, generator) -> None:
    start, _ = scene.sample_initial(2, generator)
    pixels = picture(scene, start["qpos"][:1])
    assert pixels.shape == (SIZE[1], SIZE[0], 3)
    is_colored = np.ptp(pixels.astype(int), -1) > 60
    assert 0.003 < is_colored.mean() < 0.6


def test_every_robot_is_in_the_picture(scene, generator):
    assert_seen(scene, generator)


@pytest.mark.parametrize(
    "name", ["dm_control/cheetah-run", "dm_control/reacher-easy", "gymnasium/Hopper-v5"]
)
def test_robots_of_others_are_in_the_picture(name, generator):
    assert_seen(load_scene(name), generator)


def test_walls_are_left_out_where_there_is_a_floor():
    walls = '<geom type="plane" size="1 1 1" euler="90 0 0"/>' * 2
    walled = FLOATER.replace("<body pos", walls + "<body pos", 1)
    assert Poser(make_scene(walled)).planes == [0]
    only_walls = walled.replace('name="floor"', 'name="floor" euler="0 90 0"')
    assert Poser(make_scene(only_walls)).planes == [0, 1, 2]


def test_the_picture_goes_with_the_robot(generator):
    """A floating robot far away, by whole squares of the ground, looks the same."""
    scene = make_scene(FLOATER)
    rows = scene.sample_initial(2, generator)[0]
    rows = TensorDict(rows, [2])
    shift = torch.tensor([400.0, -200.0, 0.0], dtype=torch.float64)
    moved = moved_rows(scene, rows, 0.0, shift)
    here, there = (picture(scene, x["qpos"]).astype(int) for x in (rows, moved))
    assert (abs(here - there).max(-1) > 40).mean() < 0.003


@pytest.fixture(scope="module")
def gl() -> str:
    name = find_gl()
    if name is None:
        pytest.skip("no OpenGL without a screen here")
    return name


def test_mujoco_and_drawing_show_the_robot_in_the_same_place(gl, generator):
    scene = load_scene("ant")
    qpos = scene.sample_initial(1, generator)[0]["qpos"].repeat(2, 1)
    qpos[1, 1] += 2.0  # the ghost, beside it
    poser = Poser(scene)
    camera = aim(poser, qpos, 0.02, SIZE[0] / SIZE[1])
    centres = []
    for renderer in (
        OpenGLRenderer(poser, camera, SIZE, gl),
        DrawingRenderer(poser, camera, SIZE),
    ):
        pixels = renderer.frame(0, qpos[0], qpos[1]).astype(int)
        renderer.close()
        rows, columns = np.nonzero(abs(pixels[..., 0] - pixels[..., 2]) > 50)
        centres.append((rows.mean(), columns.mean()))
    # the drawing has no perspective
    assert np.allclose(*centres, atol=0.15 * SIZE[0])


def test_mujoco_gl_of_the_user_is_obeyed():
    assert find_gl({"MUJOCO_GL": "off"}) is None


def test_opengl_that_is_not_there_is_refused(monkeypatch, generator):
    monkeypatch.setenv("MUJOCO_GL", "disable")
    scene = make_scene(FLOATER)
    qpos = scene.sample_initial(2, generator)[0]["qpos"]
    pair = Pair(scene, 0.02, qpos, qpos, None, {}, (0.0, 0.0), "steps")
    assert isinstance(make_renderer(pair), DrawingRenderer)
    with pytest.raises(ValueError, match="neither egl nor osmesa draws here"):
        make_renderer(pair, "opengl")
