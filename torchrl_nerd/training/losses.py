"""What training minimises: one step ahead, then several."""

import torch
from torch import Tensor

from torchrl_nerd.geometry.manifold import differentiate_pos
from torchrl_nerd.modules.nerd import TARGET, NeRD
from torchrl_nerd.scenes.commands import drive, drive_of

RESOLUTION = 1e-4  # relative errors below it no longer count: keeps the root smooth


def relative_error(errors: Tensor, size: Tensor, loss_eps: float) -> Tensor:
    """``sqrt(mean(errors^2) / (size + loss_eps))``, of normalised errors ``(*batch, D)``.

    ``size (*batch,)`` is the mean square of the true change; ``loss_eps`` keeps samples at
    rest finite. Not its square: impacts are few and their errors large, and squares leave
    free flight no say (a quarter of the error there, see experiments/first_edition).
    """
    square = errors.square().mean(-1) / (size + loss_eps)
    return (square + RESOLUTION**2).sqrt()


def one_step_loss(outputs: Tensor, targets: Tensor, loss_eps: float) -> Tensor:
    """Mean relative error of targets ``(*batch, D)``, for the square of NeRD eq. 2.

    Random torques set the scale of targets; without the division the quiet motions that
    decide a passive rollout vanish beside the violent ones.
    """
    size = targets.square().mean(-1)
    return relative_error(outputs - targets, size, loss_eps).mean()


def rollout_loss(
    model: NeRD,
    qpos: Tensor,
    qvel: Tensor,
    command: Tensor,
    terrain: Tensor | None,
    loss_eps: float,
    parameters: Tensor | None = None,
    history: int = 0,
) -> Tensor:
    """Error of the model's own trajectory, fed back, from an empty history.

    Velocity errors are measured in standard deviations of one step's change, position
    errors in what such a change moves in one control step.

    Args:
        model: in training mode.
        qpos: true positions ``(batch, K + 1, nq)``, float64.
        qvel: true velocities ``(batch, K + 1, nv)``.
        command: ``(batch, K, m)``, torques or servos' controls.
        terrain: ``(batch, terrain.size)`` or None.
        loss_eps: see `relative_error`.
        parameters: ``(batch, variation.size)`` or None.
        history: recorded steps that come first; their errors count as well.
    """
    delta, layout = model.state_delta, model.scene.layout
    scale = model.normalize.std(TARGET)[: layout.nv]
    memory = model.network.empty_memory(len(qpos))
    position, velocity = qpos[:, 0], qvel[:, 0]
    errors, told = [], model.scene_features.told(parameters)
    for step in range(command.shape[1]):
        if step <= history:
            position, velocity = qpos[:, step], qvel[:, step]
        driven = drive(model.scene, command[:, step], position, velocity)
        position, velocity, _ = model.step(
            (position, velocity),
            drive_of(*driven, told),
            terrain,
            lambda token: model.network.step(token, memory),
        )
        slip = differentiate_pos(layout, qpos[:, step + 1], position)
        slip = slip / (scale * delta.step_size)
        drift = (velocity - qvel[:, step + 1]) / scale
        errors.append(torch.cat((drift, slip), -1))
    change = (qvel[:, 1:] - qvel[:, :-1]) / scale
    size = change.square().mean((-1, -2))[:, None]
    return relative_error(torch.stack(errors, 1), size, loss_eps).mean().float()
