"""Tasks: where episodes start, what the policy sees, what it earns, when they end."""

import copy
from abc import ABC, abstractmethod
from collections.abc import Mapping
from functools import cached_property
from typing import Self

import torch
from mujoco import MjData, MjModel
from torch import Generator, Tensor

from torchrl_nerd.keys import QPOS, QVEL, TERRAIN
from torchrl_nerd.scenes import Scene
from torchrl_nerd.scenes.controllers import ActuatorController, Controller
from torchrl_nerd.scenes.variation import Ranges

NUM_STARTS = 4096  # of a `SceneTask`

State = Mapping[str, Tensor]
"""``qpos (*batch, nq)``, ``qvel (*batch, nv)`` and the task's parameters; after a step
also the ``action`` that led there and, where the dynamics feels forces, ``sensordata``. A
TensorDict is one."""


class Task(ABC):
    """Pure functions of the state; the same ones for all dynamics."""

    horizon: int  # actions after which an episode is truncated
    num_uniforms: int  # random numbers that one reset takes
    observation_size: int  # width of the observation
    frame_skip: int = 1  # control steps over which an action is held
    parameters: Mapping[str, int] = {}  # drawn at a reset and kept, key -> width

    @cached_property
    def scene(self) -> Scene:
        """The robot and its ground; the same object at every call."""
        return self.build_scene()

    @abstractmethod
    def build_scene(self) -> Scene:
        """What `scene` keeps; of a registered robot, the same object at every call."""

    def vary(self, ranges: Ranges) -> "Task":
        """The same task with a scene whose parameters differ, see `Scene.vary`.

        An env draws them for every episode.
        """
        return self.with_scene(self.scene.vary(ranges))

    def with_scene(self, scene: Scene) -> Self:
        """The same task in another scene of the same robot.

        Raises ValueError where its joints or its motors are others.
        """
        own, other = ([*s.model.jnt_type, s.actuated] for s in (self.scene, scene))
        if own != other:
            raise ValueError(
                f"expected a scene of the robot of '{self.scene.name}', got another robot "
                f"in '{scene.name}'"
            )
        twin = copy.copy(self)
        for name in [*vars(twin)]:  # what was made of the other scene
            if isinstance(getattr(type(twin), name, None), cached_property):
                del vars(twin)[name]
        vars(twin)["scene"] = scene  # in place of `build_scene`'s
        return twin

    @property
    def controller(self) -> Controller:
        """What turns the action into torque; the scene's own unless a task has one."""
        return self.scene.controller

    @property
    def step_size(self) -> float:
        """Time between two observations, s."""
        return self.scene.control_step * self.frame_skip

    @abstractmethod
    def initial_state(self, u: Tensor) -> dict[str, Tensor]:
        """Initial states, float64, from uniform numbers ``(*batch, num_uniforms)``."""

    @abstractmethod
    def observation(self, state: State) -> Tensor:
        """What the policy sees, ``(*batch, observation_size)``, float64."""

    def reward(self, state: State, action: Tensor, next_state: State) -> Tensor:
        """What the step earned, ``(*batch,)``, float64; by default zero."""
        return torch.zeros_like(next_state[QVEL][..., 0])

    def terminated(self, next_state: State) -> Tensor:
        """Where the episode failed or succeeded, bool ``(*batch,)``; by default never."""
        return torch.zeros_like(next_state[QVEL][..., 0], dtype=torch.bool)

    def show(self, model: MjModel, data: MjData, state: State) -> None:  # noqa: B027
        """Put what the task draws at a reset into an image; by default nothing.

        ``model`` is a copy that only images are drawn with; joint positions and ground are
        set in its ``data``. The ``state`` of one env: ``qpos (nq,)`` and parameters.
        """


class SceneTask(Task):
    """Zero reward, never terminated; the observation is ``qpos`` and ``qvel``.

    An episode starts in one of 4096 states that are drawn as those of training data, see
    `Scene.sample_initial`, and has 1000 control steps. Subclass it to give a robot of your
    own a reward.

    Raises:
        ValueError: no state within the scene's ranges is clear of the ground.

    Examples:
        >>> task = SceneTask(Scene.from_gymnasium("HalfCheetah-v5"))
        >>> task.observation_size
        18
    """

    num_uniforms = 1
    horizon = 1000  # as most tasks of the dm_control suite

    def __init__(self, scene: Scene) -> None:
        self.name, self._given = scene.name, scene
        self.observation_size = scene.model.nq + scene.model.nv
        self._draw_starts(scene)

    @torch.inference_mode(False)
    def _draw_starts(self, scene: Scene) -> None:
        """States to begin in, and what an episode keeps of them."""
        seeded = Generator().manual_seed(0)
        self.starts, _ = scene.sample_initial(NUM_STARTS, seeded)
        size = (
            {TERRAIN: self.starts[TERRAIN].shape[1]} if TERRAIN in self.starts else {}
        )
        others = {key: n for key, n in self.parameters.items() if key != TERRAIN}
        self.parameters = others | size

    def with_scene(self, scene: Scene) -> Self:
        """The same task in another scene of the same robot.

        Starts are drawn anew where only one ground varies from env to env. Raises
        ValueError where its joints or its motors are others.
        """
        twin = super().with_scene(scene)
        varies = scene.terrain is not None and scene.terrain.is_per_env
        if varies != (TERRAIN in self.starts):
            twin._draw_starts(scene)
        return twin

    def build_scene(self) -> Scene:
        """The scene that was given."""
        return self._given

    def initial_state(self, u: Tensor) -> dict[str, Tensor]:
        """One of ``starts`` for each u."""
        chosen = (u[..., 0] * NUM_STARTS).long().clamp_max(NUM_STARTS - 1)
        return {key: x.to(u.device)[chosen] for key, x in self.starts.items()}

    def observation(self, state: State) -> Tensor:
        """``qpos`` and ``qvel``, ``(*batch, nq + nv)``."""
        return torch.cat((state[QPOS], state[QVEL]), -1)


def own_actuators(task: Task) -> ActuatorController:
    """The controller of a task that leaves the robot to MuJoCo's own actuators.

    Raises:
        ValueError: it has another one.
    """
    controller = task.controller
    if not isinstance(controller, ActuatorController):
        raise ValueError(
            f"expected the robot's own actuators, whose controls {type(task).__name__} of "
            f"scene '{task.scene.name}' counts, got a {type(controller).__name__}"
        )
    return controller
