"""What is held over a control step: a joint torque, or the control of MuJoCo's servos.

A command ``(*batch, m)`` is the ``ctrl`` of a scene with servos, else the torque of every
actuated dof. A servo's torque follows from its control and the state, at every substep.
"""

import torch
from tensordict import TensorDictBase
from torch import Tensor

from torchrl_nerd.keys import CTRL, JOINT_TORQUE
from torchrl_nerd.scenes.controllers import (
    ActuatorController,
    Controller,
    clipped_ctrl,
)
from torchrl_nerd.scenes.scene import Scene

Drive = tuple[Tensor, Tensor | None]
"""Joint torque ``(*batch, num_actuated)`` at the start of a step, and ``ctrl``."""


def actuate(
    controller: Controller, action: Tensor, qpos: Tensor, qvel: Tensor
) -> Drive:
    """What an action does; ``ctrl`` where the controller is MuJoCo's own actuators."""
    ctrl = None
    if isinstance(controller, ActuatorController):
        ctrl = controller.ctrl(action.to(qpos.dtype))
    return controller(action, qpos, qvel), ctrl


def drive(scene: Scene, command: Tensor, qpos: Tensor, qvel: Tensor) -> Drive:
    """What a command ``(*batch, m)`` does in a state: controls within their range."""
    if scene.servos is None:
        return command, None
    ctrl = clipped_ctrl(scene.model, command)
    return scene.servos.torque(ctrl, qpos, qvel), ctrl


def drive_of(
    joint_torque: Tensor, ctrl: Tensor | None = None, told: Tensor | None = None
) -> Tensor:
    """A model's input of both, side by side: ``(*batch, num_actuated + num_ctrl)``.

    ``told``: what else it is given, see `SceneFeatures.told`.
    """
    parts = [x for x in (joint_torque, ctrl, told) if x is not None]
    return joint_torque if len(parts) == 1 else torch.cat(parts, -1)


def held(scene: Scene, command: Tensor) -> tuple[Tensor | None, Tensor | None]:
    """A command as torque or as ``ctrl``, for `MujocoDynamics.rollout`."""
    return (command, None) if scene.servos is None else (None, command)


def num_ctrl(scene: Scene) -> int:
    """How many controls say what servos do; 0 without servos."""
    return 0 if scene.servos is None else scene.servos.num_actions


def idle(scene: Scene, *batch: int) -> Tensor:
    """The command ``(*batch, m)`` of no torque, or of servos in mid range, float64."""
    return scene.sampling.commands[0].expand(*batch, -1)


def command_key(scene: Scene) -> tuple[str, str]:
    """Where transitions hold the command."""
    return JOINT_TORQUE if scene.servos is None else CTRL


def command_of(scene: Scene, data: TensorDictBase) -> Tensor:
    """The command of transitions ``[*batch]``."""
    return data[command_key(scene)]
