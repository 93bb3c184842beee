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
from torchrl_nerd.analytic import STEPS, AnalyticStep, make_step
from torchrl_nerd.checkpoint import CARD
from torchrl_nerd.configs import NO_PREDICTIONS, FeatureConfig, UnconstrainedConfig
from torchrl_nerd.data.generate import is_sound, simulate
from torchrl_nerd.dynamics import (
    AnalyticDynamics,
    DMControlDynamics,
    Dynamics,
    Model,
    MujocoDynamics,
    MujocoWarpDynamics,
    NeRDDynamics,
)
from torchrl_nerd.dynamics.models import Inference
from torchrl_nerd.dynamics.mujoco_warp import is_warp_installed
from torchrl_nerd.envs.base import SceneEnv
from torchrl_nerd.envs.streams import env_keys, stream_offsets, uniforms
from torchrl_nerd.modules.hybrid import HybridNeRD
from torchrl_nerd.modules.nerd import NeRD
from torchrl_nerd.modules.networks import network_config
from torchrl_nerd.robots import SCENES, TASKS, load_scene, make_task
from torchrl_nerd.scenes import Scene
from torchrl_nerd.training.samples import cover, data_stats
from torchrl_nerd.transforms import Stats

HAS_COMPILER = any(map(which, ("g++", "clang++")))  # what inductor looks for

LEARNED = ("streaming", "window")
MODELS = (*LEARNED, "hybrid", "analytic")
TRUE = ("mujoco", "dm_control")
DYNAMICS = (*MODELS, *TRUE)
WARP = pytest.param("mujoco_warp", marks=pytest.mark.slow)

each_dynamics = pytest.mark.parametrize("dynamics", DYNAMICS)
warp_too = pytest.mark.parametrize(
    "dynamics", (*DYNAMICS, WARP) if is_warp_installed() else DYNAMICS
)
"""With MuJoCo Warp where it is installed, on the CPU, where it takes minutes."""


def supports(scene: Scene, step: str) -> bool:
    """Whether the analytic step of that name can step the scene."""
    try:
        make_step(scene, STEPS[step])
    except ValueError:
        return False
    return True


def covering_steps() -> list[tuple[Scene, str]]:
    """Every registered scene with an analytic step that moves it as a whole.

    Each scene at least once, each step at least twice. A scene with a ground is left to
    the steps that know of contacts.
    """
    scenes = [load_scene(name) for name in SCENES]

    def fits(scene: Scene, step: str) -> bool:
        is_unconstrained = isinstance(STEPS[step], UnconstrainedConfig)
        return is_unconstrained == (scene.terrain is None) and supports(scene, step)

    pairs: list[tuple[Scene, str]] = []

    def uses(step: str) -> int:
        return sum(name == step for _, name in pairs)

    for scene in scenes:
        pairs.append((scene, min((s for s in STEPS if fits(scene, s)), key=uses)))
    for step in STEPS:
        others = [s for s in scenes if (s, step) not in pairs and fits(s, step)]
        others.sort(key=lambda scene: sum(s is scene for s, _ in pairs))
        pairs += [(scene, step) for scene in others[: max(0, 2 - uses(step))]]
    return pairs


ANALYTIC = covering_steps()
each_analytic = pytest.mark.parametrize(
    ("scene", "step"), ANALYTIC, ids=lambda x: getattr(x, "name", x)
)
"""Every scene, and every analytic step, in pairs."""


MOTORS = [name for name in SCENES if load_scene(name).actuated]
ACTIONS = [name for name in TASKS if make_task(name).controller.num_actions]

each_with_motors = pytest.mark.parametrize(
    "scene", [*map(load_scene, MOTORS)], ids=MOTORS
)
each_with_actions = pytest.mark.parametrize("task_id", ACTIONS)
"""Robots and tasks that can be driven; a cube cannot."""


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
    """A little MuJoCo motion of the scene."""
    data = simulate(scene, 64, 4, Generator().manual_seed(0))
    return data[is_sound(data)]


