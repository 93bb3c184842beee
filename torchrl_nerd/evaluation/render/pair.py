"""The same start and actions in learned and in true dynamics, step by step."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Generator, Tensor
from torchrl.envs.utils import ExplorationType, set_exploration_type

from torchrl_nerd.envs import make_env
from torchrl_nerd.envs.actor import Actor
from torchrl_nerd.envs.base import SceneEnv
from torchrl_nerd.envs.frame_stack import stack_frames
from torchrl_nerd.evaluation.rollout_error import position_errors
from torchrl_nerd.keys import ACTION, QPOS, TERRAIN
from torchrl_nerd.scenes import Scene
from torchrl_nerd.tasks import Task

Idle = Literal["random", "zero"]
Act = Callable[[int, TensorDictBase], Tensor]
"""``(step, what the env shows) -> action (1, num_actions)``."""


@dataclass(frozen=True, eq=False)
class Pair:
    """One episode in both dynamics.

    | field | meaning |
    |---|---|
    | ``scene`` | the robot |
    | ``step_size`` | time between states, s |
    | ``learned``, ``truth`` | ``qpos (steps + 1, nq)``, the start first |
    | ``terrain`` | ``(terrain.size,)`` where the ground varies, else None |
    | ``errors`` | ``(steps + 1,)`` by quantity, see `position_errors` |
    | ``returns`` | sum of rewards, learned and true |
    | ``ending`` | why it stops: ``steps``, ``horizon`` or ``terminated`` (in truth) |
    """

    scene: Scene
    step_size: float
    learned: Tensor
    truth: Tensor
    terrain: Tensor | None
    errors: dict[str, Tensor]
    returns: tuple[float, float]
    ending: str

    @property
    def seconds(self) -> float:
        """How long it lasts."""
        return self.step_size * (len(self.truth) - 1)


def idle(task: Task, steps: int, seed: int, kind: Idle) -> Act:
    """Actions that look at nothing: uniform in [-1, 1], or zero."""
    shape = (steps, 1, task.controller.num_actions)
    actions = torch.zeros(shape)
    if kind == "random":
        generator = Generator().manual_seed(seed)
        actions = 2.0 * torch.rand(shape, generator=generator) - 1.0
    return lambda step, shown: actions[step]


def follow(actor: Actor) -> Act:
    """A policy's mean action for what it is shown."""

    def act(step: int, shown: TensorDictBase) -> Tensor:
        with set_exploration_type(ExplorationType.DETERMINISTIC):
            return actor(shown.clone())[ACTION]

    return act


@torch.no_grad()
def play_pair(
    task: str,
    model: str | Path,
    act: Act,
    steps: int,
    seed: int = 0,
    own_actions: bool = False,
    device: torch.device | str = "cpu",
    frame_stack: int = 1,
) -> Pair:
    """Both dynamics from one start of the task, until the true episode ends.

    Args:
        task: id of a registered task.
        model: what `make_env` takes for learned dynamics: ``"nerd"`` or a folder.
        act: chooses the actions, shown the true state.
        steps: of the env, at most.
        seed: of the start.
        own_actions: show each dynamics' own state and act on it, so that a policy can
            mend what the model gets wrong; by default both get the same actions.
        device: of the envs, and of what ``act`` is shown.
        frame_stack: how many observations ``act`` is shown, see `stack_frames`.

    Returns:
        The episode, on the processor.
    """
    learned, truth = (
        stack_frames(make_env(task, name, 1, seed, device), frame_stack)
        for name in (model, "mujoco")
    )
    shown = [learned.reset(), truth.reset()]  # one seed, one start
    terrain = shown[1].get(TERRAIN, None)
    paths: list[list[Tensor]] = [[td[QPOS]] for td in shown]
    returns, ending = [0.0, 0.0], "steps"
    for step in range(steps):
        action = act(step, shown[1])
        actions = (act(step, shown[0]) if own_actions else action, action)
        for side, (env, chosen) in enumerate(
            zip((learned, truth), actions, strict=True)
        ):
            shown[side] = _step(env, chosen)
            paths[side].append(shown[side][QPOS])
            returns[side] += float(shown[side]["reward"])
        if shown[1]["done"].item():
            ending = "terminated" if shown[1]["terminated"].item() else "horizon"
            break
    positions = [torch.cat(path).cpu() for path in paths]
    scene = truth.scene
    return Pair(
        scene=scene,
        step_size=scene.control_step * truth.task.frame_skip,
        learned=positions[0],
        truth=positions[1],
        terrain=None if terrain is None else terrain[0].cpu(),
        errors=position_errors(scene, positions[1], positions[0]),
        returns=(returns[0], returns[1]),
        ending=ending,
    )


def _step(env: SceneEnv, action: Tensor) -> TensorDictBase:
    shown = TensorDict({ACTION: action}, env.batch_size, device=env.device)
    return env.step(shown)["next"]
