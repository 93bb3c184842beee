"""Torques follow actions: proportional, clipped, one per actuated dof."""

import torch
from helpers import random_transitions

from torchrl_nerd.keys import QPOS, QVEL
from torchrl_nerd.scenes.controllers import TorqueController


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
    if not isinstance(scene.controller, TorqueController):
        return
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
