"""Fine-tuning on recorded tosses: rollouts over the impact, few epochs, frozen statistics.

One epoch shows every window of the training tosses once, as in the paper's code. The same
class trains from scratch, for comparison, and on simulated tosses.
"""

import copy
import time
from collections.abc import Callable
from dataclasses import asdict
from functools import cached_property
from typing import Any, cast

import torch
from tensordict import TensorDict
from torch import Generator, Tensor, nn
from tqdm import tqdm

from torchrl_nerd.configs import FinetuneConfig
from torchrl_nerd.data.cube_tosses import Tosses
from torchrl_nerd.evaluation.parameter_fit import WINDOWS
from torchrl_nerd.evaluation.toss_error import STATES
from torchrl_nerd.modules.hybrid import HybridNeRD
from torchrl_nerd.modules.nerd import NeRD
from torchrl_nerd.settings import SettingError
from torchrl_nerd.training.convergence import converged, score
from torchrl_nerd.training.low_rank import add_low_rank, merge_low_rank
from torchrl_nerd.training.physics_fit import fit_physics
from torchrl_nerd.training.pose_loss import pose_loss, rollout
from torchrl_nerd.training.symmetry import Isometry, find_isometries
from torchrl_nerd.training.toss_view import TossView

VALIDATION_STRIDE = 5  # of the validation tosses' sub-trajectories, which overlap
IMAGES = 8  # isometries per batch
WARMUP = 10  # updates over which step sizes rise
BAR = "epochs {n:.2f}/{total:.2f} |{bar}| {elapsed}<{remaining}{postfix}"


