"""Learned models whose history matters, and envs in every dynamics, for the tests."""

import json
from collections.abc import Mapping
from functools import cache
from pathlib import Path
from shutil import which

import pytest
import torch
from tensordict import TensorDict
from tensordict.utils import NestedKey
from torch import Generator, Tensor, nn

from torchrl_nerd import GroundTruthEnv, NeRDEnv
from torchrl_nerd.checkpoint import CARD
from torchrl_nerd.data.generate import is_sound, simulate
from torchrl_nerd.dynamics import (
    DMControlDynamics,
    Dynamics,
    MujocoDynamics,
    MujocoWarpDynamics,
    NeRDDynamics,
)
from torchrl_nerd.dynamics.warp_setup import is_warp_installed
from torchrl_nerd.envs.base import SceneEnv
from torchrl_nerd.envs.streams import row_keys, stream_offsets, uniforms
from torchrl_nerd.modules.correction import FreeConfig
from torchrl_nerd.modules.free import FreeNeRD
from torchrl_nerd.analytic.penalty_contact import PenaltyContactStep
from torchrl_nerd.modules.nerd import NeRD
from torchrl_nerd.modules.networks import NETWORKS, STEPS
from torchrl_nerd.robots import SCENES, load_scene, make_task
from torchrl_nerd.scenes import Scene
from torchrl_nerd.training.sequences import cover, data_stats
from torchrl_nerd.transforms import Stats

HAS_COMPILER = any(map(which, ("g++", "clang++")))  # what inductor looks for

LEARNED = ("streaming", "window")
TRUE = ("mujoco", "dm_control")
DYNAMICS = (*LEARNED, *TRUE)
WARP = pytest.param("mujoco_warp", marks=pytest.mark.slow)

each_dynamics = pytest.mark.parametrize("dynamics", DYNAMICS)
warp_too = pytest.mark.parametrize(
    "dynamics", (*DYNAMICS, WARP) if is_warp_installed() else DYNAMICS
)
"""With MuJoCo Warp where it is installed, on the CPU, where it takes minutes."""


def is_free(scene: Scene) -> bool:
    """Whether nothing but a `UnconstrainedStep` moves the robot."""
    try:
        FreeNeRD(scene, FreeConfig())
    except ValueError:
        return False
    return True


def is_grounded(scene: Scene, parts: int = 1) -> bool:
    """Whether a `PenaltyContactStep` of so many parts can move the robot."""
    try:
        PenaltyContactStep(scene, parts=parts)
    except ValueError:
        return False
    return True


FREE = [load_scene(name) for name in SCENES if is_free(load_scene(name))]
GROUNDED = [load_scene(name) for name in SCENES if is_grounded(load_scene(name))]
STEPPED = [
    (scene, name)
    for name, config in STEPS.items()
    for scene in (FREE if isinstance(config, FreeConfig) else GROUNDED)
    if isinstance(config, FreeConfig) or is_grounded(scene, config.parts)
]
each_free = pytest.mark.parametrize("scene", FREE, ids=lambda scene: scene.name)
each_grounded = pytest.mark.parametrize("scene", GROUNDED, ids=lambda scene: scene.name)
each_stepped = pytest.mark.parametrize(
    ("scene", "network"), STEPPED, ids=lambda x: getattr(x, "name", x)
)
"""Every robot that a step moves, with the name of the network that corrects it."""


def enliven(network: nn.Module, generator: Generator) -> nn.Module:
    """Weights large enough that every input, history included, shows in the output."""
    with torch.no_grad():
        for name, weight in network.named_parameters():
            noise = torch.randn(weight.shape, generator=generator)
            if "offset_bias" in name:
                weight.copy_(noise)
            elif weight.ndim == 2:
                weight.copy_(noise / weight.shape[1] ** 0.5)
            elif "norm" in name:
                weight.copy_(1.0 + 0.2 * noise)
            else:
                weight.copy_(0.2 * noise)
    return network


@cache
def little_data(scene: Scene) -> TensorDict:
    """A little true motion of the scene."""
    data = simulate(scene, 64, 4, Generator().manual_seed(0))
    return data[is_sound(data)]


def scene_stats(scene: Scene) -> dict[NestedKey, Stats]:
    """Statistics of it."""
    return data_stats(scene, little_data(scene))


def random_model(
    scene: Scene, generator: Generator, network: str = "transformer-2x64"
) -> NeRD:
    """A model of the right scale that has learned nothing."""
    data = little_data(scene)
    model = NeRD(scene, NETWORKS[network], scene_stats(scene))
    cover(model, data)
    enliven(model.network, generator)
    return model


def double_model(
    scene: Scene, generator: Generator, network: str = "transformer-2x64"
) -> NeRD:
    """The same in float64: random weights blow up float32 rounding."""
    model = random_model(scene, generator, network)
    model.network.double()
    return model


def random_drive(
    scene: Scene, rows: int, steps: int, generator: Generator
) -> tuple[TensorDict, Tensor, Tensor | None]:
    """A start ``[rows]``, torques ``(steps, rows, num_actuated)`` and the ground."""
    start, _ = scene.sample_initial(rows, generator)
    terrain = start.pop("terrain", None)
    high = torch.tensor(scene.sampling.torque, dtype=torch.float64)
    u = torch.rand(steps, rows, len(high), generator=generator, dtype=torch.float64)
    return TensorDict(start, [rows]), (2.0 * u - 1.0) * high, terrain


