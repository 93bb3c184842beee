"""How fast a model moves a robot that lies still: its noise, below which it may sleep.

Game and robot engines put a body to sleep that has been slow for a while, since no solver's
rest is exact. A network's is not either. What it makes of states that do rest in the data
says how slow is as good as still for it, and how little speed it gains, see
`Coverage.stay`.
"""

from typing import cast

import torch
from tensordict import TensorDict
from torch import Tensor

from torchrl_nerd.dynamics import NeRDDynamics
from torchrl_nerd.keys import JOINT_TORQUE, NEXT_QVEL, QPOS, QVEL, TERRAIN
from torchrl_nerd.modules.nerd import NeRD

STILL = 1e-4  # m/s and rad/s: slower is rest in the data; soft friction creeps faster
ROWS, LEAST_ROWS = 256, 16
STEPS = 20
QUANTILE, MARGIN = 0.99, 1.5
LARGEST = 0.1  # m/s or rad/s: a model that moves faster than this does not rest


def resting(data: TensorDict) -> TensorDict:
    """Up to 256 transitions ``[rows]`` that begin and end at rest, spread over the data.

    Args:
        data: transitions, ``[trajectories, steps]``.
    """
    speed = torch.maximum(data[QVEL].abs(), data[NEXT_QVEL].abs()).amax(-1)
    rows = (speed.flatten() < STILL).nonzero()[:, 0]
    flat = cast(TensorDict, data.flatten())
    return cast(TensorDict, flat[rows[:: max(1, -(-len(rows) // ROWS))]])


@torch.no_grad()
def find_rest(model: NeRD, states: TensorDict) -> None:
    """Tell a model how slow is still: what it makes of states at rest, in 20 steps.

    And how much speed a robot at rest gains: what it makes of them, stopped, in one step.
    Nothing is changed where there are too few such states; a model that does not leave
    them at rest never sleeps.

    Args:
        model: trained; its `Coverage` is changed.
        states: see `resting`.
    """
    if len(states) < LEAST_ROWS or not model.coverage.can_rest:
        return
    model.coverage.still.zero_()  # or what it knew before would hide its noise
    speeds = _speeds(model, states, STEPS)
    stopped = states.clone()
    stopped[QVEL] = torch.zeros_like(stopped[QVEL])
    gains = _speeds(model, stopped, 1)
    if speeds.max() < LARGEST:  # False where it is no number
        model.coverage.still.copy_(MARGIN * speeds)
        model.coverage.gain.copy_(MARGIN * gains)


def _speeds(model: NeRD, states: TensorDict, steps: int) -> Tensor:
    """What 99% of the states' speeds ``(nv,)`` in so many steps are below."""
    dynamics, terrain = NeRDDynamics(model), states.get(TERRAIN, None)
    torque, speeds = states[JOINT_TORQUE], []
    now = states.select(QPOS, QVEL)
    dynamics.reset(now)
    for _ in range(steps):
        now = dynamics.step(now, torque, terrain)
        speeds.append(model.coverage.sizes(now[QVEL]))
    return torch.quantile(torch.cat(speeds), QUANTILE, dim=0)
