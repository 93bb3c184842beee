"""Initial states of training data: task resets, settled and perturbed rest states."""

from dataclasses import dataclass
from typing import cast

import torch
from tensordict import TensorDict
from torch import Generator, Tensor

from torchrl_nerd.dynamics import MujocoDynamics
from torchrl_nerd.geometry.manifold import integrate_pos
from torchrl_nerd.keys import QPOS, QVEL, TERRAIN
from torchrl_nerd.scenes import Scene
from torchrl_nerd.scenes.sampling import log_uniform
from torchrl_nerd.tasks import Task


@dataclass(frozen=True)
class TaskResets:
    """Initial states of a task's episodes.

    The task's terrain is not used, since models may be tested on it: where the terrain
    varies, the scene's sampling draws it.
    """

    task: Task

    def __call__(self, rows: int, generator: Generator) -> dict[str, Tensor]:
        """See `Starts`."""
        size = (rows, self.task.num_uniforms)
        u = torch.rand(size, dtype=torch.float64, generator=generator)
        state = self.task.initial_state(u)
        return {QPOS: state[QPOS], QVEL: state[QVEL]}


@dataclass(frozen=True)
class SettledStates:
    """States in which the robot has come to rest: the ends of passive trajectories.

    | field | meaning |
    |---|---|
    | ``scene`` | the robot, whose sampling gives the initial states |
    | ``seconds`` | length of the trajectories |
    """

    scene: Scene
    seconds: float = 3.0

    def __call__(self, rows: int, generator: Generator) -> dict[str, Tensor]:
        """See `Starts`; a trajectory that diverges gives its initial state."""
        start, _ = self.scene.sample_initial(rows, generator)
        terrain = start.pop(TERRAIN, None)
        first = TensorDict(start, [rows])
        dynamics = MujocoDynamics(self.scene)
        idle = torch.zeros(rows, len(self.scene.actuated), dtype=torch.float64)
        dynamics.reset(first)
        state = first
        for _ in range(round(self.seconds / self.scene.control_step)):
            state = cast(TensorDict, dynamics.step(state, idle, terrain))
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

    | field | meaning |
    |---|---|
    | ``settled`` | the rest states |
    | ``min_scale`` | smallest over largest size, which is 1 m/s, 3 rad/s, 1 cm, 0.03 rad |
    """

    settled: SettledStates
    min_scale: float = 1e-4

    def __call__(self, rows: int, generator: Generator) -> dict[str, Tensor]:
        """See `Starts`."""
        start, scene = self.settled(rows, generator), self.settled.scene
        size = log_uniform(self.min_scale, 1.0, 2 * rows, generator).reshape(2, rows, 1)
        shape = (2, rows, scene.model.nv)
        push = size * torch.randn(shape, dtype=torch.float64, generator=generator)
        unit = torch.full((scene.model.nv,), 3.0, dtype=torch.float64)
        if scene.base.is_floating:
            unit[scene.base.dof_address : scene.base.dof_address + 3] = 1.0
        moved = integrate_pos(scene.layout, start[QPOS], 0.01 * unit * push[0])
        return start | {QPOS: moved, QVEL: unit * push[1]}
