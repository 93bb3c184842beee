"""A network that corrects a coarse MuJoCo step, beside pure NeRD and MuJoCo itself.

    python benchmarks/corrector.py
    python benchmarks/corrector.py --scene ant --substeps 4 --network mlp-4x128

The corrector's output is added to the end of one coarse step; a NeRD's, to the present
state. Both learn from the same transitions of the finest truth, with the same network, loss
and number of updates. Prints open-loop errors and, all in turn, speeds: control steps per
second of the processor, on one thread.
"""

import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from statistics import median
from typing import Any, cast

import torch
import tyro
from scaling import stepper
from tensordict import TensorDict, TensorDictBase
from torch import Generator, Tensor, nn
from torchrl_nerd.training.muon import Muon
from tqdm import trange

from torchrl_nerd.configs import TrainConfig
from torchrl_nerd.data.generate import is_sound, simulate
from torchrl_nerd.dynamics import Dynamics, MujocoDynamics, NeRDDynamics
from torchrl_nerd.evaluation.bench.contenders import (
    FINEST,
    mujoco_contenders,
)
from torchrl_nerd.evaluation.bench.errors import Course, courses
from torchrl_nerd.evaluation.bench.rates import Runner, states_on_the_way
from torchrl_nerd.evaluation.rollout_error import summarize
from torchrl_nerd.files import write_json
from torchrl_nerd.keys import JOINT_TORQUE, NEXT_QPOS, NEXT_QVEL, QPOS, QVEL, TERRAIN
from torchrl_nerd.modules.nerd import TARGET, TOKEN, NeRD
from torchrl_nerd.modules.networks import network_config
from torchrl_nerd.robots import PRESETS, load_scene
from torchrl_nerd.training.losses import one_step_loss
from torchrl_nerd.training.trainer import split_parameters
from torchrl_nerd.transforms import Stats

PART = 20_000  # transitions turned into tokens at a time


@dataclass
class Options:
    """What to correct, and how long to learn."""

    scene: str = "cartpole"
    substeps: int = 1
    """Of the coarse step."""
    network: str = "mlp-1x32"
    trajectories: int = 2_000
    """Of the data, 50 steps each, at 64 substeps or four times the scene's own."""
    updates: int = 6_000
    rows: int = 128
    """Trajectories of the test."""
    rounds: int = 5
    """Turns of each contender at 512 rows."""
    loss_eps: tuple[float, ...] = (1e-2, 1e-4)
    """Of the loss: a corrector and a NeRD for each; a smaller one heeds quiet states."""
    compile: bool = False
    seed: int = 0
    json: Path | None = None
    """Write the figures to this file."""


class ResidualDynamics(NeRDDynamics):
    """A coarse step, and what a network says it got wrong."""

    def __init__(self, model: NeRD, coarse: MujocoDynamics, compile: bool) -> None:
        super().__init__(model, compile=compile)
        self.coarse = coarse
        correct = torch.compile(self._correct) if compile else self._correct
        self.correct = correct

    def reset(self, state: TensorDictBase, rows: Tensor | None = None) -> None:
        """See `Dynamics.reset`."""
        super().reset(state, rows)
        self.coarse.reset(state, rows)

    def step(
        self,
        state: TensorDictBase,
        joint_torque: Tensor,
        terrain: Tensor | None = None,
    ) -> TensorDictBase:
        """See `Dynamics.step`."""
        end = self.coarse.step(state, joint_torque, terrain)
        with torch.no_grad():
            qpos, qvel = self.correct(state, joint_torque, terrain, end)
        return TensorDict({QPOS: qpos, QVEL: qvel}, state.batch_size)

    def _correct(
        self,
        state: TensorDictBase,
        joint_torque: Tensor,
        terrain: Tensor | None,
        end: TensorDictBase,
    ) -> tuple[Tensor, Tensor]:
        token = self.model.encode(state[QPOS], state[QVEL], joint_torque, terrain)
        return self.model.decode(end[QPOS], end[QVEL], self.model.network(token))


def make_model(options: Options, stats: dict | None, is_corrector: bool) -> NeRD:
    """A NeRD; a corrector's targets are differences of two states at one time."""
    model = NeRD(load_scene(options.scene), network_config(options.network), stats)
    if is_corrector:
        model.state_delta.step_size = 0.0
    return model


def learn(
    data: TensorDict, base: TensorDictBase, options: Options, loss_eps: float
) -> NeRD:
    """A model of the change from ``base [N]`` to the next states of ``data [N]``."""
    torch.manual_seed(options.seed)
    is_corrector = base is not data
    raw, tokens, targets = make_model(options, None, is_corrector), [], []
    for part, start in zip(data.split(PART), base.split(PART), strict=True):
        seen = part[QPOS], part[QVEL], part[JOINT_TORQUE], part.get(TERRAIN, None)
        tokens.append(raw.tokens(*seen))
        ends = start[QPOS], start[QVEL], part[NEXT_QPOS], part[NEXT_QVEL]
        targets.append(raw.state_delta.delta(*ends))
    token, target = torch.cat(tokens), torch.cat(targets)
    stats = {TOKEN: Stats.of(token), TARGET: Stats.of(target)}
    model = make_model(options, stats, is_corrector)
    token = model.normalize.normalize(TOKEN, token).float()
    target = model.normalize.normalize(TARGET, target).float()
    model.coverage.fit(token, target, data[NEXT_QPOS], data[NEXT_QVEL])
    fit(model.network, token, target, options, loss_eps)
    return model.eval()


