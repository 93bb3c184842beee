"""One argument switches between ground truth, learned, hybrid and analytic dynamics."""

import copy
from pathlib import Path
from typing import Any

import torch

from torchrl_nerd.analytic import STEPS, UnconstrainedStep
from torchrl_nerd.checkpoint import (
    CARD,
    from_pretrained,
    model_folder,
    model_name,
    shipped_models,
)
from torchrl_nerd.dynamics import (
    ENGINES,
    Guard,
    GuardedDynamics,
    Inference,
    Model,
    NeRDDynamics,
    dynamics_of,
)
from torchrl_nerd.envs.base import SceneEnv
from torchrl_nerd.envs.pixels import image_size
from torchrl_nerd.files import read_json
from torchrl_nerd.geometry.constants import cast_constants
from torchrl_nerd.robots import make_task
from torchrl_nerd.scenes import Scene
from torchrl_nerd.settings import expect_device, look_up
from torchrl_nerd.tasks import Task


class GroundTruthEnv(SceneEnv):
    """A `SceneEnv` on MuJoCo's batched rollout, dm_control's `Physics` or MuJoCo Warp.

    Args:
        task: id of a registered task, a scene, or a task.
        engine: ``"mujoco"``, ``"dm_control"`` or ``"mujoco_warp"`` (extra ``warp``).
        num_envs, seed, dump_dir, state_dtype: see `SceneEnv`.
        device: where all tensors live, and MuJoCo Warp runs; the others use the CPU.

    Raises:
        ValueError: an unknown engine, or one that cannot step this scene.
        ModuleNotFoundError: MuJoCo Warp is asked for and not installed.

    Examples:
        >>> env = GroundTruthEnv("cartpole/swingup", num_envs=3)
        >>> env.rollout(5, break_when_any_done=False)["next", "qpos"].shape
        torch.Size([3, 5, 2])
    """

    def __init__(
        self,
        task: str | Path | Scene | Task,
        engine: str = "mujoco",
        num_envs: int = 1,
        seed: int | None = None,
        device: torch.device | str = "cpu",
        dump_dir: Path | str | None = None,
        state_dtype: torch.dtype = torch.float64,
    ) -> None:
        make = look_up("engine", engine, ENGINES)
        task = make_task(task)
        dynamics = make(task.scene, expect_device(str(device), state_dtype))
        super().__init__(task, dynamics, num_envs, seed, device, dump_dir, state_dtype)


class NeRDEnv(SceneEnv):
    """A `SceneEnv` on a model: learned, hybrid or analytic.

    TorchRL's ``compile=True`` makes each step one compiled piece, see `SceneEnv.compile`.

    Args:
        task: id of a registered task, a scene, or a task.
        model: a model, which is moved to the device and set to evaluate, or the name of
            one, see `from_pretrained`.
        num_envs, seed, dump_dir: see `SceneEnv`.
        state_dtype: of state and features; float32 for GPUs without a fast float64, or
            without any, such as ``mps``. The model given is copied.
        device: where the model and all tensors live.
        inference: ``"streaming"`` or ``"window"``; see `NeRDDynamics`.
        guard: what to do with steps far from the training data, see `GuardedDynamics`;
            None steps all alike.
        differentiable: record gradients through every step, to actions and states, and to
            the weights where they ask for them.

    Raises:
        ValueError: no such task or model, one of a single robot for a task that varies, or
            an option of networks for an analytic step.

    Examples:
        >>> env = NeRDEnv("cartpole/swingup", num_envs=3)
        >>> env.rollout(5, break_when_any_done=False)["next", "qpos"].shape
        torch.Size([3, 5, 2])
    """

    @torch.inference_mode(False)
    def __init__(
        self,
        task: str | Path | Scene | Task,
        model: Model | str | Path = "nerd",
        num_envs: int = 1,
        seed: int | None = None,
        device: torch.device | str = "cpu",
        inference: Inference = "streaming",
        guard: Guard | None = None,
        dump_dir: Path | str | None = None,
        differentiable: bool = False,
        state_dtype: torch.dtype = torch.float64,
    ) -> None:
        task = make_task(task)
        name = type(model).__name__
        if not isinstance(model, Model):
            given, model = model, from_pretrained(model, task.scene)
            if task.scene.variation is not None:
                _expect_varied(given, task.scene)
            name = model_name(given, task.scene)
        elif task.scene.variation is not None and model.kind == "analytic":
            _expect_varied("analytic", task.scene)
        if state_dtype == torch.float32:
            kept = {id(model.scene): model.scene}
            model = cast_constants(copy.deepcopy(model, kept), state_dtype)
        model = model.to(expect_device(str(device), state_dtype))
        how = {"differentiable": differentiable, "inference": inference}
        if isinstance(model, UnconstrainedStep) and len(task.scene.contacts):
            raise ValueError(
                f"expected dynamics that know the ground of '{task.scene.name}', got "
                f"'{name}', by which the robot falls through it"
            )
        dynamics = dynamics_of(model, **how)
        if not isinstance(dynamics, NeRDDynamics):
            _refuse_network_options(name, guard, inference)
        elif guard is not None:
            dynamics = GuardedDynamics(dynamics, guard)
        super().__init__(task, dynamics, num_envs, seed, device, dump_dir, state_dtype)
        self.model_name = name


