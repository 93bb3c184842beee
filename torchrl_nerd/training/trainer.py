"""Training of a NeRD: one-step targets, then rollouts; a killed run resumes bit for bit."""

import copy
import time
from collections.abc import Callable
from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import Any

import torch
from tensordict import TensorDict
from torch import Tensor, nn
from tqdm import tqdm

from torchrl_nerd.checkpoint import make_card, save_checkpoint
from torchrl_nerd.compiled import Compiled
from torchrl_nerd.configs import TrainConfig
from torchrl_nerd.dynamics import MujocoDynamics, NeRDDynamics
from torchrl_nerd.evaluation.rollout_error import (
    ErrorSummary,
    means_by_horizon,
    passive_errors,
)
from torchrl_nerd.files import check_writable, read_json, write_json
from torchrl_nerd.modules.linear import in_bfloat16
from torchrl_nerd.modules.nerd import TARGET, NeRD
from torchrl_nerd.robots import Source
from torchrl_nerd.scenes import Scene
from torchrl_nerd.seeds import fold_in
from torchrl_nerd.settings import expect_same
from torchrl_nerd.training.capture import Captured
from torchrl_nerd.training.log import LoggerName, TrainingLog, open_logger
from torchrl_nerd.training.losses import one_step_loss, rollout_loss
from torchrl_nerd.training.optimizers import (
    RunState,
    follow_gradient,
    learning_rate_ratio,
    make_optimizers,
)
from torchrl_nerd.training.rest import find_rest, rest_of
from torchrl_nerd.training.samples import cover, data_stats
from torchrl_nerd.training.sequences import Inputs, Sequences
from torchrl_nerd.training.start import (
    begin_from,
    data_fingerprint,
    find_symmetry,
    fingerprint,
    make_model,
)
from torchrl_nerd.training.symmetry import Symmetry

STATE = "state.json"  # card of a run that can be resumed
SEED = 1_000_003  # of validation starts, which no test uses: they choose the best model
ROLLOUTS = 256  # of a validation


