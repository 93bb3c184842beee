"""Features that never vary, or whose offset is a hundred million times their spread."""

import torch
from torch import Generator

from torchrl_nerd.evaluation.stability.case import Case, Figures
from torchrl_nerd.evaluation.stability.measures import largest
from torchrl_nerd.evaluation.stability.world import World
from torchrl_nerd.transforms import Normalize, Stats

SAMPLES, PARTS = 4096, 8
OFFSETS = (0.0, 1.0, 1e8)
OFF, CONSTANT = "normalised features off", "a constant, normalised"
BACK = "back again, share of the spread"


def _run(world: World, generator: Generator, scale: float) -> Figures:
    noise = torch.randn(SAMPLES, len(OFFSETS), generator=generator, dtype=torch.float64)
    exact = (noise - noise.mean(0)) / noise.std(0, correction=0)
    still = torch.full((SAMPLES, 1), 1e8, dtype=torch.float64)
    x = torch.cat((noise + torch.tensor(OFFSETS), still), 1)
    first, *rest = (Stats.of(part) for part in x.chunk(PARTS))
    for part in rest:
        first = first.merge(part)
    normalize = Normalize({"x": first})
    y = normalize.normalize("x", x)
    back = (normalize.denormalize("x", y) - x)[:, :-1]
    return {
        OFF: largest((y[:, :-1] - exact).abs()),
        CONSTANT: largest(y[:, -1].abs()),
        BACK: largest(back.abs()),
    }


CASE = Case(
    "statistics",
    "a float64 near 1e8 has eight digits left for what varies; a constant stays at zero",
    _run,
    true_lines={OFF: 1e-6, CONSTANT: 0.0, BACK: 1e-6},
    lines={OFF: 1e-6, CONSTANT: 0.0, BACK: 1e-6},
)
