"""Training of a NeRD: sequences gathered on the device, resumable to the bit."""

import copy
import time
from contextlib import AbstractContextManager, nullcontext
from dataclasses import asdict
from pathlib import Path
from typing import Any, cast

import torch
from tensordict import TensorDict
from torch import Generator, Tensor, nn
from tqdm import tqdm

from torchrl_nerd.checkpoint import make_card, save_checkpoint
from torchrl_nerd.configs import TrainConfig
from torchrl_nerd.dynamics import MujocoDynamics, NeRDDynamics
from torchrl_nerd.evaluation.rollout_error import ErrorSummary, passive_errors
from torchrl_nerd.files import read_json, writable_folder, write_json
from torchrl_nerd.modules.nerd import NeRD
from torchrl_nerd.robots import Source
from torchrl_nerd.scenes import Scene
from torchrl_nerd.seeds import fold_in
from torchrl_nerd.tensor_files import expect_fit, read_tensors, write_tensors
from torchrl_nerd.training import ranks
from torchrl_nerd.training.log import TrainingLog
from torchrl_nerd.training.loggers import LoggerName, open_logger
from torchrl_nerd.training.losses import one_step_loss, rollout_loss
from torchrl_nerd.training.muon import Muon
from torchrl_nerd.training.rest import find_rest, resting
from torchrl_nerd.training.run_state import like_packed, pack, unpack
from torchrl_nerd.training.sequences import Sequences, Symmetry, cover
from torchrl_nerd.training.start import begin_from, fingerprint, fresh_model

STATE = "state.json"  # of a run that can go on
VALIDATION_SEED = 1_000_003
VALIDATION_ROWS = 256


