"""A plane per env: as steep as said, as far below, and the ground MuJoCo steps on."""

import copy
from dataclasses import replace

import torch

from torchrl_nerd import load_scene
from torchrl_nerd.dynamics import MujocoDynamics
from torchrl_nerd.evaluation.stability.states import rotated, sample_states
from torchrl_nerd.geometry.rotations import quat_multiply, rotate
from torchrl_nerd.robots.cube.scene import STEEPEST
from torchrl_nerd.scenes.contact_points import ground_geoms

ROWS = 64
SCENE, LEVEL = load_scene("cube_slope"), load_scene("cube")


def with_rotated_ground(scene, quat):
    """The scene with its ground rotated by a quaternion ``(4,)`` about the origin."""
    model = copy.copy(scene.model)
    for geom in ground_geoms(model):
        position = torch.from_numpy(scene.model.geom_pos[geom].copy())
        pose = torch.from_numpy(scene.model.geom_quat[geom].copy())
        model.geom_pos[geom] = rotate(quat, position).numpy()
        model.geom_quat[geom] = quat_multiply(quat, pose).numpy()
        model.geom_sameframe[geom] = 0  # or MuJoCo takes the body's frame for it
    return replace(scene, model=model)


def test_slopes_are_as_far_below_as_level_ground_would_be(generator):
    start = sample_states(SCENE, ROWS, generator)
    plane, qpos = start["terrain"], start["qpos"]
    length = torch.linalg.vector_norm(plane[:, :3], dim=-1)
    torch.testing.assert_close(length, torch.ones_like(length), rtol=0.0, atol=1e-14)
    steepness = plane[:, 2].acos()
    assert steepness.max() <= STEEPEST + 1e-9 and steepness.max() > 0.8 * STEEPEST
    gap = SCENE.clearances(qpos, plane).amin(-1)
    torch.testing.assert_close(gap, LEVEL.clearances(qpos).amin(-1))


def test_setting_down_leaves_the_gap_asked_for(generator):
    start = sample_states(SCENE, ROWS, generator)
    gap = 0.1 * torch.rand(ROWS, dtype=torch.float64, generator=generator)
    state = {key: start[key] for key in ("qpos", "terrain")}
    SCENE.place_on_terrain(state, gap)
    found = SCENE.clearances(state["qpos"], state["terrain"]).amin(-1)
    torch.testing.assert_close(found, gap, rtol=0.0, atol=1e-12)


def test_a_slope_of_the_row_is_a_slope_of_the_file(generator):
    start = sample_states(SCENE, 1, generator)
    start["qpos"][:, 2] = 0.08
    start["terrain"][:] = torch.tensor([0.0, 0.0, 1.0, 0.0])
    turn = torch.tensor([1.0, 0.0, 0.0, 0.0]).double()
    turn[1:3] = 0.1 * torch.randn(2, dtype=torch.float64, generator=generator)
    turn = turn / torch.linalg.vector_norm(turn)
    start = rotated(SCENE, start, turn)
    torque = torch.zeros(1, 40, 0, dtype=torch.float64)
    here = MujocoDynamics(SCENE).rollout(start, torque, start["terrain"])
    there = MujocoDynamics(with_rotated_ground(LEVEL, turn)).rollout(start, torque)
    torch.testing.assert_close(here["qpos"], there["qpos"], rtol=0.0, atol=1e-9)
    assert here["qvel"][:, -1].abs().max() > 0.0
