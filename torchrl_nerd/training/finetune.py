"""Fine-tuning on recorded tosses: rollouts over the impact, few epochs, frozen statistics.

One epoch shows every window of the training tosses once, as in the paper's code. The same
class trains from scratch, for comparison, and on simulated tosses.
"""

import copy
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any, Literal, cast

import torch
from tensordict import TensorDict
from torch import Generator, Tensor, nn
from tqdm import tqdm

from torchrl_nerd.data.cube_tosses import Tosses
from torchrl_nerd.dynamics import NeRDDynamics
from torchrl_nerd.evaluation.rollout_error import open_loop
from torchrl_nerd.evaluation.toss_error import STATES, path_errors, toss_errors
from torchrl_nerd.geometry.frames import quat_exp, quat_multiply
from torchrl_nerd.keys import QPOS, QVEL
from torchrl_nerd.modules.nerd import NeRD
from torchrl_nerd.modules.pose_encoder import PoseEncoder
from torchrl_nerd.modules.residual import ResidualNeRD
from torchrl_nerd.settings import SettingError, expect_at_least
from torchrl_nerd.training.low_rank import add_low_rank, merge_low_rank
from torchrl_nerd.training.pose_loss import (
    ORIENTATION_SCALE,
    POSITION_SCALE,
    pose_loss,
    rollout,
)
from torchrl_nerd.training.symmetry import find_isometries

Update = Literal["all", "head", "low-rank"]
Observe = Literal["states", "poses"]
VALIDATION_STRIDE = 5  # of the validation tosses' sub-trajectories, which overlap
IMAGES = 8  # isometries per batch
WARMUP = 10  # updates over which step sizes rise


@dataclass(frozen=True)
class FinetuneConfig:
    """How to fine-tune.

    | field | meaning |
    |---|---|
    | ``epochs`` | at most; an epoch shows every training window once |
    | ``rows`` | windows per update |
    | ``length`` | steps of a rollout |
    | ``short_share`` | share of the updates, the first ones, at half that length |
    | ``update`` | all weights, the head alone, or low-rank changes of all matrices |
    | ``rank`` | of low-rank changes |
    | ``lr`` | peak step size of the network |
    | ``physics_lr`` | peak step size of a simulator's parameters, if there is one |
    | ``noise`` | m, added to starts: of a position, and of corners that turns move |
    | ``use_symmetry`` | show each window as a random one of its mirror images |
    | ``clip`` | largest norm of the network's gradient |
    | ``validate_every`` | updates between rollouts of the validation tosses |
    | ``patience`` | validations without progress before it stops |
    | ``observe`` | whole states, or poses alone: a window encoder finds the start |
    | ``every`` | control steps between observed poses |
    | ``pose_noise`` | m, added to every observed pose: a worse camera |
    | ``poses`` | in the encoder's window |
    | ``seed`` | of batches and fresh weights |
    """

    epochs: float = 2.0
    rows: int = 384
    length: int = 24
    short_share: float = 0.5
    update: Update = "all"
    rank: int = 4
    lr: float = 1e-3
    physics_lr: float = 1e-2
    noise: float = 2e-5
    use_symmetry: bool = True
    clip: float = 0.3
    validate_every: int = 20
    patience: int = 4
    observe: Observe = "states"
    every: int = 1
    pose_noise: float = 0.0
    poses: int = 4
    seed: int = 0

    def __post_init__(self) -> None:
        if self.update not in ("all", "head", "low-rank"):
            raise SettingError(
                f"expected update 'all', 'head' or 'low-rank', got '{self.update}'"
            )
        if self.observe not in ("states", "poses"):
            raise SettingError(
                f"expected observe 'states' or 'poses', got '{self.observe}'"
            )
        if self.observe == "states" and (self.every > 1 or self.pose_noise > 0.0):
            raise SettingError("expected observe 'poses' with every or pose_noise")
        counts = ("every", "rows", "length", "rank", "validate_every", "patience")
        expect_at_least(1, **{name: getattr(self, name) for name in counts})
        for name in ("epochs", "lr", "physics_lr", "noise", "clip", "short_share"):
            expect_at_least(0, **{name: getattr(self, name)})