def make_env(
    task: str | Path | Scene | Task,
    dynamics: str | Path = "nerd",
    num_envs: int = 1,
    seed: int | None = None,
    device: torch.device | str = "cpu",
    guard: Guard | None = None,
    dump_dir: Path | str | None = None,
    compile: bool = False,
    differentiable: bool = False,
    from_pixels: bool = False,
    pixels_only: bool = False,
    render_size: int | tuple[int, int] = (240, 320),
    camera_id: int | str | None = None,
    state_dtype: torch.dtype = torch.float64,
) -> SceneEnv:
    """A batched env of a task in the dynamics of your choice.

    Args:
        task: id of a registered task, ``dm_control/DOMAIN-TASK``, ``gymnasium/ID``, a
            task, or a scene or MJCF file, which becomes a `SceneTask`; see `make_task`.
        dynamics: ``"nerd"`` (learned), ``"hybrid"``, ``"analytic"``, ``"mujoco"``,
            ``"dm_control"``, ``"mujoco_warp"`` (extra ``warp``), a shipped model's name, an
            analytic step's name, or a checkpoint folder.
        num_envs: how many envs step together.
        seed: of the resets; drawn where none is given.
        device: where all tensors live.
        guard: see `NeRDEnv`; of learned and hybrid dynamics alone.
        dump_dir: see `SceneEnv`.
        compile: make one compiled piece of controller, model, reward and observation, see
            `SceneEnv.compile`; engines stay as they are.
        differentiable: record gradients through every step; not of engines.
        from_pixels: show ``pixels (num_envs, height, width, 3)``, uint8, of every state.
        pixels_only: instead of all else that an agent could see.
        render_size: height and width of an image, or one number for both, pixels.
        camera_id: of an image; see `envs.rendering.Renderer`.
        state_dtype: ``torch.float32`` for GPUs without a fast float64, or without any.

    Raises:
        ValueError: unknown task or dynamics, or an option that the dynamics does not have,
            in one sentence.
        ModuleNotFoundError: MuJoCo Warp is asked for and not installed.
    """
    shared = num_envs, seed, device
    if isinstance(dynamics, str) and dynamics in ENGINES:
        if differentiable:
            wanted = "learned, hybrid or analytic dynamics for gradients"
            raise ValueError(f"expected {wanted}, got '{dynamics}'")
        _refuse_network_options(dynamics, guard)
        env: SceneEnv = GroundTruthEnv(task, dynamics, *shared, dump_dir, state_dtype)
    else:
        how: dict[str, Any] = {"guard": guard, "dump_dir": dump_dir}
        how |= {"differentiable": differentiable, "state_dtype": state_dtype}
        env = NeRDEnv(task, dynamics, *shared, **how)
        if compile:
            env.compile()
    env.render_size, env.camera_id = image_size(render_size), camera_id
    if pixels_only and not from_pixels:
        raise ValueError("expected from_pixels=True with pixels_only=True, got False")
    if from_pixels:
        env.add_pixels(pixels_only)
    return env


def _refuse_network_options(
    dynamics: str | Path, guard: str | None, inference: str = "streaming"
) -> None:
    """Refuse what dynamics without a network would ignore."""
    if guard is not None or inference != "streaming":
        option = f"inference '{inference}'" if guard is None else f"guard '{guard}'"
        wanted = f"learned or hybrid dynamics for {option}"
        raise ValueError(f"expected {wanted}, got '{dynamics}'")


def _expect_varied(name: str | Path, scene: Scene) -> None:
    """Raise ValueError where a model of that name steps one robot, and the scene's vary."""
    found = model_name(name, scene)
    folder = model_folder(found) if found in shipped_models() else Path(found)
    is_analytic = found == "analytic" or found in STEPS
    if is_analytic or not read_json(folder / CARD).get("variation"):
        raise ValueError(
            f"expected a model that learned on varied robots for the varied scene "
            f"'{scene.name}', got '{name}', which steps one robot"
        )
