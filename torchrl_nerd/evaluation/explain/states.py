"""States at which a scene is questioned: of the training ranges, and at the ground."""

from typing import cast

import torch
from tensordict import TensorDict
from torch import Generator

from torchrl_nerd.dynamics import MujocoDynamics
from torchrl_nerd.keys import JOINT_TORQUE, QPOS, QVEL, TERRAIN
from torchrl_nerd.scenes import Scene
from torchrl_nerd.scenes.sampling import sample_torque

STEPS = 24  # control steps of the true solver before a state is taken, at most
NEAR = 0.1  # m: lowest gap between a floating base's shapes and the ground at the start
DEEP = 0.01  # m: penetration at the start, at most


def draw_states(scene: Scene, rows: int, generator: Generator) -> TensorDict:
    """Random states with the torques that come next, ``[rows]``.

    Starts are those of training, a floating base set down near the ground; each row is
    then taken at a random moment of a short true trajectory under random torques, so
    that ground and limits are met as they are in motion.

    Returns:
        ``qpos``, ``qvel``, (``terrain``) and ``("next", "joint_torque")``, float64.
    """
    start, scale = scene.sample_initial(rows, generator)
    draw = torch.rand(rows, dtype=torch.float64, generator=generator)
    scene.place_on_terrain(start, (NEAR + DEEP) * draw - DEEP)
    terrain = start.pop(TERRAIN, None)
    state = TensorDict(start, batch_size=[rows])
    torque = sample_torque(scene.sampling, scale, STEPS + 1, generator)
    later = MujocoDynamics(scene, num_threads=1).rollout(
        state, torque[:, :STEPS], terrain
    )
    path = cast(TensorDict, torch.cat((state[:, None], later), 1))
    moment = torch.randint(STEPS + 1, (rows,), generator=generator)
    row = torch.arange(rows)
    taken = cast(TensorDict, path[row, moment])
    taken[JOINT_TORQUE] = torque[row, moment]
    if terrain is not None:
        taken[TERRAIN] = terrain
    is_sound = taken[QPOS].isfinite().all(-1) & taken[QVEL].isfinite().all(-1)
    return cast(TensorDict, taken[is_sound])