def roll(
    dynamics: Dynamics, state: TensorDict, torques: Tensor, terrain: Tensor | None
) -> TensorDict:
    """States after each step, ``[rows, steps]``; the dynamics keeps its past."""
    states = []
    for torque in torques:
        state = dynamics.step(state, torque, terrain)
        states.append(state)
    return torch.stack(states, 1)


@torch.no_grad()
def in_small_steps(model: NeRD) -> NeRD:
    """The model within its bounds, and without rotations by many turns."""
    for weight in model.network.head.parameters():
        weight *= 0.1
    return model


class DynamicsMaker:
    """Dynamics of one kind, as often as asked, with the same weights."""

    def __init__(self, scene: Scene, kind: str, generator: Generator) -> None:
        self.scene, self.kind = scene, kind
        self.model = double_model(scene, generator) if kind in LEARNED else None

    def __call__(self) -> Dynamics:
        if self.model is not None:
            return NeRDDynamics(self.model, inference=self.kind)
        if self.kind == "mujoco":
            return MujocoDynamics(self.scene, num_threads=2)
        if self.kind == "mujoco_warp":
            return MujocoWarpDynamics(self.scene, "cpu")
        return DMControlDynamics(self.scene)


class EnvMaker:
    """Envs of one task in one dynamics, as often as asked, with the same weights.

    ``horizon`` replaces the task's own.
    """

    def __init__(
        self,
        task_id: str,
        dynamics: str,
        generator: Generator,
        horizon: int | None = None,
    ) -> None:
        self.task, self.dynamics = make_task(task_id), dynamics
        if horizon is not None:
            self.task.horizon = horizon
        is_learned, scene = dynamics in LEARNED, self.task.scene
        self.model = double_model(scene, generator) if is_learned else None

    def __call__(self, num_envs: int = 3, seed: int = 0) -> SceneEnv:
        if self.model is None:
            return GroundTruthEnv(self.task, self.dynamics, num_envs, seed)
        model, inference = self.model, self.dynamics
        return NeRDEnv(self.task, model, num_envs, seed, inference=inference)


def random_actions(env: SceneEnv, steps: int, generator: Generator) -> Tensor:
    """Actions in [-1, 1], ``(steps, *action shape)``."""
    return 2.0 * torch.rand(steps, *env.action_spec.shape, generator=generator) - 1.0


def row_uniforms(seed: int, episode: Tensor, count: int) -> Tensor:
    """What the rows of an env with that seed draw at the start of these episodes."""
    return uniforms(row_keys(seed, len(episode)), episode, stream_offsets(count))


def act(env: SceneEnv, action: Tensor) -> TensorDict:
    """What one step writes under ``next``."""
    return env.step(TensorDict({"action": action}, env.batch_size))["next"]


def act_all(env: SceneEnv, actions: Tensor) -> TensorDict:
    """What the steps write under ``next``, ``[rows, steps]``; no resets between."""
    return torch.stack([act(env, action) for action in actions], 1)


def reset_rows(env: SceneEnv, rows: Tensor, state: TensorDict | None = None):
    """A partial reset of ``rows`` (bool ``(num_envs,)``); the others show ``state``."""
    given = TensorDict({}, env.batch_size) if state is None else state.clone()
    return env.reset(given.set("_reset", rows[:, None]))


def start_at(env: SceneEnv, state: TensorDict) -> TensorDict:
    """All rows reset to ``state``."""
    return env.reset(state.clone(), set_state=True)


def junk_fill(td: TensorDict) -> None:
    """Overwrite every tensor in place."""
    for value in td.values(True, True):
        value.fill_(torch.nan if value.is_floating_point() else True)


def unequal_keys(a: Mapping, b: Mapping) -> list:
    """Keys whose tensors differ by a bit; NaN equals NaN."""
    assert set(a.keys(True, True)) == set(b.keys(True, True))
    return [
        key
        for key in a.keys(True, True)
        if not torch.equal(a[key].nan_to_num(1e300), b[key].nan_to_num(1e300))
    ]


MOTION = ("qpos", "qvel", "observation", "reward", "joint_torque")


def assert_same_motion(got: TensorDict, expected: TensorDict, tolerance: float) -> None:
    """All that moves, within ``tolerance`` of the largest number; 0: bit for bit."""
    for key in set(MOTION) & set(expected.keys()):
        if not expected[key].numel():
            continue  # a robot without motors
        limit = tolerance * (1.0 + expected[key].abs().max())
        difference = (got[key] - expected[key]).abs().max()
        assert difference <= limit, f"{key} differs by {difference}"


def random_mask(rows: int, generator: Generator, share: float = 0.5) -> Tensor:
    """Some rows, never none and never all of them."""
    mask = torch.rand(rows, generator=generator) < share
    first, last = torch.randperm(rows, generator=generator)[:2]
    mask[first], mask[last] = True, False
    return mask


def edit_card(folder: Path, **changes: object) -> None:
    """Replace entries of a checkpoint's card."""
    card = json.loads((folder / CARD).read_text())
    (folder / CARD).write_text(json.dumps({**card, **changes}))
