"""Losses: the documented formulas, zero for the ground truth, gradients that are slopes."""

import numpy as np
import pytest
import torch
from helpers import every_scene, mujoco_step, random_transitions
from torch import Tensor, nn

from torchrl_nerd.configs import NO_PREDICTIONS
from torchrl_nerd.data.simulate import is_sound, simulate
from torchrl_nerd.modules.nerd import TARGET, NeRD
from torchrl_nerd.modules.networks import GRUConfig, MLPConfig
from torchrl_nerd.modules.transformer import TransformerConfig
from torchrl_nerd.robots import SCENES, load_scene
from torchrl_nerd.scenes import Scene
from torchrl_nerd.training.losses import (
    one_step_loss,
    relative_error,
    rollout_loss,
)
from torchrl_nerd.training.samples import data_stats, raw_tokens

ROWS = 12


class Recorded(nn.Module):
    """A network that answers what it was given, step by step."""

    def __init__(self, outputs: Tensor) -> None:
        super().__init__()
        self.outputs = nn.Parameter(outputs)

    def empty_memory(self, rows: int):
        assert rows == len(self.outputs)
        return iter(self.outputs.unbind(1))

    def step(self, token: Tensor, memory) -> Tensor:
        return next(memory)


def true_data(scene: Scene, steps: int, generator):
    """Sound trajectories of a registered scene."""
    data = simulate(scene, 4 * ROWS, steps, generator)
    data = data[is_sound(data)][:ROWS]
    assert len(data) == ROWS
    return data


def handmade_data(scene: Scene, steps: int, generator):
    """Trajectories of a robot whose ``qpos`` no box of numbers can draw."""
    transitions = [random_transitions(scene, ROWS, generator)]
    for _ in range(steps - 1):
        state = transitions[-1]["next"].select("qpos", "qvel")
        torque = torch.randn(ROWS, scene.model.nu, generator=generator).double()
        transitions.append(mujoco_step(scene, state, torque))
    return torch.stack(transitions, 1)


def batch_of(data) -> tuple[Tensor, Tensor, Tensor, Tensor | None]:
    states = [
        torch.cat((data[key], data["next", key][:, -1:]), 1) for key in ("qpos", "qvel")
    ]
    terrain = data.get("terrain", None)
    ground = None if terrain is None else terrain[:, 0]
    return *states, data["next", "joint_torque"], ground


def model_of(scene: Scene, data, config) -> NeRD:
    model = NeRD(scene, NO_PREDICTIONS, config, data_stats(scene, data))
    model.network.double()
    return model.train()


def test_errors_are_relative_lengths(rng):
    targets = rng.normal(size=(4, 5, 3)) * 10.0 ** rng.uniform(-3, 3, size=(4, 5, 1))
    loss_eps = rng.uniform(0.01, 1.0)
    outputs = targets + rng.normal(size=targets.shape)
    size = (targets**2).mean(-1)
    expected = np.sqrt(((outputs - targets) ** 2).mean(-1) / (size + loss_eps))
    pair = torch.from_numpy(outputs), torch.from_numpy(targets)
    errors = relative_error(pair[0] - pair[1], torch.from_numpy(size), loss_eps)
    np.testing.assert_allclose(errors.numpy(), expected, rtol=1e-5, atol=1e-4)
    loss = one_step_loss(*pair, torch.ones(3), loss_eps)
    np.testing.assert_allclose(float(loss), expected.mean(), rtol=1e-5, atol=1e-4)


def test_predicting_no_change_costs_less_than_one(generator):
    targets = torch.randn(9, 7, 4, generator=generator).double()
    weights = torch.tensor([1.0, 1.0, 0.1, 0.2])
    assert 0.9 < one_step_loss(0.0 * targets, targets, weights, 1e-3) < 1.0
    assert one_step_loss(targets, targets, weights, 1e-3) < 2e-4


