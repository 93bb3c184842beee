"""Stage b: control steps per second of learned dynamics, and of whole env steps."""

from collections.abc import Callable
from typing import Any

import torch
from tensordict import TensorDict

from gpu.graphs import InPlaceEnv, InPlaceStep, graphed, half
from gpu.stages import Item, Setup, rate
from torchrl_nerd import NeRDEnv, load_scene
from torchrl_nerd.checkpoint import from_pretrained
from torchrl_nerd.configs import NO_PREDICTIONS
from torchrl_nerd.dynamics import NeRDDynamics, dynamics_of
from torchrl_nerd.dynamics.models import TorchDynamics
from torchrl_nerd.evaluation.bench.rates import mid_states
from torchrl_nerd.modules.nerd import NeRD
from torchrl_nerd.modules.networks import network_config
from torchrl_nerd.robots import Source

SIZES = (512, 4096, 16384, 65536)
PRESETS = ("paper-large", "paper", "transformer-4x128", "transformer-2x64")
MODES = ("graph bf16", "graph", "eager")
COMPILED = (  # the fastest, which take the longest to prepare
    ("paper-large", 512),
    ("paper-large", 16384),
    ("mlp-4x160", 65536),
    ("transformer-4x128", 512),
    ("transformer-4x128", 16384),
    ("transformer-2x64", 65536),
    ("paper-large", 65536),
)
COMPILED_ENVS = (("ant/run", 512), ("ant/run", 16384), ("cartpole/swingup", 65536))
SAMPLE = 512  # states that are drawn; larger batches repeat them


def items(setup: Setup) -> dict[str, Item]:
    """The fastest first; eager steps, which are a tenth as fast, last."""
    found: dict[str, Item] = {}
    for network, size in setup.pick(COMPILED, (("mlp-4x160", 4),)):
        found[f"{network} streaming, compiled graph bf16, {size}"] = (
            lambda n=network, s=size: dynamics_rate(n, "compiled graph bf16", s, setup)
        )
    for task, size in setup.pick(COMPILED_ENVS, ()):
        found[f"env {task}, compiled graph, {size}"] = lambda t=task, s=size: env_rate(
            t, "compiled graph", s, setup
        )
    for modes in (MODES[:2], MODES[2:]):
        for size in setup.pick(SIZES, (4,)):
            found |= _by_size(size, modes, setup)
    size = setup.pick(4096, 4)
    for network in setup.pick(PRESETS[:2], PRESETS[3:]):
        found[f"{network} window, graph, {size}"] = lambda n=network: dynamics_rate(
            n, "graph", size, setup, "window"
        )
    for name in ("double_pendulum-hybrid",):
        found[f"{name}, graph, {size}"] = lambda n=name: shipped_rate(n, size, setup)
    return found


def _by_size(size: int, modes: tuple[str, ...], setup: Setup) -> dict[str, Item]:
    """Networks and whole envs of so many envs."""
    found: dict[str, Item] = {}
    networks = (*PRESETS, "mlp-4x160")
    for network in setup.pick(networks, networks[3:]):
        for mode in modes:
            found[f"{network} streaming, {mode}, {size}"] = lambda n=network, m=mode: (
                dynamics_rate(n, m, size, setup)
            )
    mode = "eager" if "eager" in modes else "graph"
    for task in setup.pick(("ant/run", "cartpole/swingup"), ("cartpole/swingup",)):
        found[f"env {task}, {mode}, {size}"] = lambda t=task: env_rate(
            t, mode, size, setup
        )
    return found


def states(source: Source, size: int, setup: Setup) -> TensorDict:
    """Mid-motion states ``[size]`` on the device."""
    drawn = mid_states(source, min(size, setup.pick(SAMPLE, 4)), setup.seed)
    index = torch.arange(size) % len(drawn)
    return drawn[index].to(setup.device)  # pyright: ignore


def dynamics_rate(
    network: str, mode: str, size: int, setup: Setup, inference: Any = "streaming"
) -> dict[str, Any]:
    """Of an untrained network of the Ant's sizes: speed does not depend on weights."""
    scene = load_scene("ant")
    torch.manual_seed(setup.seed)
    torch._dynamo.reset()  # else the last item's code counts against this one's
    model = NeRD(scene, NO_PREDICTIONS, network_config(network)).to(setup.device)
    how = {"inference": inference, "compile": "compiled" in mode}
    dynamics = half(model, **how) if "bf16" in mode else NeRDDynamics(model, **how)
    if setup.is_tiny:  # the tracer alone
        dynamics._compiled.options = {"backend": "eager"}
    return _timed(dynamics, mode, states(scene, size, setup), setup)


def shipped_rate(name: str, size: int, setup: Setup) -> dict[str, Any]:
    """Of a shipped model, as a graph."""
    model = from_pretrained(name)
    dynamics = dynamics_of(model.to(setup.device))
    return _timed(dynamics, "graph", states(model.scene, size, setup), setup)


def _timed(
    dynamics: TorchDynamics, mode: str, state: TensorDict, setup: Setup
) -> dict[str, Any]:
    torque = torch.zeros(len(state), len(dynamics.scene.actuated)).to(state["qpos"])
    step = InPlaceStep(dynamics, state, torque)
    return _steps_per_s(step, mode, len(state), setup)


def env_rate(task: str, mode: str, size: int, setup: Setup) -> dict[str, Any]:
    """Of a whole env step with resets by mask, in the shipped model of its robot."""
    env = NeRDEnv(task, num_envs=size, seed=setup.seed, device=setup.device)
    env.reset()
    action = torch.rand(env.action_spec.shape, device=setup.device) * 2.0 - 1.0
    step = InPlaceEnv(env, action)
    if "compiled" in mode:
        torch._dynamo.reset()
        step = torch.compile(step.__call__, dynamic=False)
    return {"model": env.model_name, **_steps_per_s(step, mode, size, setup)}


def _steps_per_s(
    step: Callable[[], None], mode: str, size: int, setup: Setup
) -> dict[str, Any]:
    if setup.is_gpu:
        torch.cuda.reset_peak_memory_stats()
    if "compiled" in mode:
        step()  # eager once, as `Compiled` does
        step()
    found = rate(graphed(step, setup.device) if "graph" in mode else step, setup)
    memory = torch.cuda.max_memory_allocated() if setup.is_gpu else 0
    return {
        "steps_per_s": size * found["per_s"],
        "step_ms": 1e3 / found["per_s"],
        "spread": found["spread"],
        "peak_bytes": memory,
    }
