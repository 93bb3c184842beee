"""Optimizers of the trainer: Muon for weight matrices, AdamW for all other weights."""

import torch
from torch import Tensor, nn
from torch.optim import AdamW, Muon, Optimizer

from torchrl_nerd.configs import TrainConfig


def split_parameters(network: nn.Module) -> tuple[list[Tensor], list[Tensor]]:
    """Weights ``(out, in)`` of linear layers, for Muon, and all other weights."""
    matrices, others = [], []
    for name, weight in network.named_parameters():
        is_matrix = weight.ndim == 2 and "offset_bias" not in name
        (matrices if is_matrix else others).append(weight)
    return matrices, others


def make_muon(matrices: list[Tensor], lr: float) -> Muon:
    """Muon without weight decay, steps scaled by ``sqrt(max(1, rows / columns))``."""
    return Muon(matrices, lr, weight_decay=0.0, adjust_lr_fn="original")


def make_adamw(weights: list[Tensor], lr: float) -> AdamW:
    """AdamW without weight decay that averages squared gradients over about 20 updates."""
    return AdamW(weights, lr=lr, betas=(0.9, 0.95), weight_decay=0.0)


def allocate_state(optimizer: Optimizer) -> None:
    """Give every weight the optimizer's state that its first update would create.

    A resumed run can then compare names and shapes of a saved state with its own. The
    weights keep their values: the gradient is zero and there is no weight decay.
    """
    weights = [weight for group in optimizer.param_groups for weight in group["params"]]
    for weight in weights:
        weight.grad = torch.zeros_like(weight)
    optimizer.step()
    optimizer.zero_grad()
    for weight in weights:
        for value in optimizer.state[weight].values():
            value.zero_()


def learning_rate_ratio(config: TrainConfig, step: int) -> float:
    """Share of the peak learning rate at an update.

    One-step updates: linear warmup, times a linear fall to zero. Rollout updates: a linear
    fall from ``rollout_lr_ratio`` to zero, repeated ``rollout_restarts`` times.

    Args:
        config: of the training.
        step: number of the update, from 0.
    """
    if step < config.steps:
        warmup = min(1.0, (step + 1) / max(config.warmup, 1))
        return warmup * (1.0 - step / config.steps)
    done = config.rollout_restarts * (step - config.steps) / config.rollout_steps
    return config.rollout_lr_ratio * (1.0 - done % 1.0)
