"""Random trajectories of the ground truth: NeRD appendix A.2, no task."""

from typing import cast

import numpy as np
import torch
from tensordict import TensorDict, TensorDictBase
from torch import Generator, Tensor

from torchrl_nerd.dynamics.mujoco import MujocoDynamics
from torchrl_nerd.geometry.manifold import joint_label
from torchrl_nerd.keys import CTRL, PARAMETERS, QPOS, QVEL, TERRAIN
from torchrl_nerd.scenes import Scene
from torchrl_nerd.scenes.commands import drive, held
from torchrl_nerd.scenes.sampling import sample_correlated_commands

SEGMENT = 16  # control steps per call of MuJoCo
LARGEST = 1e5  # reference code: a trajectory beyond this has diverged


def simulate(
    scene: Scene,
    trajectories: int,
    steps: int,
    generator: Generator,
    is_changing: bool = False,
) -> TensorDict:
    """Draw ``[trajectories, steps]`` from the scene's ranges, diverged ones included.

    ``is_changing``: hidden parameters change once in every trajectory, see `change_once`.
    """
    dynamics = MujocoDynamics(scene)
    start, scale = scene.sample_initial(trajectories, generator)
    terrain, varied, own = start.pop(TERRAIN, None), scene.variation, None
    if varied is not None:
        first = varied.draw(trajectories, generator)
        own = first[:, None].repeat(1, steps, 1)  # (trajectories, steps, size)
        if is_changing:
            change_once(own, varied.draw(trajectories, generator), generator)
    state = TensorDict(start, batch_size=[trajectories])
    dynamics.reset(state)
    states, commands, done = [state[:, None]], [], 0
    sampling, drawn = scene.sampling, ()
    if sampling.drive is None:
        how = steps, scene.control_step, generator
        drawn = sample_correlated_commands(sampling, scale, *how).split(SEGMENT, 1)
    for segment in range(steps if sampling.drive else len(drawn)):
        last = cast(TensorDict, states[-1][:, -1])
        if own is not None:
            last = last.set(PARAMETERS, own[:, done])
        if sampling.drive is None:
            command = drawn[segment]  # (trajectories, SEGMENT, m)
        else:  # depends on the state: one step at a time
            command = sampling.drive(last[QPOS], last[QVEL], scale, generator)[:, None]
        torque, ctrl = held(scene, command)
        commands.append(command)
        states.append(dynamics.rollout(last, torque, terrain, ctrl))
        done += command.shape[1]
    data = as_transitions(scene, states, commands, terrain)
    return data if own is None else data.set(PARAMETERS, own)


def change_once(own: Tensor, other: Tensor, generator: Generator) -> None:
    """Change parameters ``(trajectories, steps, size)``, in place, once per trajectory.

    Each trajectory does so at a random time, after a whole number of segments. It takes
    over each of ``other (trajectories, size)`` with a chance of a half.

    Raises:
        ValueError: trajectories of a single segment.
    """
    trajectories, steps, size = own.shape
    if not (last := (steps - 1) // SEGMENT):
        raise ValueError(
            f"expected trajectories of more than {SEGMENT} steps for robots that change, "
            f"got {steps}"
        )
    begin = SEGMENT * torch.randint(1, last + 1, (trajectories, 1), generator=generator)
    is_late = torch.arange(steps) >= begin  # (trajectories, steps)
    is_other = torch.rand(trajectories, size, generator=generator) < 0.5
    own.copy_(torch.where(is_late[..., None] & is_other[:, None], other[:, None], own))


def as_transitions(
    scene: Scene,
    states: list[TensorDictBase],
    commands: list[Tensor],
    terrain: Tensor | None,
    parameters: Tensor | None = None,
) -> TensorDict:
    """A data set ``[trajectories, steps]`` in TorchRL's layout.

    ``states`` are consecutive parts ``[trajectories, *]``, steps + 1 in all.
    ``commands`` are parts ``(trajectories, *, m)`` of what drives them. Where they
    vary, terrain and parameters are ``(trajectories, size)``.
    """
    path = cast(TensorDict, TensorDict.cat(states, 1))
    data, after = (cast(TensorDict, path[:, a:b]) for a, b in ((0, -1), (1, None)))
    torque, ctrl = drive(scene, torch.cat(commands, 1), data[QPOS], data[QVEL])
    data["next"] = after.set("joint_torque", torque)
    if ctrl is not None:
        data[CTRL] = ctrl
    for key, value in ((TERRAIN, terrain), (PARAMETERS, parameters)):
        if value is not None:
            steps = data.batch_size[1]
            data[key] = value[:, None].expand(-1, steps, -1).contiguous()
    return data


def first_beyond(scene: Scene, data: TensorDictBase) -> list[str]:
    """What was the first to leave the bounds, in each of trajectories that are not sound.

    A joint's position or velocity, or MuJoCo's solver, which gave up on the whole state.
    """
    model, names = scene.model, []
    for key, width, addresses in (
        (QPOS, model.nq, model.jnt_qposadr),
        (QVEL, model.nv, model.jnt_dofadr),
    ):
        joints = np.searchsorted(addresses, np.arange(width), side="right") - 1
        names += [f"{key} of joint '{joint_label(model, int(j))}'" for j in joints]
    found = []
    for path in torch.cat((data["next", QPOS], data["next", QVEL]), -1).numpy():
        is_beyond = ~(np.abs(path) < LARGEST)  # (steps, nq + nv)
        step = int(is_beyond.any(-1).argmax())
        gave_up = np.isnan(path[step]).all()
        found.append("MuJoCo" if gave_up else names[int(is_beyond[step].argmax())])
    return found


def is_sound(data: TensorDictBase) -> Tensor:
    """Which of ``[trajectories, steps]`` stay finite and within bounds, bool."""
    state = torch.cat((data["next", QPOS], data["next", QVEL]), -1)
    return (state.abs() < LARGEST).all(-1).all(-1)
