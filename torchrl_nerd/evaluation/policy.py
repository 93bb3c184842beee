"""A policy as numbers: a small network, its normalisation, two files on disk."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import torch
from safetensors import SafetensorError
from safetensors.torch import load_file, save_file
from torch import Tensor, nn

from torchrl_nerd.files import read_json, writable_folder, write_atomically, write_json

WEIGHTS, CARD = "policy.safetensors", "policy.json"


def mlp(sizes: Sequence[int]) -> nn.Sequential:
    """Linear layers with tanh between; orthogonal weights, zero biases."""
    layers: list[nn.Module] = []
    for width, next_width in zip(sizes[:-1], sizes[1:], strict=True):
        linear = nn.Linear(width, next_width)
        nn.init.orthogonal_(linear.weight, 2.0**0.5)
        nn.init.zeros_(linear.bias)
        layers += [linear, nn.Tanh()]
    return nn.Sequential(*layers[:-1])


class Standardize(nn.Module):
    """(x - mean) / std with constants, ``(*batch, size)``."""

    def __init__(self, size: int) -> None:
        super().__init__()
        self.register_buffer("mean", torch.zeros(size))
        self.register_buffer("std", torch.ones(size))

    def fit(self, samples: Tensor) -> None:
        """Take mean and std from samples ``(*batch, size)``."""
        samples = samples.flatten(0, -2).double()
        self.mean.copy_(samples.mean(0))
        self.std.copy_(samples.std(0).clamp_min(1e-3))

    def forward(self, x: Tensor) -> Tensor:
        return (x - self.mean) / self.std


class Policy(nn.Module):
    def __init__(self, observation_size, num_actions, widths=(64, 64)):
        super().__init__()
        self.normalize = Standardize(observation_size)
        self.mean = mlp((observation_size, *widths, num_actions))
        nn.init.orthogonal_(self.mean[-1].weight, 0.01)
        self.log_std = nn.Parameter(torch.zeros(num_actions))

    def forward(self, observation):
        loc = self.mean(self.normalize(observation))
        return loc, self.log_std.exp().expand_as(loc)
