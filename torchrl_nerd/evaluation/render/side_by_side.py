"""One task from one start in two dynamics: a policy acts in each, step by step."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Generator, Tensor
from torchrl.envs.utils import ExplorationType, set_exploration_type

from torchrl_nerd.checkpoint import shipped_models
from torchrl_nerd.envs import make_env
from torchrl_nerd.envs.actor import Actor
from torchrl_nerd.envs.frame_stack import stack_frames
from torchrl_nerd.keys import ACTION, QPOS, TERRAIN
from torchrl_nerd.scenes import Scene
from torchrl_nerd.tasks import Task

TITLES = {"mujoco": "MuJoCo", "mujoco_warp": "MuJoCo Warp"}
FixedActions = Literal["random", "zero"]
Act = Callable[[int, TensorDictBase], Tensor]
"""``(step, what the env returned) -> action (1, num_actions)``."""


@dataclass(frozen=True, eq=False)
class SideBySide:
    """Two rollouts of one task from one start.

    | field | meaning |
    |---|---|
    | ``scene`` | the robot |
    | ``step_size`` | time between states, s |
    | ``names``, ``kinds`` | of the dynamics; a kind is such as ``"learned"`` |
    | ``paths`` | ``qpos (steps + 1, nq)`` of each, the start first |
    | ``returns`` | ``(steps + 1,)`` of each, sum of the rewards so far |
    | ``terrain`` | ``(terrain.size,)`` where it varies from env to env, else None |
    | ``ending`` | ``"steps"``, or the dynamics whose episode ended first and how |
    """

    scene: Scene
    step_size: float
    names: Sequence[str]
    kinds: Sequence[str]
    paths: Sequence[Tensor]
    returns: Sequence[Tensor]
    terrain: Tensor | None
    ending: str

    @property
    def seconds(self) -> float:
        """Simulated time."""
        return self.step_size * (len(self.paths[0]) - 1)


def fixed_actions(task: Task, steps: int, seed: int, kind: FixedActions) -> Act:
    """Actions that do not depend on the state: uniform in [-1, 1], or zero."""
    shape = (steps, 1, task.controller.num_actions)
    actions = torch.zeros(shape)
    if kind == "random":
        actions.uniform_(-1.0, 1.0, generator=Generator().manual_seed(seed))
    return lambda step, shown: actions[step]


def policy_actions(actor: Actor) -> Act:
    """The mean action of a policy."""

    def act(step: int, shown: TensorDictBase) -> Tensor:
        with set_exploration_type(ExplorationType.DETERMINISTIC):
            return actor(shown.clone())[ACTION]

    return act


@torch.no_grad()
def roll_out_both(
    task: str,
    dynamics: Sequence[str | Path],
    act: Act,
    steps: int,
    seed: int = 0,
    closed_loop: bool = True,
    device: torch.device | str = "cpu",
    frame_stack: int = 1,
) -> SideBySide:
    """Roll out a task in two dynamics until the first of the two episodes ends.

    Args:
        task: id of a registered task.
        dynamics: two, as `make_env` takes them; by convention the second is ``"mujoco"``.
        act: chooses the actions.
        steps: of the envs, at most.
        seed: of the start.
        closed_loop: ``act`` sees each env's own observation. In open loop the first env
            repeats the actions of the second.
        device: of the envs.
        frame_stack: how many observations ``act`` sees, see `stack_frames`.

    Returns:
        Both rollouts, on the CPU.
    """
    envs = [
        stack_frames(make_env(task, name, 1, seed, device), frame_stack)
        for name in dynamics
    ]
    shown = [env.reset() for env in envs]  # one seed, one start
    terrain = shown[1].get(TERRAIN, None)
    paths = [[td[QPOS][0]] for td in shown]
    rewards, ending = [[0.0], [0.0]], "steps"
    for step in range(steps):
        actions = [act(step, shown[1])] * 2
        if closed_loop:
            actions[0] = act(step, shown[0])
        for i, (env, action) in enumerate(zip(envs, actions, strict=True)):
            td = TensorDict({ACTION: action}, env.batch_size, device=env.device)
            shown[i] = env.step(td)["next"]
            paths[i].append(shown[i][QPOS][0])
            rewards[i].append(float(shown[i]["reward"]))
        over = [i for i in (1, 0) if shown[i]["done"].item()]
        if over:
            how = "terminated" if shown[over[0]]["terminated"].item() else "truncated"
            ending = f"{dynamics[over[0]]} {how}"
            break
    return SideBySide(
        scene=envs[1].scene,
        step_size=envs[1].scene.control_step * envs[1].task.frame_skip,
        names=[model_title(name, envs[1].scene) for name in dynamics],
        kinds=[env.dynamics.kind for env in envs],
        paths=[torch.stack(path).cpu() for path in paths],
        returns=[torch.tensor(values).cumsum(0) for values in rewards],
        terrain=None if terrain is None else terrain[0].cpu(),
        ending=ending,
    )


def model_title(dynamics: str | Path, scene: Scene) -> str:
    """The shipped model that a name stands for, ``"ant-mlp"`` for ``"nerd"``."""
    name = str(dynamics)
    asked = {"nerd": scene.name, "hybrid": f"{scene.name}-hybrid"}.get(name, name)
    found = [x for x in (asked, f"{asked}-mlp") if x in shipped_models()]
    return TITLES.get(name, next(iter(found), name))