class FineTuner:
    """Trains a model on windows of tosses; `run` returns the best one on validation.

    Args:
        model: pretrained; left as it is. Its statistics are frozen.
        tosses: recorded.
        train: numbers of the tosses to train on.
        validation: numbers of the tosses that choose the best model and when to stop.
        config: how.
        quiet: no progress bar.
        keep: called with every model that is better than all before.
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
        self.model, self.keep = copy.deepcopy(model), keep
        self.encoder: PoseEncoder | None = None
        if config.observe == "poses":
            self.encoder = PoseEncoder(model.scene, config.poses, config.every)
            # what is seen: nothing else of the recordings is used below
            tosses = replace(tosses, qpos=noisy_poses(tosses.qpos, config))
        self.seen = tosses
        before = self.encoder.span if self.encoder else 0
        self.starts = tosses.starts(before + config.length + 1, train)
        self.checks = tosses.starts(before + STATES, validation)[::VALIDATION_STRIDE]
        for name, found in (("training", self.starts), ("validation", self.checks)):
            if len(found) == 0:
                raise ValueError(
                    f"expected {name} tosses that are long enough, got none"
                )
        self.isometries = find_isometries(model.scene)[
            : None if config.use_symmetry else 1
        ]
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
        if isinstance(model, ResidualNeRD):
            simulator = cast(ResidualNeRD, self.model).simulator
            physics = [simulator.raw]
            groups.append({"params": physics, "lr": config.physics_lr})
        if self.encoder is not None:
            weights = list(self.encoder.parameters())
            groups.append({"params": weights, "lr": config.lr})
        self.optimizer = torch.optim.Adam(groups)
        self.peaks = [group["lr"] for group in groups]
        self.curve: list[dict[str, float]] = []

    @property
    def updates_per_epoch(self) -> int:
        """Updates that show every window once."""
        return -(-len(self.starts) // self.config.rows)

    def run(self) -> NeRD:
        """Train until the epochs are over or validation stands still."""
        config = self.config
        total = max(1, round(config.epochs * self.updates_per_epoch))
        generator = Generator().manual_seed(config.seed)
        began, order = time.monotonic(), torch.zeros(0, dtype=torch.long)
        best, best_score, waited = self._frozen(), self._validate(0, 0.0), 0
        encoder = copy.deepcopy(self.encoder)
        epochs = tqdm(total=config.epochs, desc="epochs", disable=self.quiet)
        for update in range(1, total + 1):
            if len(order) == 0:
                order = torch.randperm(len(self.starts), generator=generator)
            pick, order = order[: config.rows], order[config.rows :]
            is_short = update <= config.short_share * total
            length = max(1, config.length // 2) if is_short else config.length
            rate = min(1.0, update / WARMUP) * (1.0 - (update - 1) / total)
            for group, peak in zip(
                self.optimizer.param_groups, self.peaks, strict=True
            ):
                group["lr"] = peak * rate
            loss = self._update(self._batch(self.starts[pick], length, generator))
            epochs.update(1 / self.updates_per_epoch)
            if update % config.validate_every == 0 or update == total:
                score = self._validate(update, time.monotonic() - began, loss)
                waited += 1
                if score < best_score:
                    best, best_score, waited = self._frozen(), score, 0
                    encoder = copy.deepcopy(self.encoder)
                    if self.keep is not None:
                        self.keep(best)
                last = self.curve[-1]
                epochs.set_postfix(m=last["position_m"], rad=last["orientation_rad"])
                if waited >= config.patience and not is_short:
                    break
        epochs.close()
        self.model, self.encoder = best, encoder
        return best

    def _batch(self, starts: Tensor, length: int, generator: Generator) -> TensorDict:
        """Windows ``[rows, length + 1]``, mirrored and with a little noise."""
        before = self.encoder.span if self.encoder else 0
        window = self.seen.windows(starts, before + length + 1)
        order = torch.randperm(len(self.isometries), generator=generator)[:IMAGES]
        parts = window.chunk(len(order))
        images = [
            self.isometries[i](cast(TensorDict, part))
            for i, part in zip(order.tolist(), parts, strict=False)
        ]
        return cast(TensorDict, TensorDict.cat(images))

    def _update(self, window: TensorDict) -> float:
        """One step of the optimiser; its loss."""
        config = self.config
        self.model.train()
        with torch.enable_grad():
            qpos, (start, qvel) = self._observed(window)
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

    def _observed(self, window: TensorDict) -> tuple[Tensor, tuple[Tensor, Tensor]]:
        """Poses after the start ``(rows, steps, 7)``, and the start's state."""
        qpos = window[QPOS]
        if self.encoder is None:
            return qpos[:, 1:], (qpos[:, 0], window[QVEL][:, 0])
        before, every = self.encoder.span, self.config.every
        return qpos[:, before + 1 :], self.encoder(qpos[:, : before + 1 : every])

    def _validate(
        self, update: int, seconds: float, loss: float = float("nan")
    ) -> float:
        """Error over validation tosses, by the scales of the loss; adds to the curve."""
        distance, angle = self.errors(self.checks)
        figures = {
            "update": float(update),
            "epoch": update / self.updates_per_epoch,
            "seconds": seconds,
            "loss": loss,
            "position_m": float(distance.mean()),
            "orientation_rad": float(angle.mean()),
        }
        self.curve.append(figures)
        score = figures["position_m"] / POSITION_SCALE
        score += figures["orientation_rad"] / ORIENTATION_SCALE
        return score if score == score else float("inf")

    @torch.no_grad()
    def errors(self, rows: Tensor) -> tuple[Tensor, Tensor]:
        """Errors of sub-trajectories against the recorded poses; see `toss_errors`.

        Args:
            rows: of the first state, or of the encoder's first pose: the 80 states
                come after its window then.
        """
        dynamics = NeRDDynamics(self.model)
        if self.encoder is None:
            return toss_errors(dynamics, self.tosses, rows)
        before = self.encoder.span
        seen = self.seen.windows(rows, before + STATES)
        _, (qpos, qvel) = self._observed(seen)
        start = TensorDict({QPOS: qpos, QVEL: qvel}, [len(rows)])
        measured = self.tosses.windows(rows + before, STATES)[QPOS][:, 1:]
        return path_errors(open_loop(dynamics, start, STATES - 1), measured)

    def _frozen(self) -> NeRD:
        """A copy of the model as it is now, low-rank changes added to its weights."""
        model = copy.deepcopy(self.model)
        merge_low_rank(cast(nn.Module, model.network))
        return model.requires_grad_(True).eval()

    def card(self) -> dict[str, Any]:
        """Configuration, curve and convergence, for a checkpoint's card."""
        return {"finetuning": {**asdict(self.config), **converged(self.curve)}}


