"""A task in learned dynamics."""

from pathlib import Path

import torch

from torchrl_nerd.checkpoint import from_pretrained
from torchrl_nerd.dynamics.guarded import Guard, GuardedDynamics
from torchrl_nerd.dynamics.nerd import Inference, NeRDDynamics
from torchrl_nerd.envs.base import SceneEnv
from torchrl_nerd.modules.nerd import NeRD
from torchrl_nerd.robots import make_task
from torchrl_nerd.tasks import Task


class NeRDEnv(SceneEnv):
    """A `SceneEnv` on `NeRDDynamics`.

    Args:
        task: id of a registered task, or a task.
        model: a model, a checkpoint folder, or None for the one that is shipped.
        num_envs: rows.
        seed: of the resets.
        device: where the model and all tensors live.
        inference: ``"streaming"`` or ``"window"``; see `NeRDDynamics`.
        guard: what to do with steps far from the training data, see `GuardedDynamics`;
            None steps all alike.
        dump_dir: see `SceneEnv`.
        differentiable: record gradients through every step, to actions and states, and to
            the weights where they ask for them.

    TorchRL's ``compile=True`` makes each step one compiled piece, see `SceneEnv.compile`.

    Examples:
        >>> env = NeRDEnv("cartpole/swingup", num_envs=3)
        >>> env.rollout(5, break_when_any_done=False)["next", "qpos"].shape
        torch.Size([3, 5, 2])
    """

    def __init__(
        self,
        task: str | Task,
        model: NeRD | str | Path | None = None,
        num_envs: int = 1,
        seed: int = 0,
        device: torch.device | str = "cpu",
        inference: Inference = "streaming",
        guard: Guard | None = None,
        dump_dir: Path | None = None,
        differentiable: bool = False,
    ) -> None:
        task = make_task(task) if isinstance(task, str) else task
        if not isinstance(model, NeRD):
            model = from_pretrained(model or task.scene.name, task.scene)
        learned = NeRDDynamics(
            model.to(device),
            inference=inference,
            differentiable=differentiable,
        )
        dynamics = learned if guard is None else GuardedDynamics(learned, guard)
        super().__init__(task, dynamics, num_envs, seed, device, dump_dir)
