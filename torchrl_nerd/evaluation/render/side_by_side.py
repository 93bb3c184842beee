"""One task from one start in two dynamics: a policy acts in each, step by step."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import torch
from tensordict import TensorDict
from torch import Generator, Tensor
from torchrl.envs.utils import ExplorationType, set_exploration_type

from torchrl_nerd.envs import make_env
from torchrl_nerd.envs.actor import Actor
from torchrl_nerd.envs.frame_stack import frame_stack_of, stack_frames
from torchrl_nerd.evaluation.policy_transfer import model_title
from torchrl_nerd.keys import ACTION, QPOS, TERRAIN
from torchrl_nerd.scenes import Scene

FixedActions = Literal["random", "zero"]


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


@torch.no_grad()
def roll_out_both(
    task: str,
    dynamics: Sequence[str | Path],
    actor: Actor | FixedActions,
    steps: int,
    seed: int = 0,
    closed_loop: bool = True,
    device: torch.device | str = "cpu",
) -> SideBySide:
    """Roll out a task in two dynamics until the first of the two episodes ends.

    Args:
        task: id of a registered task.
        dynamics: two, as `make_env` takes them; the second one is the ground truth.
        actor: a policy, whose mean action is taken; or ``"random"`` actions, uniform in
            [-1, 1], or ``"zero"`` ones, the same in both.
        steps: of the envs, at most.
        seed: of the start and of random actions.
        closed_loop: the policy acts on each env's own observation. In open loop the first
            env repeats the actions of the second.
        device: of the envs.

    Returns:
        Both rollouts, on the CPU.
    """
    frames = 1 if isinstance(actor, str) else frame_stack_of(actor)
    envs = [stack_frames(make_env(task, x, 1, seed, device), frames) for x in dynamics]
    shown = [env.reset() for env in envs]  # one seed, one start
    terrain, generator = shown[1].get(TERRAIN, None), Generator().manual_seed(seed)
    paths = [[td[QPOS][0]] for td in shown]
    rewards, ending = [[0.0], [0.0]], "steps"
    for _ in range(steps):
        if isinstance(actor, str):
            u = 2.0 * torch.rand(envs[1].action_spec.shape, generator=generator) - 1.0
            actions = [(u if actor == "random" else 0.0 * u).to(device)] * 2
        else:
            with set_exploration_type(ExplorationType.DETERMINISTIC):
                actions = [actor(td.clone())[ACTION] for td in shown]
        if not closed_loop:
            actions[0] = actions[1]  # those of MuJoCo
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
        names=[model_title(envs[1].scene, str(name)) for name in dynamics],
        kinds=[env.dynamics.kind for env in envs],
        paths=[torch.stack(path).cpu() for path in paths],
        returns=[torch.tensor(values).cumsum(0) for values in rewards],
        terrain=None if terrain is None else terrain[0].cpu(),
        ending=ending,
    )
