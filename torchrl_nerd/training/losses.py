"""What training minimises: one step ahead, then several."""

from collections.abc import Callable, Sequence
from functools import partial

import torch
from torch import Tensor

from torchrl_nerd.geometry.manifold import differentiate_pos
from torchrl_nerd.modules.nerd import TARGET, NeRD, State
from torchrl_nerd.scenes.commands import drive, drive_of

Read = Callable[..., Tensor]
"""``read`` or ``step`` of a network: tokens and ``memory`` to outputs."""
RESOLUTION = 1e-4  # relative errors below it no longer count: keeps the root smooth


def relative_error(errors: Tensor, size: Tensor, loss_eps: float) -> Tensor:
    """``sqrt(mean(errors^2) / (size + loss_eps))``, of normalised errors ``(*batch, D)``.

    ``size (*batch,)`` is the mean square of the true change; ``loss_eps`` keeps samples at
    rest finite. Not its square: impacts are few and their errors large, and squares leave
    free flight no say (a quarter of the error there, see experiments/first_edition).
    """
    square = errors.square().mean(-1) / (size + loss_eps)
    return (square + RESOLUTION**2).sqrt()


def one_step_loss(
    outputs: Tensor, targets: Tensor, weights: Tensor, loss_eps: float
) -> Tensor:
    """Mean relative error of targets ``(*batch, D)``, for the square of NeRD eq. 2.

    Random torques set the scale of targets; without the division the quiet motions that
    decide a passive rollout vanish beside the violent ones. ``weights (D,)`` measure
    positions as `rollout_loss` does, see `StateDelta.error_weights`.
    """
    size = (weights * targets).square().mean(-1)
    return relative_error(weights * (outputs - targets), size, loss_eps).mean()


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
    """Error of the model's own trajectory, fed back, from an empty or a recorded history.

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
        history: recorded steps that come first, at most K; their errors count as well.

    Returns:
        ``()``, float32.
    """
    delta, layout = model.state_delta, model.scene.layout
    memory = model.network.empty_memory(len(qpos))

    def advance(
        state: State, command: Tensor, own: Sequence[Tensor | None], read: Read
    ) -> State:
        """States ``(batch, T, ...)`` or ``(batch, ...)`` a step later."""
        told, ground = own
        drives = drive_of(*drive(model.scene, command, *state), told)
        return model.step(state, drives, ground, partial(read, memory=memory))[:2]

    own, path = (model.scene_features.told(parameters), terrain), []
    if history:  # all at once
        known = [x if x is None else x[:, None].expand(-1, history, -1) for x in own]
        seen = qpos[:, :history], qvel[:, :history]
        path.append(advance(seen, command[:, :history], known, model.network.read))
    state = qpos[:, history], qvel[:, history]
    for now in command[:, history:].unbind(1):
        state = advance(state, now, own, model.network.step)
        path.append([x[:, None] for x in state])
    # (batch, K, ...)
    position, velocity = (torch.cat(x, 1) for x in zip(*path, strict=True))
    scale = model.normalize.std(TARGET)[: layout.nv]
    drift = (velocity - qvel[:, 1:]) / scale
    slip = differentiate_pos(layout, qpos[:, 1:], position) / (scale * delta.step_size)
    errors = torch.cat((drift, slip), -1)
    change = (qvel[:, 1:] - qvel[:, :-1]) / scale
    size = change.square().mean((-1, -2))[:, None]
    return relative_error(errors, size, loss_eps).mean().float()