class Trainer:
    """Trains a model on one data set; `run` continues where the folder's run stopped.

    The folder holds checkpoints ``last`` and ``best`` (averaged weights), the ``state`` of
    the run and ``log.csv``; `open_logger` says where metrics go besides.

    Args:
        scene: the robot.
        data: transitions ``[trajectories, steps]``, from `load_data`.
        source: task or scene whose resets or ranges start the validation rollouts.
        config: how to train.
        folder: of the run.
        device: of model and data.
        horizons: control steps of the validation rollouts.
        random_actions: validate under random actions in place of zero ones. A model that
            learns after a history is validated after one.
        quiet: no progress bar.
        logger: see `open_logger`.
        init_from: a model whose weights and statistics the training continues, see
            `begin_from`. The training range covers its data and these.
        compile: compile network and loss of one step.

    Raises:
        ValueError: a folder of another run or that cannot be written, short trajectories,
            or a misfit ``init_from``.
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
        init_from: NeRD | None = None,
        compile: bool = False,
    ) -> None:
        if (steps := data.batch_size[1]) < (least := config.longest):
            raise ValueError(
                f"expected trajectories of at least {least} steps, got {steps}"
            )
        self.scene, self.source, self.config = scene, source, config
        check_writable(folder / STATE)
        self.folder, self.device, self.quiet = folder, torch.device(device), quiet
        self.horizons, self.random_actions = list(horizons), random_actions
        self.logger: LoggerName = logger
        torch.manual_seed(config.seed)
        self._build(data, init_from)
        self.identity = {  # what a resumed run must have in common
            "config": asdict(self.config),
            "scene_hash": scene.hash,
            "init_from": self.init_from,
            "data": data_fingerprint(data),
            "validation": [self.horizons, random_actions, type(source).__name__],
        }
        self.optimizers = self.make_optimizers()
        weights = self.model.network.named_parameters()
        self.average = {name: weight.detach().clone() for name, weight in weights}
        self.state = RunState(self.model.network, self.average, self.optimizers)
        one = torch.ones((), device=self.device)
        self.lr_ratio, self.ema_share = one, one.clone()
        one_step = self._one_step
        losses = {"one_step": one_step, "bfloat16": in_bfloat16(one_step, self.device)}
        if compile:
            how = {"warmup": 0, "dynamic": False}
            losses = {name: Compiled(x, **how) for name, x in losses.items()}
        self.losses = {**losses, "rollout": self._rollout}
        self._follow = {k: partial(self.follow, x) for k, x in self.losses.items()}
        if self.device.type == "cuda" and self.model.kind == "learned":
            written = self.state.tensors
            self._follow = {k: Captured(x, written) for k, x in self._follow.items()}
        self.step, self.seconds, self.best = 0, 0.0, float("inf")
        self.errors: dict[int, dict[str, ErrorSummary]] = {}  # of validation, by steps
        if (self.folder / STATE).exists():
            self._resume()

    def _build(self, data: TensorDict, init_from: NeRD | None) -> None:
        """The model, its statistics and its batches."""
        data = data.to(self.device)  # which makes all of what follows of them
        self.config, symmetry = find_symmetry(self.scene, self.config, init_from)
        if init_from is None:
            model, self.init_from = self.make_model(data, symmetry), None
        else:
            model = begin_from(init_from, self.scene, self.config, symmetry)
            self.init_from = fingerprint(init_from)
        self.model, delta = model.to(self.device), model.state_delta
        self.weights = delta.error_weights(model.normalize.std(TARGET)).float()
        symmetry = symmetry and symmetry.to(self.device)
        shown = symmetry if self.config.use_symmetry else None
        self.sequences, self.rest = Sequences(model, data, shown), rest_of(data)
        if self.config.rollout_steps:
            self.sequences.expect_rollouts(self.config.rollout_states)
        seen = self.sequences.features, self.sequences.targets
        cover(model, data, seen, symmetry and symmetry.tokens.copies)
        if init_from is not None:
            model.training_range.widen(init_from.training_range)
        if symmetry is not None:
            symmetry.complete_range(model.training_range)

    def make_model(self, data: TensorDict, symmetry: Symmetry | None) -> NeRD:
        """The configured model with fresh weights."""
        stats = data_stats(self.scene, data, self.config.features)
        stats = stats if symmetry is None else symmetry.complete(stats)
        return make_model(self.scene, self.config, stats, symmetry)

    def make_optimizers(self) -> dict[str, torch.optim.Optimizer]:
        """Muon for the weights of linear layers, AdamW for all others."""
        return make_optimizers(self.model.network, self.config, self.device)

    def run(self, until: int | None = None) -> NeRD:
        """Train to the end, or to update ``until``; returns the averaged model."""
        total = self.config.total_steps
        last = total if until is None else min(until, total)
        settings = {"scene": self.scene.name, **asdict(self.config)}
        logger = open_logger(self.logger, self.folder, self.step, settings)
        log = TrainingLog(self.folder, self.step, logger)
        began = time.monotonic() - self.seconds
        how = {"desc": f"train {self.scene.name}", "disable": self.quiet}
        with tqdm(total=self.config.total_steps, initial=self.step, **how) as bar:
            while self.step < last:
                loss = self.update()
                self.step += 1
                self.seconds, self.errors = time.monotonic() - began, {}
                if self._is_due(self.config.validate_every):
                    found = self.validate()
                    log.write({"step": self.step, "loss": float(loss), **found})
                    bar.set_postfix({k: f"{v:.2g}" for k, v in found.items()})
                if self._is_due(self.config.save_every):
                    self.save()
                bar.update()
        log.close()
        return self.averaged_model()

    def _is_due(self, every: int) -> bool:
        return self.step % every == 0 or self.step == self.config.total_steps

    def update(self) -> Tensor:
        """One update; returns its loss ``()``. Seed and step alone decide the batch."""
        config, generator = self.config, fold_in(self.config.seed, self.step)
        self.lr_ratio.fill_(learning_rate_ratio(config, self.step))
        self.ema_share.fill_(1.0 - min(config.ema, self.step / (self.step + 10.0)))
        self.model.train()
        if self.step >= config.steps:
            sizes = config.rollout_batch_size, config.rollout_states
            batch = self.sequences.rollout(*sizes, generator)
            return self._follow["rollout"](*batch)
        count, length = config.batch_size, config.sequence_length
        if torch.rand((), generator=generator) < config.single_step_fraction:
            count, length = count * length, 1  # more diverse: neighbours are alike
        inputs, targets = self.sequences.one_step(count, length, generator)
        is_coarse = self.step < config.bf16_fraction * config.steps
        return self._follow["bfloat16" if is_coarse else "one_step"](*inputs, targets)

    def _one_step(self, *batch: Tensor) -> Tensor:
        """Loss of a batch of sequences."""
        inputs, targets = Inputs(*batch[:-1]), batch[-1]
        changes = inputs.change(self.model.network(inputs.token).float())
        return one_step_loss(changes, targets, self.weights, self.config.loss_eps)

    def _rollout(self, *batch: Any) -> Tensor:
        """Loss of the model's own rollouts."""
        how = {"parameters": batch[-1], "loss_eps": self.config.loss_eps}
        history = self.config.rollout_history
        return rollout_loss(self.model, *batch[:-1], **how, history=history)

    def follow(self, loss_of: Callable[..., Tensor], *batch: Tensor | None) -> Tensor:
        """Follow the gradient of a batch's loss ``()``, which is returned."""
        for optimizer in self.optimizers.values():
            optimizer.zero_grad()
        with torch.enable_grad():
            loss = loss_of(*batch)
        loss.backward()
        weights = list(self.model.network.parameters())
        norm = nn.utils.clip_grad_norm_(weights, self.config.clip)
        with torch.no_grad():
            follow_gradient(weights, self.optimizers, norm, self.lr_ratio)
            for name, weight in self.model.network.named_parameters():
                self.average[name].lerp_(weight, self.ema_share)
        return loss.detach()

    def averaged_model(self) -> NeRD:
        """A copy of the model with the averaged weights and its sleep threshold."""
        model = copy.deepcopy(self.model)
        model.network.load_state_dict(self.average, strict=False)  # mirrors stay
        find_rest(model.eval(), *self.rest)
        return model

    def validate(self) -> dict[str, float]:
        """Mean errors of the averaged model by ``quantity_horizon``; the best one is saved.

        Models are compared by the sum of their errors at the longest horizon.
        """
        both = NeRDDynamics(self.averaged_model()), MujocoDynamics(self.scene)
        how = self.horizons, ROLLOUTS, SEED, self.device, self.random_actions
        history = self.config.rollout_history
        self.errors = passive_errors(self.source, *both, *how, history)
        found = sum(error.mean for error in self.errors[max(self.horizons)].values())
        # the first model is saved even if its rollouts diverge
        if found < self.best or not (self.folder / "best").exists():
            self._save_model("best")
        self.best = min(self.best, found)
        return means_by_horizon(self.errors)

    def save(self) -> None:
        """Write all that a resumed run needs; the card is written last."""
        self._save_model("last")
        self.state.save(self.folder, self.step, self.best)
        write_json(self.folder / STATE, self.identity | {"seconds": self.seconds})

    def _save_model(self, name: str) -> None:
        training = {
            **asdict(self.config),
            "steps_done": self.step,
            "seconds": round(self.seconds, 1),
            "device": str(self.device),
            "threads": torch.get_num_threads(),
            "trajectories": len(self.sequences.targets),
            "init_from": self.init_from,
        }
        errors = {
            str(horizon): {name: asdict(error) for name, error in by_name.items()}
            for horizon, by_name in self.errors.items()
        }
        about = {"training": training, "validation_error": errors}
        model = self.averaged_model()
        save_checkpoint(model, self.folder / name, make_card(model, about))

    def _resume(self) -> None:
        card = read_json(self.folder / STATE)
        expect_same(f"{self.folder} holds a run", card, self.identity)
        self.step, self.best = self.state.restore(self.folder)
        seconds = card.get("seconds")
        if not 0 < self.step <= self.config.total_steps or type(seconds) is not float:
            raise ValueError(
                f"expected a step of this run and its seconds in {self.folder}, got "
                f"{self.step} and {seconds!r}"
            )
        self.seconds = seconds
