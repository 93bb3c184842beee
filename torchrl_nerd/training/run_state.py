"""State of a training run as tensors by name: weights, their averages, optimizers."""

from collections.abc import Mapping
from pathlib import Path

import torch
from torch import Tensor, nn
from torch.optim import Optimizer

from torchrl_nerd.tensor_files import expect_fit, read_tensors, write_tensors

STATE = "state.safetensors"


class RunState:
    """The tensors of a run, saved to one file and restored in place.

    Args:
        network: that is trained.
        average: of its weights, by name.
        optimizers: by name, their states allocated.
    """

    def __init__(
        self,
        network: nn.Module,
        average: Mapping[str, Tensor],
        optimizers: Mapping[str, Optimizer],
    ) -> None:
        self.network, self.average, self.optimizers = network, average, optimizers

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
