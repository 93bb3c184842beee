"""Fine-tuning on recorded trajectories: rollouts from recorded states, few epochs.

Weights follow the gradient of a rollout's error. The physical parameters of an analytic
step are fitted without gradients. Normalisation statistics stay as they are. One epoch
shows every window of the training trajectories once.
"""

import copy
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict
from typing import Any

import torch
from tensordict import TensorDict
from torch import Generator, Tensor, nn
from tqdm import tqdm

from torchrl_nerd.analytic import FreeBodyPenaltyStep
from torchrl_nerd.analytic.free_body import PARAMETERS
from torchrl_nerd.checkpoint import from_pretrained
from torchrl_nerd.configs import FinetuneConfig
from torchrl_nerd.data.recorded import Recording
from torchrl_nerd.dynamics import Model, dynamics_of
from torchrl_nerd.evaluation.position_error import Errors, unit_of
from torchrl_nerd.evaluation.recorded_error import (
    error_key,
    errors_along,
    window_errors,
)
from torchrl_nerd.modules.nerd import NeRD
from torchrl_nerd.robots import recorded_protocol
from torchrl_nerd.scenes import Scene
from torchrl_nerd.settings import SettingError
from torchrl_nerd.training.physics_fit import WINDOWS, fit_flight, fit_parameters

VALIDATION_STRIDE = 5  # of the validation windows, which overlap
ANALYTIC = "analytic"  # name of a step without weights, where models are named
WARMUP = 10  # updates over which the step size rises
SCALES = {"m": 0.05, "rad": 1.0}  # errors that weigh alike
BAR = "epochs {n:.2f}/{total:.2f} |{bar}| {elapsed}<{remaining}{postfix}"

Curve = Sequence[Mapping[str, float]]
"""Validation errors by ``epoch`` and ``seconds``, such as ``position_m``."""


def start_model(scene: Scene, name: str | None = None) -> Model:
    """The model that fine-tuning starts from.

    ``name``: a shipped model, a checkpoint folder, or ``"analytic"``: a step with the
    published physical parameters, or the scene's own where none are. None: analytic where
    some are published, else the shipped model.
    """
    published = recorded_protocol(scene.name).parameters
    if name != ANALYTIC and (name is not None or not published):
        return from_pretrained(name or scene.name, scene)
    step = FreeBodyPenaltyStep(scene)
    step.set_values(dict(published))
    return step


