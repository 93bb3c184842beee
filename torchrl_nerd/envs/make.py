"""One argument switches between ground truth, learned, hybrid and analytic dynamics."""

from pathlib import Path
from typing import cast

import torch

from torchrl_nerd.dynamics.guarded import Guard
from torchrl_nerd.envs.base import SceneEnv
from torchrl_nerd.envs.ground_truth import ENGINES, Engine, GroundTruthEnv
from torchrl_nerd.envs.nerd import NeRDEnv
from torchrl_nerd.tasks import Task


def make_env(
    task: str | Task,
    dynamics: str | Path = "nerd",
    num_envs: int = 1,
    seed: int = 0,
    device: torch.device | str = "cpu",
    guard: Guard | None = None,
    dump_dir: Path | None = None,
    compile: bool = False,
    differentiable: bool = False,
) -> SceneEnv:
    """A batched env of a task in the dynamics of your choice.

    Args:
        task: id of a registered task, or a task.
        dynamics: ``"nerd"`` (learned), ``"hybrid"``, ``"analytic"``, ``"mujoco"``,
            ``"dm_control"``, ``"mujoco_warp"`` (extra ``warp``), a shipped model's name, an
            analytic step's name, or a checkpoint folder; see `make_dynamics`.
        num_envs: how many envs step together.
        seed: of the resets.
        device: where all tensors live.
        guard: what to do with steps that the model was not trained for, see
            `GuardedDynamics`; ground truth has nothing to guard against.
        dump_dir: where the first fault of each kind leaves a dump for `nerd replay`.
        compile: make one compiled piece of controller, model, reward and observation, see
            `SceneEnv.compile`; engines stay as they are.
        differentiable: record gradients through every step of a model.

    Raises:
        ValueError: unknown task or dynamics, or gradients of an engine, in one sentence.
        ModuleNotFoundError: MuJoCo Warp is asked for and not installed.
    """
    if dynamics in ENGINES:
        if differentiable:
            raise ValueError(
                f"expected learned, hybrid or analytic dynamics for gradients, got "
                f"'{dynamics}'"
            )
        engine = cast(Engine, dynamics)
        return GroundTruthEnv(task, engine, num_envs, seed, device, dump_dir)
    env = NeRDEnv(
        task,
        dynamics,
        num_envs,
        seed,
        device,
        guard=guard,
        dump_dir=dump_dir,
        differentiable=differentiable,
    )
    return env.compile() if compile else env