@cache
def scene_stats(
    scene: Scene, features: FeatureConfig = NO_PREDICTIONS
) -> dict[NestedKey, Stats]:
    """Statistics of it."""
    return data_stats(scene, little_data(scene), features)


def random_model(
    scene: Scene,
    generator: Generator,
    network: str = "transformer-2x64",
    features: FeatureConfig = NO_PREDICTIONS,
) -> NeRD:
    """A learned model of the right scale that has learned nothing."""
    model = NeRD(scene, features, network_config(network), scene_stats(scene, features))
    cover(model, little_data(scene))
    enliven(model.network, generator)
    return model


def analytic_step(scene: Scene, step: str | None = None) -> AnalyticStep:
    """The analytic step of that name, or the one of `ANALYTIC` or of every other scene."""
    if step is None:
        step = next((name for s, name in ANALYTIC if s is scene), None)
    return make_step(scene, None if step is None else STEPS[step])


def hybrid_model(
    scene: Scene,
    step: str | None,
    generator: Generator,
    network: str = "mlp-2x32",
    features: FeatureConfig = NO_PREDICTIONS,
) -> HybridNeRD:
    """A hybrid of the right scale whose network has learned nothing, see `analytic_step`.

    Its network is in float64: contacts may magnify float32's rounding a thousand times.
    """
    stats = scene_stats(scene, features)
    hybrid = analytic_step(scene, step), features, network_config(network), stats
    model = HybridNeRD(scene, *hybrid)
    cover(model, little_data(scene))
    enliven(model.network, generator)
    model.network.double()
    return model


def model_of_kind(kind: str, scene: Scene, generator: Generator) -> Model:
    """A model for dynamics of one of `MODELS`."""
    if kind == "analytic":
        return analytic_step(scene)
    if kind == "hybrid":
        return hybrid_model(scene, None, generator)
    return double_model(scene, generator)


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


def inference_of(kind: str) -> Inference:
    """How dynamics of that kind infer."""
    return "window" if kind == "window" else "streaming"


class DynamicsMaker:
    """Dynamics of one kind, as often as asked, with the same weights."""

    def __init__(self, scene: Scene, kind: str, generator: Generator) -> None:
        self.scene, self.kind = scene, kind
        self.model = model_of_kind(kind, scene, generator) if kind in MODELS else None

    def __call__(self) -> Dynamics:
        if isinstance(self.model, AnalyticStep):
            return AnalyticDynamics(self.model)
        if self.model is not None:
            return NeRDDynamics(self.model, inference=inference_of(self.kind))
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
        is_model, scene = dynamics in MODELS, self.task.scene
        self.model = model_of_kind(dynamics, scene, generator) if is_model else None

    def __call__(self, num_envs: int = 3, seed: int = 0) -> SceneEnv:
        if self.model is None:
            return GroundTruthEnv(self.task, self.dynamics, num_envs, seed)
        inference = inference_of(self.dynamics)
        return NeRDEnv(self.task, self.model, num_envs, seed, inference=inference)


def random_actions(env: SceneEnv, steps: int, generator: Generator) -> Tensor:
    """Actions in [-1, 1], ``(steps, *action shape)``."""
    return 2.0 * torch.rand(steps, *env.action_spec.shape, generator=generator) - 1.0


def row_uniforms(seed: int, episode: Tensor, count: int) -> Tensor:
    """What the envs of one with that seed draw at the start of these episodes."""
    return uniforms(env_keys(seed, len(episode)), episode, stream_offsets(count))


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
    """All envs reset to ``state``."""
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


def stand_on_feet(scene: Scene, state: TensorDict) -> None:
    """Put dm_control's hopper 5 mm into the ground, upright and at rest, in place."""
    qpos = torch.from_numpy(scene.model.qpos0).expand(len(state), -1).clone()
    height = scene.model.joint("rootz").qposadr[0]
    qpos[:, height] -= scene.clearances(qpos, None).amin(-1) + 0.005
    state["qpos"], state["qvel"] = qpos, torch.zeros_like(state["qvel"])