def fit(
    network: nn.Module,
    token: Tensor,
    target: Tensor,
    options: Options,
    loss_eps: float,
) -> None:
    """As `Trainer` does on single states; ends with the averaged weights."""
    how, generator = TrainConfig(), Generator().manual_seed(options.seed)
    matrices, others = split_parameters(network)
    optimizers = {
        how.lr: Muon(matrices, lr=how.lr),
        how.adamw_lr: torch.optim.AdamW(others, betas=(0.9, 0.95), weight_decay=0.0),
    }
    average = {name: w.detach().clone() for name, w in network.named_parameters()}
    for step in trange(options.updates, disable=None):
        pick = torch.randint(len(token), (1024,), generator=generator)
        loss = one_step_loss(network(token[pick]), target[pick], loss_eps)
        network.zero_grad()
        loss.backward()
        nn.utils.clip_grad_norm_(network.parameters(), how.clip)
        warm = min(1.0, (step + 1) / how.warmup) * (1.0 - step / options.updates)
        for peak, optimizer in optimizers.items():
            optimizer.param_groups[0]["lr"] = peak * warm
            optimizer.step()
        decay = min(how.ema, step / (step + 10.0))
        with torch.no_grad():
            for name, weight in network.named_parameters():
                average[name].lerp_(weight, 1.0 - decay)
    network.load_state_dict(average)


def errors_of(dynamics: Dynamics, ground: Sequence[Course]) -> dict[str, Any]:
    """Summary of every quantity over all courses."""
    parts = [course.errors(dynamics) for course in ground]
    merged = {name: torch.cat([part[name] for part in parts]) for name in parts[0]}
    return {k: asdict(v) for k, v in summarize(ground[0].scene, merged).items()}


def rates_of(everyone: dict[str, Dynamics], options: Options) -> dict[str, float]:
    """Control steps of 512 rows per second of the processor, medians over turns."""
    scene = load_scene(options.scene)
    state = states_on_the_way(scene, 512, options.seed)
    runners = {
        name: Runner(stepper(dynamics, state), time.process_time)
        for name, dynamics in everyone.items()
    }
    rounds = [
        {name: 512 * r.steps_per_s() for name, r in runners.items()}
        for _ in range(options.rounds)
    ]
    return {name: median(one[name] for one in rounds) for name in runners}


def main(options: Options) -> dict[str, Any]:
    """Learn, measure and print."""
    torch.set_num_threads(1)
    scene, threads = load_scene(options.scene), 1
    finest = max(FINEST, 4 * scene.substeps)
    generator = Generator().manual_seed(options.seed)
    drawn = simulate(scene.with_substeps(finest), options.trajectories, 50, generator)
    data = cast(TensorDict, drawn[is_sound(drawn)].flatten(0, 1))
    coarse = MujocoDynamics(scene.with_substeps(options.substeps), threads)
    state, terrain = data.select(QPOS, QVEL), data.get(TERRAIN, None)
    end = coarse.step(state, data[JOINT_TORQUE], terrain)
    whole = torch.cat((end[QPOS], end[QVEL]), -1).isfinite().all(-1)
    data, end = cast(TensorDict, data[whole]), cast(TensorDict, end[whole])
    everyone: dict[str, Dynamics] = {}
    for who in mujoco_contenders(scene, threads):
        if "implicitfast" not in who.name:
            everyone[who.name] = who.make(scene)
    for loss_eps in options.loss_eps:
        corrector = learn(data, end, options, loss_eps)
        pure = learn(data, data, options, loss_eps)
        name = f"loss_eps {loss_eps:.0e}"
        everyone[f"corrector, {name}"] = ResidualDynamics(
            corrector, coarse, options.compile
        )
        everyone[f"NeRD, {name}"] = NeRDDynamics(pure, compile=options.compile)
    ground = courses(PRESETS[scene.name].protocol(), options.rows, 500, threads)[:1]
    errors = {name: errors_of(dynamics, ground) for name, dynamics in everyone.items()}
    rates = rates_of(everyone, options)
    for name, by_quantity in errors.items():
        cells = "  ".join(
            f"{quantity} {e['mean']:.4f} / {e['final']:.4f} / {e['p95']:.4f} {e['unit']}"
            for quantity, e in by_quantity.items()
        )
        print(f"{name:<28}{rates[name]:>10,.0f} steps/s  {cells}")
    figures = {"transitions": len(data), "errors": errors, "steps_per_s": rates}
    if options.json is not None:
        asked = {k: v for k, v in asdict(replace(options, json=None)).items()}
        write_json(options.json, {"options": asked, "threads": threads, **figures})
    return figures


if __name__ == "__main__":
    main(tyro.cli(Options))