class FineTuner:
    """Trains a model on windows of tosses; `run` returns the best one on validation.

    Args:
        model: pretrained; left as it is, and trained on its device. Its statistics are
            frozen.
        tosses: recorded.
        train: numbers of the tosses to train on.
        validation: numbers of the tosses that choose the best model and when to stop.
        config: how.
        quiet: no progress bar.
        keep: called with every model that is better than all before.

    Raises:
        ValueError: tosses that are too short, or physics to fit without a simulator.
    """

    def __init__(
        self,
        model: NeRD,
        tosses: Tosses,
        train: Tensor,
        validation: Tensor,
        config: FinetuneConfig,
        quiet: bool = False,
        keep: Callable[[NeRD], object] | None = None,
    ) -> None:
        torch.manual_seed(config.seed)
        self.config, self.tosses, self.quiet = config, tosses, quiet
        self.train = train
        self.model, self.keep = copy.deepcopy(model), keep
        self.view = TossView(model.scene, tosses, config, model.device)
        states = STATES if config.update == "physics" else config.sequence_length + 1
        self.starts = self.view.starts(states, train)
        self.checks = self.view.starts(STATES, validation)[::VALIDATION_STRIDE]
        for name, found in (("training", self.starts), ("validation", self.checks)):
            if len(found) == 0:
                raise ValueError(
                    f"expected {name} tosses that are long enough, got none"
                )
        if config.update == "physics" and not isinstance(model, HybridNeRD):
            raise SettingError(
                "expected a model with a simulator for update 'physics', got another: "
                "give update 'all', 'head' or 'low-rank'"
            )
        network = cast(nn.Module, self.model.network)
        if config.update == "low-rank":
            add_low_rank(network, config.rank)
        for name, weight in network.named_parameters():
            is_chosen = config.update != "head" or "head" in name
            if config.update == "low-rank":
                is_chosen = ".parametrizations." in name and "original" not in name
            weight.requires_grad_(is_chosen)
        chosen = [w for w in network.parameters() if w.requires_grad]
        groups = [{"params": chosen, "lr": config.lr}]
        if isinstance(model, HybridNeRD):
            simulator = cast(HybridNeRD, self.model).analytic_step
            physics = [simulator.raw]
            groups.append({"params": physics, "lr": config.physics_lr})
        if self.view.encoder is not None:
            weights = list(self.view.encoder.parameters())
            groups.append({"params": weights, "lr": config.lr})
        self.optimizer = torch.optim.Adam(groups)
        self.peaks = [group["lr"] for group in groups]
        self.curve: list[dict[str, float]] = []

    @cached_property
    def isometries(self) -> tuple[Isometry, ...]:
        """What windows are shown as: a search that the fit of physics does without."""
        found = find_isometries(self.model.scene)
        return found if self.config.use_symmetry else found[:1]

    @property
    def updates_per_epoch(self) -> int:
        """Updates that show every window once."""
        return -(-len(self.starts) // self.config.batch_size)

    def run(self) -> NeRD:
        """Train until the epochs are over or validation stands still."""
        self._began = time.monotonic()
        self._consider(0.0)
        if self.config.update == "physics":
            self._fit()
        else:
            self._descend()
        self.model, self.view.encoder = self._best
        return self.model

    def _bar(self, count: int, per_epoch: int) -> tqdm:
        scale = 1.0 / per_epoch
        bar = tqdm(total=count, unit_scale=scale, bar_format=BAR, disable=self.quiet)
        bar.set_postfix(self._last)
        return bar

    def _fit(self) -> None:
        """Physics alone, without gradients; an evaluation counts as its share of one."""
        model, evaluations = cast(HybridNeRD, self.model), self.config.evaluations
        epoch = len(self.starts)
        planned = evaluations * sum(min(windows, epoch) for windows in WINDOWS)
        seen = 0

        def show(windows: int) -> None:
            nonlocal seen
            seen += windows
            bar.update(windows)

        with self._bar(planned, epoch) as bar:
            for _ in fit_physics(model, self.view, self.train, evaluations, show):
                self._consider(seen / epoch)
                bar.set_postfix(self._last)

    def _descend(self) -> None:
        """All that may change, along the gradient of rollouts."""
        config, waited = self.config, 0
        total = max(1, round(config.epochs * self.updates_per_epoch))
        generator = Generator().manual_seed(config.seed)
        order = torch.zeros(0, dtype=torch.long)
        with self._bar(total, self.updates_per_epoch) as bar:
            for update in range(1, total + 1):
                if len(order) == 0:
                    order = torch.randperm(len(self.starts), generator=generator)
                pick, order = order[: config.batch_size], order[config.batch_size :]
                is_short = update <= config.short_history_fraction * total
                length = (
                    max(1, config.sequence_length // 2)
                    if is_short
                    else config.sequence_length
                )
                rate = min(1.0, update / WARMUP) * (1.0 - (update - 1) / total)
                for group, peak in zip(
                    self.optimizer.param_groups, self.peaks, strict=True
                ):
                    group["lr"] = peak * rate
                loss = self._update(self._batch(self.starts[pick], length, generator))
                bar.update()
                if update % config.validate_every == 0 or update == total:
                    is_better = self._consider(update / self.updates_per_epoch, loss)
                    bar.set_postfix(self._last)
                    waited = 0 if is_better or is_short else waited + 1
                    if waited >= config.patience:
                        break

    def _batch(self, starts: Tensor, length: int, generator: Generator) -> TensorDict:
        """Windows ``[rows, length + 1]``, mirrored and with a little noise."""
        window = self.view.windows(starts, length + 1)
        order = torch.randperm(len(self.isometries), generator=generator)[:IMAGES]
        parts = window.chunk(len(order))
        images = [
            self.isometries[i](cast(TensorDict, part))
            for i, part in zip(order.tolist(), parts, strict=False)
        ]
        return cast(TensorDict, TensorDict.cat(images)).to(self.model.device)

    def _update(self, window: TensorDict) -> float:
        """One step of the optimiser; its loss."""
        config = self.config
        self.model.train()
        with torch.enable_grad():
            start, qvel, qpos = self.view.observe(window)
            start = start + config.noise * torch.nn.functional.pad(
                torch.randn_like(start[:, :3]), (0, 4)
            )
            path = rollout(self.model, start, qvel, qpos.shape[1])
            step = torch.arange(1, qpos.shape[1] + 1)
            loss = pose_loss(path, qpos, step % config.every == 0)
        self.optimizer.zero_grad()
        loss.backward()
        for group in self.optimizer.param_groups:
            norm = nn.utils.clip_grad_norm_(group["params"], config.clip)
            if not norm.isfinite():
                return float("nan")
        self.optimizer.step()
        return float(loss.detach())

    def _consider(self, epoch: float, loss: float = float("nan")) -> bool:
        """Validate, add to the curve, and keep the model if it is the best so far."""
        distance, angle = self.errors(self.checks)
        point = {
            "epoch": epoch,
            "seconds": time.monotonic() - self._began,
            "loss": loss,
            "position_m": float(distance.mean()),
            "orientation_rad": float(angle.mean()),
        }
        best = min((score(before) for before in self.curve), default=None)
        self.curve.append(point)
        is_better = best is None or score(point) < best
        if is_better:
            self._best = self._frozen(), copy.deepcopy(self.view.encoder)
            if self.keep is not None:
                self.keep(self._best[0])
        return is_better

    @property
    def _last(self) -> dict[str, str]:
        """The curve's last point, for the progress bar."""
        last = self.curve[-1]
        shown = {"m": last["position_m"], "rad": last["orientation_rad"]}
        return {name: f"{value:.4f}" for name, value in shown.items()}

    def errors(self, rows: Tensor) -> tuple[Tensor, Tensor]:
        """Errors of sub-trajectories against the recorded poses; see `TossView.errors`.

        Args:
            rows: as of `TossView.starts`.
        """
        return self.view.errors(self.model, rows, self.tosses)

    def _frozen(self) -> NeRD:
        """A copy of the model as it is now, low-rank changes added to its weights."""
        model = copy.deepcopy(self.model)
        merge_low_rank(cast(nn.Module, model.network))
        return model.requires_grad_(True).eval()

    def card(self) -> dict[str, Any]:
        """Configuration, curve and convergence, for a checkpoint's card."""
        return {"finetuning": {**asdict(self.config), **converged(self.curve)}}