@every_scene
def test_the_ground_truth_has_no_loss(scene, generator):
    draw = true_data if scene.name in SCENES else handmade_data
    data = draw(scene, 5, generator)
    model = model_of(scene, data, MLPConfig(1, 4))
    _, target = raw_tokens(model.scene_features, model.state_delta, data)
    outputs = model.normalize.normalize(TARGET, target)
    model.network = Recorded(outputs)
    assert rollout_loss(model, *batch_of(data), 0.1) < 2e-4
    model.network = Recorded(outputs + 0.1)
    assert rollout_loss(model, *batch_of(data), 0.1) > 1e-2


def test_one_step_of_the_cartpole_by_hand(generator):
    scene = load_scene("cartpole")
    data = true_data(scene, 1, generator)
    model = model_of(scene, data, MLPConfig(1, 8))
    qpos, qvel, torque, _ = batch_of(data)
    token = model.encode(qpos[:, 0], qvel[:, 0], torque[:, 0], None).token
    output = model.network(token).detach().numpy()
    _, target = raw_tokens(model.scene_features, model.state_delta, data)
    target = target.numpy().reshape(ROWS, 4)
    mean, std = target.mean(0), target.std(0)
    delta, step, scale = mean + std * output, 1.0 / 60.0, std[:2]
    qpos, qvel = qpos.numpy(), qvel.numpy()
    velocity = qvel[:, 0] + delta[:, :2]
    position = qpos[:, 0] + step * (qvel[:, 0] + velocity) / 2 + delta[:, 2:]
    drift = (velocity - qvel[:, 1]) / scale
    slip = (position - qpos[:, 1]) / (scale * step)
    change = (qvel[:, 1] - qvel[:, 0]) / scale
    loss_eps = 0.07
    size = (change**2).mean(-1) + loss_eps
    square = (np.concatenate((drift, slip), -1) ** 2).mean(-1) / size
    expected = np.sqrt(square + 1e-8).mean()
    loss = rollout_loss(model, *batch_of(data), loss_eps)
    np.testing.assert_allclose(float(loss.detach()), expected, rtol=1e-5)


@pytest.mark.parametrize(
    "config", [TransformerConfig(1, 8, 2, 3), MLPConfig(1, 8), GRUConfig(1, 8)]
)
def test_gradients_are_slopes(scene, config, generator):
    """Derivative along random directions against central differences."""
    data = true_data(scene, 4, generator)
    model = model_of(scene, data, config)
    batch = batch_of(data)
    head = list(model.network.head.parameters())
    with torch.no_grad():  # small steps, or what has learned nothing flies off
        drawn = [weight.clone() for weight in head]
        for weight in head:
            weight.zero_()
        still, share = rollout_loss(model, *batch, 0.1), 1.0
        while share == 1.0 or rollout_loss(model, *batch, 0.1) > 2.0 * still:
            share *= 0.1
            for weight, first in zip(head, drawn, strict=True):
                weight.copy_(share * first)
    weights = list(model.network.parameters())
    loss = rollout_loss(model, *batch, 0.1)
    gradients = torch.autograd.grad(loss, weights)
    assert all(gradient.isfinite().all() for gradient in gradients)
    assert all(gradient.abs().sum() > 0.0 for gradient in gradients[-2:])
    size = torch.stack([gradient.norm() for gradient in gradients]).norm()
    noise = [torch.randn(w.shape, generator=generator).double() for w in weights]
    length = torch.stack([d.norm() for d in noise]).norm()
    # mostly downhill, or rounding to float32 would drown the slope
    direction = [
        g / size + 0.5 * d / length for g, d in zip(gradients, noise, strict=True)
    ]
    slope = sum((g * d).sum() for g, d in zip(gradients, direction, strict=True))
    measured, at = [], 0.0
    for share in (1e-3, 1e-4, 1e-5):  # a kink within reach of one is not of the last
        epsilon, values = share / max(1.0, float(slope)), []  # steep: curved as well
        for place in (epsilon, -epsilon):
            with torch.no_grad():
                for weight, d in zip(weights, direction, strict=True):
                    weight += (place - at) * d
            at = place
            values.append(rollout_loss(model, *batch, 0.1).double().item())
        measured.append((values[0] - values[1]) / (2.0 * epsilon))
    assert float(slope) in [pytest.approx(m, rel=2e-2) for m in measured], measured