def noisy_poses(qpos: Tensor, config: FinetuneConfig) -> Tensor:
    """Poses ``(N, 7)`` of a worse camera: the same for the same seed.

    A point 0.1 m from the centre is off by as much in its turn as in its place.
    """
    generator = Generator().manual_seed(config.seed)
    shape = (2, len(qpos), 3)
    noise = config.pose_noise * torch.randn(shape, generator=generator).to(qpos)
    turned = quat_multiply(qpos[:, 3:7], quat_exp(noise[1] / 0.1))
    return torch.cat((qpos[:, :3] + noise[0], turned), -1)


def converged(
    curve: Sequence[dict[str, float]], within: float = 0.05
) -> dict[str, float]:
    """Epochs and seconds after which the error was within 5% of the run's lowest."""
    scores = [
        point["position_m"] / POSITION_SCALE
        + point["orientation_rad"] / ORIENTATION_SCALE
        for point in curve
    ]
    lowest = min(score for score in scores if score == score)
    index = next(
        i for i, score in enumerate(scores) if score <= (1.0 + within) * lowest
    )
    keys = ("epoch", "seconds", "position_m", "orientation_rad")
    found = {f"converged_{key}": curve[index][key] for key in keys[:2]}
    best = curve[scores.index(lowest)]
    return {**found, **{f"validation_{key}": best[key] for key in keys[2:]}}
