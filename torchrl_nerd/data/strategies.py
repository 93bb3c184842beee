"""Sampling strategies of training data: initial states, mixtures, and presets' choices."""

from dataclasses import dataclass, replace
from functools import partial
from itertools import pairwise
from typing import Any, Literal, cast, get_args

import torch
from tensordict import TensorDict
from torch import Generator, Tensor

from torchrl_nerd.data.generate import Draw
from torchrl_nerd.data.simulate import simulate
from torchrl_nerd.dynamics import MujocoDynamics
from torchrl_nerd.geometry.manifold import integrate_pos
from torchrl_nerd.keys import QPOS, QVEL, TERRAIN
from torchrl_nerd.robots import preset_of
from torchrl_nerd.scenes import Scene
from torchrl_nerd.scenes.commands import held, idle
from torchrl_nerd.scenes.sampling import log_uniform

Strategy = Literal["correlated", "level", "resting", "changing"]
MAX_CORRELATION_TIME = 1.0  # s; the shortest is one control step


@dataclass(frozen=True)
class SettledStates:
    """States in which the robot has come to rest: the ends of passive trajectories.

    Of a varied scene they are those of the robot of the file.
    """

    scene: Scene  # the robot, whose sampling gives the initial states
    seconds: float = 3.0  # length of the trajectories

    def __call__(self, count: int, generator: Generator) -> dict[str, Tensor]:
        """See `Starts`; a trajectory that diverges gives its initial state."""
        start, _ = self.scene.sample_initial(count, generator)
        terrain = start.pop(TERRAIN, None)
        state = first = TensorDict(start, [count])
        dynamics = MujocoDynamics(self.scene)
        torque, ctrl = held(self.scene, idle(self.scene, count, 1))
        dynamics.reset(first)
        for _ in range(round(self.seconds / self.scene.control_step)):
            path = dynamics.rollout(state, torque, terrain, ctrl)
            state = cast(TensorDict, path[:, 0])
        is_fine = torch.cat((state[QPOS], state[QVEL]), -1).isfinite().all(-1)[:, None]
        end = {k: torch.where(is_fine, state[k], first[k]) for k in (QPOS, QVEL)}
        return end if terrain is None else end | {TERRAIN: terrain}


@dataclass(frozen=True)
class PerturbedRestStates:
    """Settled states with small random velocities and displacements.

    With them the data cover states near rest, where a model's small errors may otherwise
    grow. Velocities of the settled states are dropped, so that the data show how sliding
    begins on a steep slope. Sizes of velocity and displacement are log-uniform over four
    decades, independent of each other: a sliding cube lies as deep in the ground as a
    resting one.
    """

    settled: SettledStates
    # smallest over largest size, which is 1 m/s, 3 rad/s, 1 cm, 0.03 rad
    min_scale: float = 1e-4

    def __call__(self, count: int, generator: Generator) -> dict[str, Tensor]:
        """See `Starts`."""
        start, scene = self.settled(count, generator), self.settled.scene
        size = log_uniform(self.min_scale, 1.0, 2 * count, generator)
        size = size.reshape(2, count, 1)
        shape = (2, count, scene.model.nv)
        change = size * torch.randn(shape, dtype=torch.float64, generator=generator)
        unit = torch.full((scene.model.nv,), 3.0, dtype=torch.float64)
        if scene.base.is_floating:
            unit[scene.base.dof_address : scene.base.dof_address + 3] = 1.0
        moved = integrate_pos(scene.layout, start[QPOS], 0.01 * unit * change[0])
        return start | {QPOS: moved, QVEL: unit * change[1]}


def resample(scene: Scene, **ranges: Any) -> Scene:
    """The same robot with other fields of its `Sampling`."""
    return replace(scene, sampling=replace(scene.sampling, **ranges))


def along(scene: Scene, **ranges: Any) -> Draw:
    """Trajectories with other fields of the scene's `Sampling`."""
    return partial(simulate, resample(scene, **ranges))


def mix(*draws: Draw) -> Draw:
    """Equal shares of each, as nearly as the number of trajectories allows."""

    def draw(trajectories: int, steps: int, generator: Generator) -> TensorDict:
        ends = [trajectories * i // len(draws) for i in range(len(draws) + 1)]
        counts = [end - start for start, end in pairwise(ends)]
        shares = zip(draws, counts, strict=True)
        parts = [one(count, steps, generator) for one, count in shares if count]
        return cast(TensorDict, TensorDict.cat(parts))

    return draw


def strategy(scene: Scene, name: str) -> Draw:
    """A sampling strategy by its name.

    | name | initial states and torques |
    |---|---|
    | ``correlated`` | correlated torques, from one control step to a second |
    | ``level`` | two parts of the scene's own, one over ground that is hit vertically |
    | ``resting`` | two parts of the scene's own, one of perturbed rest states |
    | ``changing`` | equal parts of the scene's own and of robots that change |

    Raises:
        ValueError: no such strategy, or one that does not fit the scene.
    """
    own, level = along(scene), scene.sampling.level_ground
    if name == "correlated":
        times = (scene.control_step, MAX_CORRELATION_TIME)
        return along(scene, correlation_time=times)
    if name == "level" and level is not None:
        return mix(own, own, along(scene, ground=level))
    if name == "resting":
        starts = PerturbedRestStates(SettledStates(scene))
        return mix(own, own, along(scene, starts=starts))
    if name == "changing":
        if scene.variation is None:
            raise ValueError(f"expected parameters that vary, '{scene.name}' has none")
        return mix(own, partial(simulate, scene, is_changing=True))
    fitting = [s for s in get_args(Strategy) if s != "level" or level is not None]
    raise ValueError(
        f"expected a strategy of {', '.join(fitting)} for '{scene.name}', got {name}"
    )


def preset_strategy(scene: Scene) -> tuple[str, Draw] | None:
    """The strategy of a scene's preset, by name, for `generate`; None: its own ranges."""
    name = preset_of(scene.name).strategy
    return None if name is None else (name, strategy(scene, name))
