"""A task in the dynamics of a model."""

from pathlib import Path

import torch

from torchrl_nerd.dynamics import GuardedDynamics, Model, NeRDDynamics, dynamics_of
from torchrl_nerd.dynamics.guarded import Guard
from torchrl_nerd.dynamics.nerd import Inference
from torchrl_nerd.envs.base import SceneEnv
from torchrl_nerd.envs.resolve import resolve_model
from torchrl_nerd.robots import make_task
from torchrl_nerd.tasks import Task


class NeRDEnv(SceneEnv):
    """A `SceneEnv` on a model: learned, hybrid or analytic.

    Args:
        task: id of a registered task, or a task.
        model: a model, or the name of one, see `resolve_model`.
        num_envs: how many envs step together.
        seed: of the resets.
        device: where the model and all tensors live.
        inference: ``"streaming"`` or ``"window"``; see `NeRDDynamics`.
        guard: what to do with steps far from the training data, see `GuardedDynamics`;
            None steps all alike.
        dump_dir: see `SceneEnv`.
        differentiable: record gradients through every step, to actions and states, and to
            the weights where they ask for them.

    TorchRL's ``compile=True`` makes each step one compiled piece, see `SceneEnv.compile`.

    Raises:
        ValueError: no such task or model, or a guard of a model without training data.

    Examples:
        >>> env = NeRDEnv("cartpole/swingup", num_envs=3)
        >>> env.rollout(5, break_when_any_done=False)["next", "qpos"].shape
        torch.Size([3, 5, 2])
    """

    def __init__(
        self,
        task: str | Task,
        model: Model | str | Path = "nerd",
        num_envs: int = 1,
        seed: int = 0,
        device: torch.device | str = "cpu",
        inference: Inference = "streaming",
        guard: Guard | None = None,
        dump_dir: Path | None = None,
        differentiable: bool = False,
    ) -> None:
        task = make_task(task) if isinstance(task, str) else task
        if isinstance(model, (str, Path)):
            model = resolve_model(model, task.scene)
        dynamics = dynamics_of(
            model.to(device), differentiable=differentiable, inference=inference
        )
        if guard is not None:
            if not isinstance(dynamics, NeRDDynamics):
                raise ValueError(
                    "expected a guard of a learned or hybrid model, got an analytic step"
                )
            dynamics = GuardedDynamics(dynamics, guard)
        super().__init__(task, dynamics, num_envs, seed, device, dump_dir)
