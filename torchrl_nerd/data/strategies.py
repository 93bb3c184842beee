"""Sampling strategies of training data, by name; see docs/training.md."""

from dataclasses import replace
from functools import partial
from typing import Any, cast

from tensordict import TensorDict
from torch import Generator

from torchrl_nerd.data.generate import Draw
from torchrl_nerd.data.policy_data import policy_data
from torchrl_nerd.data.simulate import simulate
from torchrl_nerd.data.starts import PerturbedRestStates, SettledStates, TaskResets
from torchrl_nerd.envs.actor import Actor
from torchrl_nerd.robots import make_task, preset_of
from torchrl_nerd.scenes import Scene
from torchrl_nerd.tasks import Task

MIN_TORQUE_SCALE = 0.01  # of the largest torque
MAX_CORRELATION_TIME = 1.0  # s; the shortest is one control step
ZERO_TORQUE_FRACTION = 0.1


def resample(scene: Scene, **ranges: Any) -> Scene:
    """The same robot with other fields of its `Sampling`."""
    return replace(scene, sampling=replace(scene.sampling, **ranges))


def mix(*draws: Draw) -> Draw:
    """Equal shares of each, as nearly as the number of trajectories allows."""

    def draw(rows: int, steps: int, generator: Generator) -> TensorDict:
        ends = [rows * (i + 1) // len(draws) for i in range(len(draws))]
        counts = [b - a for a, b in zip([0, *ends], ends, strict=False)]
        parts = [
            one(count, steps, generator)
            for one, count in zip(draws, counts, strict=True)
            if count
        ]
        return cast(TensorDict, TensorDict.cat(parts))

    return draw


def strategies(
    scene: Scene, task: Task, explorer: Actor | None = None
) -> dict[str, Draw]:
    """The sampling strategies of a scene, by name.

    | name | initial states and torques |
    |---|---|
    | ``uniform`` | uniform in the ranges, new torques in every step |
    | ``shares`` | the scene's own sampling, with zero-torque and low-torque trajectories |
    | ``scales`` | torque scales log-uniform over two decades |
    | ``correlated`` | correlated torques, from one control step to a second |
    | ``starts`` | equal parts of ``shares``, task resets and settled states |
    | ``level`` | two parts of ``shares``, one of it over ground that is hit vertically |
    | ``resting`` | two parts of ``shares``, one of perturbed rest states |
    | ``policy`` | trajectories of an exploring policy |
    | ``mixed`` | equal parts of ranges, task resets, settled states and policy |

    All parts of ``mixed`` but the policy's have torque scales and correlation. Scenes
    without such ground have no ``level``. Scenes whose torques follow the state have no
    correlation. Without an explorer there is no ``policy`` and no part of it in ``mixed``.

    Args:
        scene: the robot.
        task: of the same scene; its resets are among the initial states.
        explorer: the policy that explores.
    """
    scaled = {
        "min_torque_scale": MIN_TORQUE_SCALE,
        "zero_torque_fraction": ZERO_TORQUE_FRACTION,
        "low_torque_fraction": 0.0,
    }
    held = {"correlation_time": (scene.control_step, MAX_CORRELATION_TIME)}
    can_hold = scene.sampling.drive is None
    resets, settled = {"starts": TaskResets(task)}, {"starts": SettledStates(scene)}
    perturbed = PerturbedRestStates(SettledStates(scene))
    both = scaled | held if can_hold else scaled

    def along(**ranges: Any) -> Draw:
        return partial(simulate, resample(scene, **ranges))

    level = scene.sampling.level_ground
    found = {
        "uniform": along(zero_torque_fraction=0.0, low_torque_fraction=0.0),
        "shares": along(),
        "scales": along(**scaled),
        "correlated": along(**held) if can_hold else None,
        "starts": mix(along(), along(**resets), along(**settled)),
        "level": mix(along(), along(), along(ground=level)) if level else None,
        "resting": mix(along(), along(), along(starts=perturbed)),
    }
    mixed = [along(**both), along(**both, **resets), along(**both, **settled)]
    if explorer is not None:
        found["policy"] = partial(policy_data, task, explorer)
        mixed.append(found["policy"])
    found["mixed"] = mix(*mixed)
    return {name: draw for name, draw in found.items() if draw is not None}


def preset_strategy(scene: Scene) -> tuple[str, Draw] | None:
    """The strategy of a scene's preset, by name, for `generate`; None: its own ranges."""
    preset = preset_of(scene.name)
    if preset.strategy is None or preset.task is None:
        return None
    return preset.strategy, strategies(scene, make_task(preset.task))[preset.strategy]
