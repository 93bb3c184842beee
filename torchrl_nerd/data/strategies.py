"""Ways to cover the states that a robot meets, by name; see docs/training.md."""

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
LONGEST = 1.0  # s that a torque keeps; the shortest is one control step
PASSIVE = 0.1  # share of trajectories without torque


def resample(scene: Scene, **ranges: Any) -> Scene:
    """The same robot with other fields of its `Sampling`."""
    return replace(scene, sampling=replace(scene.sampling, **ranges))


def mix(*draws: Draw) -> Draw:
    """Equal shares of each, as nearly as rows can be shared out."""

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
    """What can be done with a scene, by name.

    | name | what |
    |---|---|
    | ``uniform`` | the ranges alone: every row in full motion, torques anew each step |
    | ``shares`` | the scene's own sampling, with passive and quiet rows |
    | ``scales`` | torque scales log-uniform over two decades |
    | ``correlated`` | torques that keep for one control step to a second |
    | ``starts`` | equal parts of ``shares``, standing and fallen starts |
    | ``level`` | two parts of ``shares``, one of it over grounds that are hit head-on |
    | ``resting`` | two parts of ``shares``, one of the fallen, stopped and pushed |
    | ``policy`` | the way of an exploring policy |
    | ``mixed`` | equal parts of ranges, standing, fallen and policy |

    All but the policy's part of ``mixed`` have scales and correlation.
    Scenes without such grounds have no ``level``.
    Scenes whose torques follow the state have no correlation; without an explorer there is
    no ``policy``, nor a part of it in ``mixed``.

    Args:
        scene: the robot.
        task: of the same scene; says what standing is.
        explorer: the policy that explores.
    """
    calm = {
        "min_torque_scale": MIN_TORQUE_SCALE,
        "zero_torque_fraction": PASSIVE,
        "low_torque_fraction": 0.0,
    }
    held = {"correlation_time": (scene.control_step, LONGEST)}
    can_hold = scene.sampling.drive is None
    standing, fallen = {"starts": TaskResets(task)}, {"starts": SettledStates(scene)}
    perturbed = PerturbedRestStates(SettledStates(scene))
    both = calm | held if can_hold else calm

    def along(**ranges: Any) -> Draw:
        return partial(simulate, resample(scene, **ranges))

    level = scene.sampling.level_ground
    found = {
        "uniform": along(zero_torque_fraction=0.0, low_torque_fraction=0.0),
        "shares": along(),
        "scales": along(**calm),
        "correlated": along(**held) if can_hold else None,
        "starts": mix(along(), along(**standing), along(**fallen)),
        "level": mix(along(), along(), along(ground=level)) if level else None,
        "resting": mix(along(), along(), along(starts=perturbed)),
    }
    mixed = [along(**both), along(**both, **standing), along(**both, **fallen)]
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
