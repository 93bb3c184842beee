"""Stage f: where the time of a step goes, and its share of what the device reaches."""

from typing import Any

import torch
from torch.profiler import ProfilerActivity, profile

from gpu.graphs import InPlaceStep, graphed, half
from gpu.rates import states
from gpu.stages import Item, Setup, ceilings, rate
from torchrl_nerd import load_scene
from torchrl_nerd.configs import NO_PREDICTIONS
from torchrl_nerd.modules.nerd import NeRD
from torchrl_nerd.modules.networks import network_config
from torchrl_nerd.modules.transformer import TransformerConfig


def items(setup: Setup) -> dict[str, Item]:
    """One for every size of the Ant's batch."""
    network = setup.pick("paper-large", "transformer-2x64")
    sizes = setup.pick((512, 16384), (4,))
    return {
        f"{network}, {size}": lambda size=size: profile_step(network, size, setup)
        for size in sizes
    }


def profile_step(network: str, size: int, setup: Setup) -> dict[str, Any]:
    """Kernels of eager steps by time, and the roofline of the graph's."""
    scene, config = load_scene("ant"), network_config(network)
    assert isinstance(config, TransformerConfig)
    torch.manual_seed(setup.seed)
    model = NeRD(scene, NO_PREDICTIONS, config).to(setup.device)
    state = states(scene, size, setup)
    torque = torch.zeros(size, len(scene.actuated)).to(state["qpos"])
    step = InPlaceStep(half(model), state, torque)
    for _ in range(3):
        step()
    activities = [ProfilerActivity.CPU]
    if setup.is_gpu:
        activities.append(ProfilerActivity.CUDA)
    with profile(activities=activities) as profiled:
        for _ in range(setup.pick(5, 1)):
            step()
        setup.wait()
    which = "self_device_time_total" if setup.is_gpu else "self_cpu_time_total"
    rows = sorted(profiled.key_averages(), key=lambda x: -getattr(x, which))[:15]
    total = sum(getattr(x, which) for x in profiled.key_averages()) or 1.0
    table = [
        {"name": x.key[:90], "share": getattr(x, which) / total, "calls": x.count}
        for x in rows
    ]
    seconds = 1.0 / rate(graphed(step, setup.device), setup)["per_s"]
    needed, reached = needs(model, config, size), ceilings(setup)
    floor = max(
        needed["flop"] / reached["bf16_flop_per_s"],
        needed["bytes"] / reached["copy_bytes_per_s"],
    )
    return {
        "step_ms": 1e3 * seconds,
        "floor_ms": 1e3 * floor,
        "share_of_roofline": floor / seconds,
        **needed,
        **reached,
        "kernels": table,
    }


def needs(model: NeRD, config: TransformerConfig, size: int) -> dict[str, float]:
    """Operations and bytes of a streamed step of all envs, in bfloat16.

    Two operations a weight, four a number of the history; the weights and the history are
    read once, and one token of it is written.
    """
    weights = sum(x.numel() for x in model.network.parameters())
    past = 2 * config.layers * config.width * config.band  # numbers of one env
    token = 2 * config.layers * config.width
    return {
        "flop": float(size * (2 * weights + 2 * past)),
        "bytes": float(2 * weights + 2 * size * (past + token)),
    }
