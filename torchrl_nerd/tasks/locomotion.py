"""Gymnasium's locomotion tasks in any dynamics: planar robots, swimmer, ant, humanoid.

Reward, end, start and observation are those of version 5 as functions of tensors. What
its Ant and Humanoid see and pay for contact forces is left out, since learned dynamics
know none: they equal ``gymnasium.make(id, contact_cost_weight=0, ...)`` with every
``include_..._in_observation=False``. These two measure their speed between states that are
a substep old; here it is that of the states themselves.
Source: Gymnasium 1.x, ``gymnasium/envs/mujoco/*_v5.py``.
"""

from dataclasses import dataclass
from functools import cached_property
from math import inf

import torch
from torch import Tensor

from torchrl_nerd.geometry.constants import constant, placed
from torchrl_nerd.geometry.manifold import normalize_pos
from torchrl_nerd.keys import QPOS, QVEL
from torchrl_nerd.scenes import Scene, import_scene
from torchrl_nerd.tasks.body_motion import BodyMotion
from torchrl_nerd.tasks.task import State, Task, own_actuators

RARE = 1e-12  # a uniform number nearer to 0 or 1 would be an infinite normal one


@dataclass(frozen=True)
class Locomotion:
    """Numbers of one task."""

    noise: float  # half width of uniform starts about the file's pose
    ctrl_cost: float  # per squared control, summed over controls
    forward: float = 1.0  # reward per m/s along x
    healthy: float = 0.0  # reward of a step that does not end the episode
    height: tuple[float, float] | None = None  # open range of the base's, m
    angle: tuple[float, float] | None = None  # of a planar torso's pitch, rad
    largest: float = inf  # open bound of all states but the place along the track
    fastest: float = inf  # bound of the velocities that are shown
    hidden: int = 1  # leading positions that are not shown
    is_normal: bool = False  # velocities start as normal numbers times ``noise``
    by_centre: bool = False  # speed is that of the centre of mass, not of the base


TASKS = {
    "Ant-v5": Locomotion(0.1, 0.5, 1.0, 1.0, (0.2, 1.0), hidden=2, is_normal=True),
    "HalfCheetah-v5": Locomotion(0.1, 0.1, is_normal=True),
    "Hopper-v5": Locomotion(
        0.005, 1e-3, 1.0, 1.0, (0.7, inf), (-0.2, 0.2), 100.0, fastest=10.0
    ),
    "Humanoid-v5": Locomotion(
        0.01, 0.1, 1.25, 5.0, (1.0, 2.0), hidden=2, by_centre=True
    ),
    "Swimmer-v5": Locomotion(0.1, 1e-4, hidden=2),
    "Walker2d-v5": Locomotion(
        0.005, 1e-3, 1.0, 1.0, (0.8, 2.0), (-1.0, 1.0), fastest=10.0
    ),
}


class LocomotionTask(Task):
    """Run along x: ``gymnasium/Hopper-v5`` and the others in `TASKS`.

    Reward = forward * speed + healthy - ctrl_cost * sum(ctrl^2), where the speed is the
    mean over the step. A robot that falls ends its episode and earns no ``healthy``. An
    action of -1 to 1 spans the control range.

    Raises:
        ValueError: no such task.
    """

    horizon = 1000

    def __init__(self, name: str) -> None:
        env_id = name.removeprefix("gymnasium/")
        if env_id not in TASKS:
            raise ValueError(f"expected a task of {', '.join(TASKS)}, got '{env_id}'")
        self.name, self.numbers = name, TASKS[env_id]
        model = self.scene.model
        self.num_uniforms = model.nq + model.nv
        self.observation_size = model.nq + model.nv - self.numbers.hidden
        self._height_at = 2 if self.scene.base.is_floating else 1
        self._start = model.qpos0.tolist()

    def build_scene(self) -> Scene:
        """The environment's robot and its ground."""
        return import_scene(self.name)

    def initial_state(self, u: Tensor) -> dict[str, Tensor]:
        """The file's pose, moved a little; a base's quaternion is normalised."""
        noise, nq = self.numbers.noise, len(self._start)
        around = noise * (2.0 * u - 1.0)
        qpos, qvel = around.split((nq, u.shape[-1] - nq), -1)
        qpos = constant(u, self._start) + qpos
        if self.numbers.is_normal:
            qvel = noise * torch.special.ndtri(u[..., nq:].clamp(RARE, 1.0 - RARE))
        return {QPOS: normalize_pos(self.scene.layout, qpos), QVEL: qvel}

    def observation(self, state: State) -> Tensor:
        """Positions but for the place along the track, velocities."""
        limit = self.numbers.fastest
        qvel = state[QVEL].clamp(-limit, limit)
        return torch.cat((state[QPOS][..., self.numbers.hidden :], qvel), -1)

    def reward(self, state: State, action: Tensor, next_state: State) -> Tensor:
        """See the class."""
        numbers, dtype = self.numbers, state[QPOS].dtype
        ctrl = own_actuators(self).ctrl(action.to(dtype))
        moved = self._place(next_state) - self._place(state)
        earned = numbers.forward * moved / self.step_size
        earned = earned - numbers.ctrl_cost * ctrl.square().sum(-1)
        return earned + numbers.healthy * self._is_healthy(next_state)

    def terminated(self, next_state: State) -> Tensor:
        """Fallen, bool ``(*batch,)``; a cheetah and a swimmer never are."""
        return ~self._is_healthy(next_state)

    @cached_property
    def _centre(self) -> BodyMotion:
        return BodyMotion(self.scene)

    def _place(self, state: State) -> Tensor:
        """Along the track, m, ``(*batch,)``."""
        if not self.numbers.by_centre:
            return state[QPOS][..., 0]
        motion = placed(self._centre, state[QPOS])
        return motion(state[QPOS], state[QVEL]).com[..., 0]

    def _is_healthy(self, state: State) -> Tensor:
        numbers, qpos, at = self.numbers, state[QPOS], self._height_at
        healthy = torch.ones_like(qpos[..., 0], dtype=torch.bool)
        ranges = (numbers.height, at), (numbers.angle, at + 1)
        for limits, address in ranges:
            if limits is not None:
                value = qpos[..., address]
                healthy = healthy & (limits[0] < value) & (value < limits[1])
        if numbers.largest < inf:
            rest = torch.cat((qpos[..., 2:], state[QVEL]), -1)
            healthy = healthy & (rest.abs() < numbers.largest).all(-1)
        return healthy
