"""Random states of a robot on its ground and beyond its joints' limits."""

import mujoco
import numpy as np
import torch
from tensordict import TensorDict
from torch import Generator, Tensor

from torchrl_nerd.geometry.manifold import SLIDE
from torchrl_nerd.keys import CTRL, JOINT_TORQUE, PARAMETERS, QPOS, QVEL
from torchrl_nerd.scenes import Scene
from torchrl_nerd.scenes.commands import drive
from torchrl_nerd.scenes.sampling import sample_commands

OVERSHOOT = 0.2  # of a joint's range, beyond its limits
UPRIGHT = 1.0 - 1e-6  # smallest height of an axis that is vertical


def states_in_contact(scene: Scene, count: int, max_depth: float) -> TensorDict:
    """Random states, torques and servos' controls, up to ``max_depth`` m in the ground.

    The batch is ``[count]``. Joints are up to `OVERSHOOT` of their ranges beyond them.
    Of a varied scene each is of
    a robot of its own.
    """
    generator = Generator().manual_seed(0)
    state, scale = scene.sample_initial(count, generator)
    share = torch.linspace(-OVERSHOOT, 1.0 + OVERSHOOT, count, dtype=torch.float64)
    for joint in scene.model.jnt_limited.nonzero()[0]:
        low, high = scene.model.jnt_range[joint]
        mixed = share[torch.randperm(count, generator=generator)]
        state[QPOS][:, scene.model.jnt_qposadr[joint]] = low + (high - low) * mixed
    draw = torch.rand(count, dtype=torch.float64, generator=generator)
    _place_on_ground(scene, state, -max_depth * draw)
    command = sample_commands(scene.sampling, scale, 1, generator)[:, 0]
    torque, ctrl = drive(scene, command, state[QPOS], state[QVEL])
    found = TensorDict(state, [count]).set(JOINT_TORQUE, torque)
    if ctrl is not None:
        found[CTRL] = ctrl
    if scene.variation is not None:
        own = scene.variation.draw(count, generator)
        kinds = [p.kind for p in scene.variation.parameters]
        # every isometry has a delay, which would hide the torque of a single step
        found[PARAMETERS] = own * torch.tensor([kind != "delay" for kind in kinds])
    return found


def _place_on_ground(scene: Scene, state: dict[str, Tensor], gap: Tensor) -> None:
    """`Scene.place_on_terrain`, or so along a planar robot's vertical slide."""
    scene.place_on_terrain(state, gap)
    model, qpos = scene.model, state[QPOS]
    if scene.base.is_floating or not scene.clearances(qpos).shape[-1]:
        return
    is_root = model.body_parentid[model.jnt_bodyid] == 0
    is_free = (model.jnt_type == SLIDE) & (model.jnt_limited == 0)
    for joint in np.flatnonzero(is_root & is_free):
        up = np.empty(3)
        body = model.jnt_bodyid[joint]
        mujoco.mju_rotVecQuat(up, model.jnt_axis[joint], model.body_quat[body])
        if abs(up[2]) > UPRIGHT:
            lowest = scene.clearances(qpos).amin(-1)
            qpos[:, model.jnt_qposadr[joint]] += np.sign(up[2]) * (gap - lowest)
