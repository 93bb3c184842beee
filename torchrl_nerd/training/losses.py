"""What training minimises: one step ahead, then several."""

from typing import cast

import torch
from torch import Tensor

from torchrl_nerd.geometry.manifold import differentiate_pos
from torchrl_nerd.modules.nerd import TARGET, NeRD, Network


def relative_weights(targets: Tensor, softening: float) -> Tensor:
    """One over a sample's squared size, ``(*batch, D) -> (*batch, 1)``.

    Random torques set the scale of normalised targets; without these weights the quiet
    motions that decide a passive rollout vanish beside the violent ones.

    Args:
        targets: normalised.
        softening: added to the mean square, so that samples at rest stay finite.
    """
    return 1.0 / (targets.square().mean(-1, keepdim=True) + softening)


def one_step_loss(outputs: Tensor, targets: Tensor, softening: float) -> Tensor:
    """Weighted mean square error of normalised targets, NeRD eq. 2 made relative."""
    weights = relative_weights(targets, softening)
    return (weights * (outputs - targets).square()).mean()


def rollout_loss(
    model: NeRD,
    qpos: Tensor,
    qvel: Tensor,
    joint_torque: Tensor,
    terrain: Tensor | None,
    softening: float,
) -> Tensor:
    """Error of the model's own trajectory, fed back, from an empty history.

    Velocity errors are measured in standard deviations of one step's change, position
    errors in what such a change moves in one control step.

    Args:
        model: in training mode.
        qpos: true positions ``(rows, K + 1, nq)``, float64.
        qvel: true velocities ``(rows, K + 1, nv)``.
        joint_torque: ``(rows, K, num_actuated)``.
        terrain: ``(rows, terrain.size)`` or None.
        softening: see `relative_weights`.
    """
    delta, layout = model.state_delta, model.scene.layout
    scale = model.normalize.std(TARGET)[: layout.nv]
    network = cast(Network, model.network)
    memory = network.empty_memory(len(qpos))
    position, velocity = qpos[:, 0], qvel[:, 0]
    errors = []
    for step in range(joint_torque.shape[1]):
        token = model.encode(position, velocity, joint_torque[:, step], terrain)
        output = network.step(token, memory)
        position, velocity = model.decode(position, velocity, output)
        slip = differentiate_pos(layout, qpos[:, step + 1], position)
        slip = slip / (scale * delta.step_size)
        drift = (velocity - qvel[:, step + 1]) / scale
        errors.append(torch.cat((drift, slip), -1))
    change = (qvel[:, 1:] - qvel[:, :-1]) / scale
    size = change.square().mean((-1, -2))[:, None, None]
    squares = torch.stack(errors, 1).square() / (size + softening)
    return squares.mean().float()