class Trainer:
    """Trains a model on one data set; `run` goes on from where the folder stopped.

    Under `torchrun` every rank does its share of each batch, see `training.ranks`.

    The folder holds ``last`` and ``best`` checkpoints (averaged weights), ``state`` (all
    that a resumed run needs for the same bits) and ``log.csv``; `open_logger` says where
    figures go besides.

    Args:
        scene: the robot.
        data: from `load_data`.
        source: a task or the scene; its resets or ranges start the validation rollouts.
        config: how.
        folder: where.
        device: of model and data; CUDA multiplies matrices in bfloat16.
        horizons: control steps of the validation rollouts.
        random_actions: validate under random actions in place of zero ones.
        quiet: no progress bar.
        logger: ``tensorboard``, ``wandb``, ``mlflow``, or ``csv`` for the table alone.
        start: a model to begin with, see `begin_from`; bounds are those of its data and
            these, trust and rest of these alone.

    Raises:
        ValueError: the folder cannot be written or holds a run of another configuration,
            or a start that does not fit.
    """

    def __init__(
        self,
        scene: Scene,
        data: TensorDict,
        source: Source,
        config: TrainConfig,
        folder: Path,
        device: torch.device | str = "cpu",
        horizons: tuple[int, ...] = (100, 500),
        random_actions: bool = False,
        quiet: bool = False,
        logger: LoggerName = "tensorboard",
        start: NeRD | None = None,
    ) -> None:
        self.logger: LoggerName = logger
        self.scene, self.source, self.config = scene, source, config
        self.folder, self.device = writable_folder(folder), torch.device(device)
        self.horizons, self.random_actions = horizons, random_actions
        self.quiet = quiet or ranks.rank() > 0
        ranks.expect_shares(
            batch_size=config.batch_size, rollout_batch_size=config.rollout_batch_size
        )
        longest = max(
            config.sequence_length, config.rollout_length if config.rollout_steps else 1
        )
        if data.batch_size[1] < longest:
            raise ValueError(
                f"expected trajectories of at least {longest} steps, "
                f"got {data.batch_size[1]}"
            )
        torch.manual_seed(config.seed)
        symmetry = Symmetry.of(scene, data) if config.use_symmetry else None
        if start is None:
            model = self.make_model(data, symmetry)
        else:
            model = begin_from(start, scene, config.network, symmetry)
        self.start = None if start is None else fingerprint(start)
        self.sequences = Sequences(model, data, self.device, symmetry)
        self.model, self.resting = model.to(self.device), resting(self.sequences.data)
        samples = self.sequences.tokens, self.sequences.targets
        cover(self.model, self.sequences.data, samples)
        if start is not None:
            self.model.coverage.widen(start.coverage)
        self.optimizers = self.make_optimizers()
        self.peaks = {"muon": config.lr, "adamw": config.adamw_lr}
        weights = dict(self.model.network.named_parameters())
        self.average = {name: w.detach().clone() for name, w in weights.items()}
        self.step, self.seconds, self.best = 0, 0.0, float("inf")
        self.errors: dict[int, dict[str, ErrorSummary]] = {}  # of the last validation
        if (self.folder / STATE).exists():
            self._resume()

    def make_model(self, data: TensorDict, symmetry: Symmetry | None) -> NeRD:
        """What is trained, where there is no start: the configured network, fresh."""
        return fresh_model(self.scene, data, self.config.network, symmetry)

    def make_optimizers(self) -> dict[str, torch.optim.Optimizer]:
        """Muon for the weights of linear layers, AdamW for everything else."""
        matrices, others = split_parameters(self.model.network)
        return {
            "muon": Muon(matrices, lr=self.config.lr),
            "adamw": adamw(others, self.config.adamw_lr),
        }

    def run(self, until: int | None = None) -> NeRD:
        """Train to the end, or to update ``until``; returns the averaged model."""
        last = min(until or self.config.total_steps, self.config.total_steps)
        bar = tqdm(
            total=self.config.total_steps,
            initial=self.step,
            desc=f"train {self.scene.name}",
            disable=self.quiet,
        )
        is_first = ranks.rank() == 0
        log = self._open_log() if is_first else None
        began = time.monotonic() - self.seconds
        loss = torch.zeros(())
        while self.step < last:
            loss = self.update()
            self.step += 1
            self.errors = {}
            is_last = self.step == self.config.total_steps
            if log and (self.step % self.config.validate_every == 0 or is_last):
                figures = self.validate()
                log.write({"step": self.step, "loss": float(loss), **figures})
                bar.set_postfix({k: f"{v:.2g}" for k, v in figures.items()})
            if log and (self.step % self.config.save_every == 0 or is_last):
                self.seconds = time.monotonic() - began
                self.save()
            bar.update()
        bar.close()
        if log:
            log.close()
        ranks.wait()  # for what the first one writes
        return self.averaged_model()

    def _open_log(self) -> TrainingLog:
        settings = {"scene": self.scene.name, **asdict(self.config)}
        logger = open_logger(self.logger, self.folder, self.step, settings)
        return TrainingLog(self.folder, self.step, logger)

    def update(self) -> Tensor:
        """One update and its loss, ``()``; the batch depends on seed and step alone."""
        config = self.config
        generator = fold_in(config.seed, self.step)
        rate = self._rate()
        for name, optimizer in self.optimizers.items():
            for group in optimizer.param_groups:
                group["lr"] = self.peaks[name] * rate
            optimizer.zero_grad()
        self.model.train()
        with torch.enable_grad(), self._autocast():
            if self.step < config.steps:
                tokens, targets = map(ranks.share, self._batch(generator))
                outputs = self.model.network(tokens).float()
                loss = one_step_loss(outputs, targets, config.loss_eps)
            else:
                *states, terrain = self.sequences.rollout(
                    config.rollout_batch_size, config.rollout_length, generator
                )
                qpos, qvel, torque = map(ranks.share, cast(list[Tensor], states))
                ground = None if terrain is None else ranks.share(terrain)
                mine = qpos, qvel, torque, ground
                loss = rollout_loss(self.model, *mine, config.loss_eps)
        loss.backward()
        parameters = list(self.model.network.parameters())
        loss = ranks.average_gradients(parameters, loss)
        norm = nn.utils.clip_grad_norm_(parameters, config.clip)
        if norm.isfinite():
            for optimizer in self.optimizers.values():
                optimizer.step()
        decay = min(config.ema, self.step / (self.step + 10.0))
        with torch.no_grad():
            for name, weight in self.model.network.named_parameters():
                self.average[name].lerp_(weight, 1.0 - decay)
        return loss

    def _batch(self, generator: Generator) -> tuple[Tensor, Tensor]:
        """Sequences, or as many states from all over the data.

        The steps of a sequence resemble each other: single states, each with an empty
        history, make a batch of the same size tell more.
        """
        config = self.config
        rows, length = config.batch_size, config.sequence_length
        if torch.rand((), generator=generator) < config.single_step_fraction:
            rows, length = rows * length, 1
        return self.sequences.one_step(rows, length, generator)

    def _rate(self) -> float:
        """Share of the peak step size: up, then down to zero; rollouts in rounds."""
        config, step = self.config, self.step
        if step < config.steps:
            return min(1.0, (step + 1) / max(config.warmup, 1)) * (
                1 - step / config.steps
            )
        done = config.rollout_restarts * (step - config.steps) / config.rollout_steps
        return config.rollout_lr_ratio * (1.0 - done % 1.0)

    def _autocast(self) -> AbstractContextManager:
        is_coarse = self.step < self.config.bf16_fraction * self.config.steps
        if is_coarse or self.device.type == "cuda":
            return torch.autocast(self.device.type, torch.bfloat16)
        return nullcontext()

    def averaged_model(self) -> NeRD:
        """A copy of the model that holds the averaged weights, and knows rest."""
        model = copy.deepcopy(self.model)
        model.network.load_state_dict(self.average)
        find_rest(model.eval(), self.resting)
        return model

    def validate(self) -> dict[str, float]:
        """Mean open-loop error of the averaged model at every horizon.

        The starts (their seed) are of no test: choices are made on them.
        """
        summaries = passive_errors(
            self.source,
            NeRDDynamics(self.averaged_model()),
            MujocoDynamics(self.scene),
            list(self.horizons),
            rows=VALIDATION_ROWS,
            seed=VALIDATION_SEED,
            device=self.device,
            random_actions=self.random_actions,
        )
        figures = {
            f"{name}_{horizon}": summary.mean
            for horizon, by_name in summaries.items()
            for name, summary in by_name.items()
        }
        self.errors = summaries
        score = sum(
            v for k, v in figures.items() if k.endswith(f"_{self.horizons[-1]}")
        )
        is_best = score < self.best
        if is_best:
            self.best = score
        # the first one is kept even if its rollouts blow up
        if is_best or not (self.folder / "best").exists():
            self._save_model("best", summaries)
        return figures

    def save(self) -> None:
        """Everything a resumed run needs; the state's card is written last."""
        self._save_model("last", self.errors)
        tensors = pack(self.model.network, self.average, self.optimizers)
        tensors["step"] = torch.tensor(self.step)
        tensors["best"] = torch.tensor(self.best, dtype=torch.float64)
        write_tensors(self.folder / "state.safetensors", tensors)
        write_json(self.folder / STATE, self._identity | {"seconds": self.seconds})

    def _save_model(
        self, name: str, errors: dict[int, dict[str, ErrorSummary]]
    ) -> None:
        curve = {
            str(horizon): {k: asdict(v) for k, v in by_name.items()}
            for horizon, by_name in errors.items()
        }
        training = {
            "training": {
                **asdict(self.config),
                "steps_done": self.step,
                "seconds": round(self.seconds, 1),
                "device": str(self.device),
                "threads": torch.get_num_threads(),
                "trajectories": len(self.sequences.tokens),
                "start": self.start,
            },
            "validation_error": curve,
        }
        model = self.averaged_model()
        save_checkpoint(model, self.folder / name, make_card(model, training))

    @property
    def _identity(self) -> dict[str, Any]:
        """What a run that goes on must have in common with the one that stopped."""
        config, scene_hash = asdict(self.config), self.scene.hash
        return {"config": config, "scene_hash": scene_hash, "start": self.start}

    def _resume(self) -> None:
        card = read_json(self.folder / STATE)
        for key, value in self._identity.items():
            if card.get(key) != value:
                raise ValueError(
                    f"{self.folder} holds a run with {key} {card.get(key)}, asked for "
                    f"{value}: choose another folder"
                )
        path = self.folder / "state.safetensors"
        tensors = read_tensors(path)
        best = tensors.pop("best", torch.tensor([]))  # infinite before any validation
        parts = self.model.network, self.average, self.optimizers
        expected = {**like_packed(tensors, *parts), "step": torch.tensor(0)}
        expect_fit(tensors, expected, f"tensors in {path}", "this run")
        if best.shape or best.dtype != torch.float64 or best.isnan():
            raise ValueError(f"expected the best error in {path}, got {best}")
        self.step, self.best = int(tensors["step"]), float(best)
        seconds = card.get("seconds")
        if not 0 < self.step <= self.config.total_steps or type(seconds) is not float:
            raise ValueError(
                f"expected a step of this run and its seconds in {self.folder}, got "
                f"{self.step} and {seconds!r}"
            )
        self.seconds = seconds
        unpack(tensors, *parts)


def adamw(parameters: list[Tensor], lr: float) -> torch.optim.AdamW:
    """AdamW as it is used here: a short memory of squares, no weight decay."""
    return torch.optim.AdamW(parameters, lr=lr, betas=(0.9, 0.95), weight_decay=0.0)


def split_parameters(network: nn.Module) -> tuple[list[Tensor], list[Tensor]]:
    """Weights ``(out, in)`` of linear layers, for Muon, and everything else."""
    matrices, others = [], []
    for name, weight in network.named_parameters():
        is_matrix = weight.ndim == 2 and "offset_bias" not in name
        (matrices if is_matrix else others).append(weight)
    return matrices, others
