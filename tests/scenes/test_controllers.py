"""Torques follow actions: proportional, clipped, one per actuated dof; or springs."""

import pytest
import torch
from helpers import random_transitions

from torchrl_nerd.keys import QPOS, QVEL
from torchrl_nerd.robots import SCENES, load_scene
from torchrl_nerd.scenes.controllers import PDController, TorqueController

DRIVEN = [
    name
    for name in SCENES
    if load_scene(name).actuated
    and isinstance(load_scene(name).controller, TorqueController)
]


def random_actions(scene, rows, generator, low=-1.0, high=1.0):
    u = torch.rand(rows, scene.controller.num_actions, generator=generator)
    return low + (high - low) * u


def torques(scene, action, generator):
    state = random_transitions(scene, len(action), generator)
    return scene.controller(action, state[QPOS], state[QVEL])


def test_a_scenes_torques_fit_its_actuators(scene, generator):
    action = random_actions(scene, 50, generator)
    torque = torques(scene, action, generator)
    assert torque.shape == (50, len(scene.actuated)) and torque.dtype == torch.float64
    largest = torch.tensor(scene.sampling.torque, dtype=torch.float64)
    assert (torque.abs() <= largest).all()


@pytest.mark.parametrize("name", DRIVEN)
def test_a_unit_action_gives_the_largest_torque(name, generator):
    scene = load_scene(name)
    unit = torch.eye(scene.controller.num_actions)
    pushed = torques(scene, unit, generator) - torques(scene, 0.0 * unit, generator)
    gain = torch.tensor(scene.controller.gain, dtype=torch.float64)
    torch.testing.assert_close(pushed, torch.diag(gain))


def test_torque_is_linear_up_to_full_action_and_clipped_beyond(scene, generator):
    state = random_transitions(scene, 50, generator)
    state = state[QPOS], state[QVEL]
    action = random_actions(scene, 50, generator).double()
    full = scene.controller(action, *state)
    torch.testing.assert_close(scene.controller(0.25 * action, *state), 0.25 * full)
    torch.testing.assert_close(scene.controller(-action, *state), -full)
    size = torch.rand(50, 1, generator=generator).exp()
    beyond = scene.controller(size * action.sign(), *state)
    assert torch.equal(beyond, scene.controller(action.sign(), *state))


def test_leading_dimensions_are_kept(scene, generator):
    action = random_actions(scene, 12, generator)
    state = random_transitions(scene, 12, generator)
    flat = scene.controller(action, state[QPOS], state[QVEL])
    batch = (x.reshape(3, 4, -1) for x in (action, state[QPOS], state[QVEL]))
    assert torch.equal(scene.controller(*batch).reshape(flat.shape), flat)


def springs(rng, **changes):
    """Springs on three of nine coordinates, and their numbers."""
    joints = tuple(rng.permutation(9)[:3].tolist())
    kp, kd, scale = (tuple(rng.uniform(0.5, 2.0, 3)) for _ in range(3))
    numbers = {"kp": kp, "kd": kd, "scale": scale, **changes}
    return PDController(joints, tuple(j - 1 for j in joints), **numbers), numbers


@pytest.mark.parametrize("is_relative", [False, True])
def test_springs_pull_to_the_target_and_no_harder_than_their_limit(is_relative, rng):
    default, limit = tuple(rng.normal(size=3)), tuple(rng.uniform(0.5, 1.5, 3))
    choice = {"default": None if is_relative else default}
    controller, n = springs(rng, **choice)
    action, qpos, qvel = 2.0 * rng.normal(size=(50, 3)), *rng.normal(size=(2, 50, 10))
    q = qpos[:, controller.qpos_addresses]
    target = (q if is_relative else default) + n["scale"] * action.clip(-1.0, 1.0)
    want = n["kp"] * (target - q) - n["kd"] * qvel[:, controller.dof_addresses]
    given = tuple(map(torch.from_numpy, (action, qpos, qvel)))
    torch.testing.assert_close(controller(*given), torch.from_numpy(want))
    limited, _ = springs(rng, **choice, limit=limit)
    torque = limited(*given).abs()
    largest = torch.tensor(limit, dtype=torch.float64)
    assert (torque <= largest).all() and (torque == largest).any()


def test_springs_of_unequal_lengths_are_refused(rng):
    for name in ("kp", "kd", "scale", "limit", "default"):
        with pytest.raises(ValueError, match=f"3 numbers as {name}, got 2"):
            springs(rng, **{name: (1.0, 2.0)})
