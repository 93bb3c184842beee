"""Stage d: training throughput, resuming, and time to the paper's error."""

import shutil
import time
from dataclasses import replace
from functools import cache
from typing import Any

import torch
from tensordict import TensorDict
from torch import Generator

from gpu.stages import Item, Setup, ceilings, rate
from torchrl_nerd import load_scene
from torchrl_nerd.configs import TrainConfig
from torchrl_nerd.data.simulate import is_sound, simulate
from torchrl_nerd.modules.networks import network_config
from torchrl_nerd.robots import preset_of, source_of
from torchrl_nerd.training.trainer import Trainer

BATCH, LENGTH = 4096, 10  # sequences of an update, tokens of a sequence
LIMIT = 12.0  # s of one-step updates


def items(setup: Setup) -> dict[str, Item]:
    """Throughput first: it says what minutes can train."""
    found: dict[str, Item] = {"ceilings": lambda: ceilings(setup)}
    for network in setup.pick(("paper-large", "transformer-4x128"), ("mlp-2x32",)):
        found[f"throughput {network}"] = lambda n=network: throughput(n, setup)
    network = setup.pick("paper-large", "mlp-2x32")
    found[f"throughput {network}, compiled"] = lambda: throughput(network, setup, True)
    found["resume"] = lambda: resume(setup)
    for name in setup.pick(("cartpole", "ant"), ("cartpole",)):
        found[f"time to error {name}"] = lambda n=name: to_error(n, setup)
    return found


@cache
def make_data(name: str, setup: Setup) -> TensorDict:
    """Trajectories of random torques, made on the host; sound ones."""
    count, steps = setup.pick((4000, 100), (40, 12))
    generator = Generator().manual_seed(setup.seed)
    data = simulate(load_scene(name), count, steps, generator)
    return data[is_sound(data)]


def make_trainer(
    name: str,
    config: TrainConfig,
    setup: Setup,
    folder: str,
    data: TensorDict,
    compile: bool = False,
) -> Trainer:
    """A run of its own folder, without a progress bar."""
    scene, horizons = load_scene(name), setup.pick((100, 500), (2,))
    where = setup.folder / folder
    given = scene, data, source_of(scene), config, where, setup.device
    how = {"horizons": horizons, "quiet": True, "logger": "csv"}
    return Trainer(*given, **how, compile=compile)


def config_of(network: str, setup: Setup, **changes: Any) -> TrainConfig:
    """Large batches of sequences alone."""
    batch, length = setup.pick((BATCH, LENGTH), (4, 2))
    how = {"network": network, "batch_size": batch, "sequence_length": length}
    how |= {
        "rollout_length": setup.pick(8, 2),
        "rollout_batch_size": setup.pick(256, 2),
    }
    how |= {"single_step_fraction": 0.0, "bf16_fraction": 1.0, "seed": setup.seed}
    return replace(TrainConfig(), **(how | changes))


def throughput(network: str, setup: Setup, compile: bool = False) -> dict[str, Any]:
    """Updates per second, and the share of the bf16 products that the device reaches.

    Six operations for every weight and token: two forward, four backward.
    """
    name = setup.pick("ant", "cartpole")
    _fresh("throughput", setup)
    data = make_data(name, setup)
    config = config_of(network, setup)
    trainer = make_trainer(name, config, setup, "throughput", data, compile)
    found = rate(trainer.update, setup, warmup=2)
    weights = sum(x.numel() for x in trainer.model.network.parameters())
    tokens = config.batch_size * config.sequence_length
    flop = 6.0 * weights * tokens * found["per_s"]
    return {
        "updates_per_s": found["per_s"],
        "tokens_per_s": tokens * found["per_s"],
        "flop_per_s": flop,
        "share_of_bf16": flop / ceilings(setup)["bf16_flop_per_s"],
        "weights": weights,
        "layers": getattr(network_config(network), "layers", 0),
    }


def resume(setup: Setup) -> dict[str, Any]:
    """Seconds to save a run, and to make it again until its next update."""
    name, data = "cartpole", make_data("cartpole", setup)
    _fresh("resume", setup)
    network = setup.pick("paper-large", "mlp-2x32")
    config = config_of(network, setup, steps=10, rollout_steps=0)
    trainer = make_trainer(name, config, setup, "resume", data)
    for _ in range(2):
        trainer.update()
        trainer.step += 1
    setup.wait()
    began = time.perf_counter()
    trainer.save()
    saved = time.perf_counter() - began
    began = time.perf_counter()
    again = make_trainer(name, config, setup, "resume", data)
    again.update()
    setup.wait()
    return {
        "save_s": saved,
        "resume_s": time.perf_counter() - began,
        "resumed_at": again.step,
    }


def to_error(name: str, setup: Setup) -> dict[str, Any]:
    """Validation errors over time: the robot's training preset, in `LIMIT` seconds.

    As many updates as fit, so that the learning rate falls to zero within them.
    """
    data, folder = make_data(name, setup), f"error-{name}"
    tiny = config_of("mlp-2x32", setup, warmup=1)
    config = tiny if setup.is_tiny else preset_of(name).train
    _fresh(folder, setup)
    found = rate(make_trainer(name, config, setup, folder, data).update, setup)
    steps = setup.pick(max(100, round(LIMIT * found["per_s"])), 2)
    rollout_steps = steps // 20  # an update of rollouts takes several times as long
    warmup = min(config.warmup, max(1, steps // 10))
    short = {"steps": steps, "rollout_steps": rollout_steps, "warmup": warmup}
    _fresh(folder, setup)
    began = time.perf_counter()
    trainer = make_trainer(name, replace(config, **short), setup, folder, data)
    curve, rounds, total = [], setup.pick(4, 1), trainer.config.total_steps
    for number in range(1, rounds + 1):
        while trainer.step < number * total // rounds:
            trainer.update()
            trainer.step += 1
        errors = trainer.validate()
        setup.wait()
        now = {"seconds": time.perf_counter() - began, "step": trainer.step}
        curve.append(now | errors)
    reached = _reached(name, curve)
    about = {"trajectories": len(data), "network": config.network}
    return about | {"curve": curve, "paper_reached_after_s": reached}


def _reached(name: str, curve: list[dict[str, float]]) -> dict[str, float | None]:
    """Seconds until the paper's error of each quantity; None where it was not reached."""
    protocol, found = preset_of(name).protocol, {}
    for (_, steps, quantity), paper in (protocol.published if protocol else {}).items():
        key = f"{quantity}_{steps}"
        times = [x["seconds"] for x in curve if x.get(key, paper + 1.0) <= paper]
        found[f"{key}: {paper}"] = times[0] if times else None
    return found


def _fresh(folder: str, setup: Setup) -> None:
    """No earlier run there, and the same random numbers."""
    shutil.rmtree(setup.folder / folder, ignore_errors=True)
    torch.manual_seed(setup.seed)
