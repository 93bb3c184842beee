"""Optimizers, their learning rates, and the state of a run that can be resumed."""

from collections.abc import Mapping
from pathlib import Path

import torch
from torch import Tensor, nn
from torch.optim import AdamW, Optimizer

from torchrl_nerd.configs import TrainConfig
from torchrl_nerd.tensor_files import expect_fit, read_tensors, write_tensors
from torchrl_nerd.training.muon import Muon

STATE = "state.safetensors"


def split_parameters(network: nn.Module) -> tuple[list[Tensor], list[Tensor]]:
    """Matrices ``(*blocks, out, in)`` of linear layers, for Muon, and other weights."""
    matrices, others = [], []
    for name, weight in network.named_parameters():
        is_matrix = weight.ndim >= 2 and "offset_bias" not in name
        (matrices if is_matrix else others).append(weight)
    return matrices, others


def make_adamw(weights: list[Tensor], lr: float, device: torch.device) -> AdamW:
    """AdamW without weight decay that averages squared gradients over about 20 updates."""
    how = {"betas": (0.9, 0.95), "weight_decay": 0.0}
    return AdamW(weights, lr=lr, capturable=device.type == "cuda", **how)


def make_optimizers(
    network: nn.Module, config: TrainConfig, device: torch.device
) -> dict[str, Optimizer]:
    """Muon for the weights of linear layers, AdamW for all others."""
    matrices, others = split_parameters(network)
    return {
        "muon": Muon(matrices, config.lr),
        "adamw": make_adamw(others, config.adamw_lr, device),
    }


def follow_gradient(
    weights: list[nn.Parameter],
    optimizers: Mapping[str, Optimizer],
    norm: Tensor,
    ratio: Tensor,
) -> None:
    """A step of every optimizer at its peak learning rate, of which ``ratio`` counts.

    Both optimizers move weights in proportion to their learning rate. A ratio ``()`` on the
    device can change inside a CUDA graph, a learning rate cannot. No weight moves where the
    gradient's ``norm ()`` is not finite.
    """
    is_finite = norm.isfinite()
    for grad in (weight.grad for weight in weights if weight.grad is not None):
        grad.copy_(torch.where(is_finite, grad, 0.0))
    before = [weight.clone() for weight in weights]
    for optimizer in optimizers.values():
        optimizer.step()
    for weight, old in zip(weights, before, strict=True):
        weight.copy_(old.lerp(weight, ratio * is_finite))


def learning_rate_ratio(config: TrainConfig, step: int) -> float:
    """Share of the peak learning rate at update ``step``, counted from 0.

    One-step updates: linear warmup, times a linear fall to zero. Rollout updates: a linear
    fall from ``rollout_lr_ratio`` to zero, repeated ``rollout_restarts`` times.
    """
    if step < config.steps:
        warmup = min(1.0, (step + 1) / max(config.warmup, 1))
        return warmup * (1.0 - step / config.steps)
    done = config.rollout_restarts * (step - config.steps) / config.rollout_steps
    return config.rollout_lr_ratio * (1.0 - done % 1.0)


class RunState:
    """The tensors of a run, saved to one file and restored in place."""

    def __init__(
        self,
        network: nn.Module,
        average: Mapping[str, Tensor],
        optimizers: Mapping[str, Optimizer],
    ) -> None:
        self.network, self.average, self.optimizers = network, average, optimizers
        for optimizer in optimizers.values():
            _allocate_state(optimizer)

    def tensors(self) -> dict[str, Tensor]:
        """The tensors themselves, not copies, by name."""
        found = {f"model.{k}": v for k, v in self.network.state_dict().items()}
        found |= {f"average.{k}": v for k, v in self.average.items()}
        for name, optimizer in self.optimizers.items():
            for index, state in optimizer.state_dict()["state"].items():
                found |= {f"{name}.{index}.{k}": v for k, v in state.items()}
        return found

    def save(self, folder: Path, step: int, best: float) -> None:
        """Write all tensors with the update's number and the best validation error."""
        numbers = {"step": torch.tensor(step)}
        numbers["best"] = torch.tensor(best, dtype=torch.float64)
        write_tensors(folder / STATE, {**self.tensors(), **numbers})

    def restore(self, folder: Path) -> tuple[int, float]:
        """Restore what `save` wrote; returns the number of the update and the best error.

        Raises:
            ValueError: in one sentence, a file that does not fit this run.
        """
        path = folder / STATE
        found, own = read_tensors(path), self.tensors()
        best = found.pop("best", torch.tensor([]))  # infinite before any validation
        expected = {**own, "step": torch.tensor(0)}
        expect_fit(found, expected, f"tensors in {path}", "this run")
        if best.shape or best.dtype != torch.float64 or best.isnan():
            raise ValueError(f"expected the best error in {path}, got {best}")
        with torch.no_grad():
            for name, tensor in own.items():
                tensor.copy_(found[name])
        return int(found["step"]), float(best)


def _allocate_state(optimizer: Optimizer) -> None:
    """Give every weight the optimizer's state that its first update would create.

    A resumed run then compares names and shapes of a saved state with its own. No weight
    moves: the gradient is zero and there is no weight decay.
    """
    weights = [weight for group in optimizer.param_groups for weight in group["params"]]
    for weight in weights:
        weight.grad = torch.zeros_like(weight)
    optimizer.step()
    optimizer.zero_grad()
    for weight in weights:
        for value in optimizer.state[weight].values():
            value.zero_()
