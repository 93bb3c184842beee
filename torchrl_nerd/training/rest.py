"""Sleep thresholds: how fast a trained model moves a robot that rests in the data."""

from typing import cast

import torch
from tensordict import TensorDict
from torch import Tensor

from torchrl_nerd.dynamics import NeRDDynamics
from torchrl_nerd.evaluation.rollout_error import states_of
from torchrl_nerd.keys import NEXT_QVEL, PARAMETERS, QPOS, QVEL, TERRAIN
from torchrl_nerd.modules.nerd import NeRD
from torchrl_nerd.modules.training_range import magnitudes
from torchrl_nerd.scenes.commands import command_of

REST_SPEED = 1e-4  # m/s, rad/s: slower is rest in the data; soft friction creeps faster
MAX_STATES, MIN_STATES = 256, 16
STEPS = 20
QUANTILE, MARGIN = 0.99, 1.5
MAX_SPEED = 0.1  # m/s or rad/s: a model that moves faster than this does not rest
LEAST_RESTING = 0.01  # of what would sleep: legs on soft ground creep, and never rest


def resting(data: TensorDict) -> TensorDict:
    """Up to 256 transitions ``[n]`` at rest, spread over ``[trajectories, steps]``."""
    speed = torch.maximum(data[QVEL].abs(), data[NEXT_QVEL].abs()).amax(-1)
    still = (speed.flatten() < REST_SPEED).nonzero()[:, 0]
    flat = cast(TensorDict, data.flatten())
    return cast(TensorDict, flat[still[:: max(1, -(-len(still) // MAX_STATES))]])


def slow_velocities(data: TensorDict) -> Tensor:
    """Velocities before and after transitions that are slow, ``(n, 2, nv)``."""
    both = torch.stack((data[QVEL], data[NEXT_QVEL]), -2).flatten(0, 1)
    return both[both.abs().amax((-2, -1)) < MAX_SPEED]


def rest_of(data: TensorDict) -> tuple[TensorDict, Tensor]:
    """What `find_rest` needs of a data set ``[trajectories, steps]``."""
    return resting(data), slow_velocities(data)


@torch.no_grad()
def find_rest(model: NeRD, states: TensorDict, slow: Tensor) -> None:
    """Set a model's `Sleep` thresholds from its own motion of states at rest.

    ``sleep_speed`` is above the speeds that it gives them within 20 steps, ``sleep_gain``
    above those that it gives them, stopped, within one. Nothing is changed where there are
    too few such states. A model that does not keep them at rest never sleeps, nor does one
    where hardly any of the ``slow`` transitions below these thresholds are at rest.
    """
    if len(states) < MIN_STATES or not model.sleep.can_rest:
        return
    model.sleep.sleep_speed.zero_()  # or an earlier threshold would hide its noise
    speeds = _speeds(model, states, STEPS)
    stopped = states.clone()
    stopped[QVEL] = torch.zeros_like(stopped[QVEL])
    gains = _speeds(model, stopped, 1)
    if speeds.max() < MAX_SPEED:  # False where it is no number
        model.sleep.sleep_speed.copy_(MARGIN * speeds)
        model.sleep.sleep_gain.copy_(MARGIN * gains)
        asleep = slow[model.sleep.is_asleep(slow[:, 0], slow[:, 1])]
        count = int((asleep.abs().amax((-2, -1)) < REST_SPEED).sum())
        if count < LEAST_RESTING * len(asleep):
            model.sleep.sleep_speed.zero_()
            model.sleep.sleep_gain.zero_()


def _speeds(model: NeRD, states: TensorDict, steps: int) -> Tensor:
    """What 99% of the states' speeds ``(nv,)`` in so many steps are below."""
    start = states.select(QPOS, QVEL, TERRAIN, PARAMETERS, strict=False)
    command = command_of(model.scene, states)[:, None]  # (states, 1, m)
    path = states_of(NeRDDynamics(model), start, steps, command)
    speeds = [magnitudes(model.sleep.vectors, state[QVEL]) for state in path]
    return torch.quantile(torch.cat(speeds), QUANTILE, dim=0)