class FineTuner:
    """Trains a model on windows of recorded trajectories; `run` returns the best one.

    Args:
        model: a network or an analytic step, left as it is; a copy trains on its device.
        recording: trajectories of its scene.
        train: numbers ``(n,)`` of the trajectories to train on.
        validation: numbers of those that choose the best model and when to stop.
        config: what changes, and how.
        quiet: no progress bar.
        keep: called with every model that is better than all before.

    Raises:
        SettingError: an update that the model does not have.
        ValueError: trajectories that are too short.
    """

    def __init__(
        self,
        model: Model,
        recording: Recording,
        train: Tensor,
        validation: Tensor,
        config: FinetuneConfig,
        quiet: bool = False,
        keep: Callable[[Model], object] | None = None,
    ) -> None:
        torch.manual_seed(config.seed)
        is_fit = isinstance(model, FreeBodyPenaltyStep)
        self.update = config.update or ("physics" if is_fit else "all")
        can_learn = is_fit or isinstance(model, NeRD)
        if (self.update == "physics") != is_fit or not can_learn:
            raise SettingError(
                "expected update 'physics' for a free body's analytic step, 'all' or "
                f"'head' for a network, got '{self.update}' for {type(model).__name__}"
            )
        self.config, self.recording, self.quiet = config, recording, quiet
        self.model, self.train, self.keep = copy.deepcopy(model), train, keep
        states = config.states if is_fit else config.sequence_length + 1
        self.starts = recording.starts(states, train)
        self.checks = recording.starts(config.states, validation)[::VALIDATION_STRIDE]
        self.curve: list[dict[str, float]] = []
        if isinstance(self.model, NeRD):
            network = self.model.network
            chosen = network if self.update == "all" else network.head
            network.requires_grad_(False)
            weights = chosen.requires_grad_(True).parameters()
            self.optimizer = torch.optim.Adam(weights, lr=config.lr)

    @property
    def updates_per_epoch(self) -> int:
        """Updates that show every window once."""
        return -(-len(self.starts) // self.config.batch_size)

    def run(self) -> Model:
        """Train until the epochs are over or validation no longer improves."""
        self._began = time.monotonic()
        self._consider(0.0)
        if self.update == "physics":
            self._fit()
        else:
            self._descend()
        self.model = self._best
        return self.model

    def _bar(self, count: int, per_epoch: int) -> tqdm:
        scale = 1.0 / per_epoch
        bar = tqdm(total=count, unit_scale=scale, bar_format=BAR, disable=self.quiet)
        bar.set_postfix_str(self._last)
        return bar

    def _fit(self) -> None:
        """Physical parameters, without gradients; a window counts as part of an epoch."""
        step, scene = self.model, self.model.scene
        assert isinstance(step, FreeBodyPenaltyStep)
        epoch, evaluations, seen = len(self.starts), self.config.evaluations, 0
        planned = evaluations * sum(min(windows, epoch) for windows in WINDOWS)

        def error_of(values: dict[str, float], starts: Tensor) -> float:
            nonlocal seen
            seen += len(starts)
            bar.update(len(starts))
            step.set_values(values)
            return float(weighted_error(scene, self.errors(starts)).mean())

        first = step.values() | fit_flight(scene, self.recording.select(self.train))
        how = evaluations, self.config.seed
        stages = fit_parameters(error_of, first, PARAMETERS, self.starts, *how)
        with self._bar(planned, epoch) as bar:
            for found in stages:
                step.set_values(found)
                self._consider(seen / epoch)
                bar.set_postfix_str(self._last)

    def _descend(self) -> None:
        """The chosen weights, along the gradient of rollouts."""
        config, waited = self.config, 0
        # a share of an epoch is one update at least
        total = max(
            round(config.epochs * self.updates_per_epoch), int(config.epochs > 0)
        )
        generator = Generator().manual_seed(config.seed)
        batches: list[Tensor] = []
        with self._bar(total, self.updates_per_epoch) as bar:
            for update in range(1, total + 1):
                if not batches:
                    order = torch.randperm(len(self.starts), generator=generator)
                    batches = list(self.starts[order].split(config.batch_size))
                is_short = update <= config.short_history_fraction * total
                length = config.sequence_length // (2 if is_short else 1)
                rate = min(1.0, update / WARMUP) * (1.0 - (update - 1) / total)
                self.optimizer.param_groups[0]["lr"] = config.lr * rate
                loss = self._step(batches.pop(0), max(1, length))
                bar.update()
                if update % config.validate_every == 0 or update == total:
                    is_better = self._consider(update / self.updates_per_epoch, loss)
                    bar.set_postfix_str(self._last)
                    waited = 0 if is_better or is_short else waited + 1
                    if waited >= config.patience:
                        break

    def _step(self, starts: Tensor, length: int) -> float:
        """One step of the optimiser on rollouts of ``length`` steps; its loss."""
        window = self.recording.windows(starts, length + 1).to(self.model.device)
        with torch.enable_grad():
            loss = rollout_error(self.model, window).mean()
        self.optimizer.zero_grad()
        loss.backward()
        weights = self.optimizer.param_groups[0]["params"]
        norm = nn.utils.clip_grad_norm_(weights, self.config.clip)
        if not norm.isfinite():
            return float("nan")
        self.optimizer.step()
        return float(loss.detach())

    def _consider(self, epoch: float, loss: float = float("nan")) -> bool:
        """Validate, add to the curve, and keep the model if it is the best so far."""
        scene = self.model.scene
        seconds = time.monotonic() - self._began
        point = {"epoch": epoch, "seconds": seconds, "loss": loss}
        for quantity, error in self.errors(self.checks).items():
            point[error_key(scene, quantity, "_")] = float(error.mean())
        is_better = all(score(point) < score(before) for before in self.curve)
        self.curve.append(point)
        if is_better:
            self._best = copy.deepcopy(self.model).requires_grad_(True).eval()
            if self.keep is not None:
                self.keep(self._best)
        return is_better

    @property
    def _last(self) -> str:
        """The errors of the curve's last point, for the progress bar."""
        return ", ".join(f"{k} {v:.3g}" for k, v in errors_of(self.curve[-1]).items())

    @torch.no_grad()
    def errors(self, starts: Tensor) -> Errors:
        """`window_errors` of the model as it is now, from frames ``starts`` on."""
        dynamics = dynamics_of(self.model)
        return window_errors(dynamics, self.recording, starts, self.config.states)

    def card(self) -> dict[str, Any]:
        """Configuration and convergence, for a checkpoint's card."""
        how = asdict(self.config) | {"update": self.update}
        return {"finetuning": {**how, **converged(self.curve)}}


def rollout_error(model: Model, window: TensorDict) -> Tensor:
    """`weighted_error` of a rollout from the first of ``[windows, steps + 1]``."""
    dynamics = dynamics_of(model, differentiable=True)
    return weighted_error(model.scene, errors_along(dynamics, window))


def weighted_error(scene: Scene, errors: Errors) -> Tensor:
    """Sum of all errors, each by its scale, ``(windows, steps)``.

    Not squared: after a first impact that was missed all that follows is far off, and must
    not outweigh the impacts that can be learned.
    """
    parts = [error / SCALES[unit_of(scene, name)] for name, error in errors.items()]
    return torch.stack(parts).sum(0)


def errors_of(point: Mapping[str, float]) -> dict[str, float]:
    """The errors of a curve's point, by quantity and unit."""
    return {k: v for k, v in point.items() if k not in ("epoch", "seconds", "loss")}


def score(point: Mapping[str, float]) -> float:
    """All errors by the scales of the loss; infinite where one is no number."""
    found = sum(v / SCALES[k.rsplit("_", 1)[1]] for k, v in errors_of(point).items())
    return found if found == found else float("inf")


def converged(curve: Curve) -> dict[str, float]:
    """Epochs and seconds until the error was within 5% of the run's lowest, and that."""
    scores = [score(point) for point in curve]
    lowest = min(scores)
    first = next(p for p, x in zip(curve, scores, strict=True) if x <= 1.05 * lowest)
    best = curve[scores.index(lowest)]
    found = {f"converged_{key}": first[key] for key in ("epoch", "seconds")}
    return found | {f"validation_{k}": v for k, v in errors_of(best).items()}
