"""Weights, their averages and what optimisers stack_frames, as tensors by name."""

from torch import Tensor, nn, tensor
from torch.optim import Optimizer

REMEMBERED = {"muon": ("momentum",), "adamw": ("exp_avg", "exp_avg_sq")}
"""What an optimiser remembers of a weight, of the weight's shape."""

Average = dict[str, Tensor]
Optimizers = dict[str, Optimizer]


def pack(
    network: nn.Module, average: Average, optimizers: Optimizers
) -> dict[str, Tensor]:
    """All of it, for one file.

    Args:
        network: what is trained.
        average: of its weights, by their names.
        optimizers: by names of `REMEMBERED`.
    """
    tensors = _weights(network, average)
    for name, optimizer in optimizers.items():
        for index, state in optimizer.state_dict()["state"].items():
            tensors |= {f"{name}.{index}.{k}": v for k, v in state.items()}
    return tensors


def like_packed(
    found: dict[str, Tensor],
    network: nn.Module,
    average: Average,
    optimizers: Optimizers,
) -> dict[str, Tensor]:
    """Tensors like those that `pack` gives once weights of these names were updated.

    Args:
        found: names tell which weights an optimiser has seen.
        network: what is trained, as in `pack`.
        average: of its weights.
        optimizers: its own.
    """
    expected = _weights(network, average)
    for name, optimizer in optimizers.items():
        groups = optimizer.param_groups
        parameters = [weight for group in groups for weight in group["params"]]
        seen = {key.split(".")[0] for key in _with_prefix(found, f"{name}.")}
        for index, weight in enumerate(parameters):
            if str(index) in seen:
                kinds = REMEMBERED[name]
                expected |= {f"{name}.{index}.{kind}": weight for kind in kinds}
                if name == "adamw":
                    expected[f"{name}.{index}.step"] = tensor(0.0)
    return expected


def unpack(
    tensors: dict[str, Tensor],
    network: nn.Module,
    average: Average,
    optimizers: Optimizers,
) -> None:
    """Put back what `pack` gave; other names are passed over."""
    network.load_state_dict(_with_prefix(tensors, "model."))
    for name, value in _with_prefix(tensors, "average.").items():
        average[name].copy_(value)
    for name, optimizer in optimizers.items():
        state: dict[int, dict[str, Tensor]] = {}
        for key, value in _with_prefix(tensors, f"{name}.").items():
            index, entry = key.split(".", 1)
            state.setdefault(int(index), {})[entry] = value
        groups = optimizer.state_dict()["param_groups"]
        optimizer.load_state_dict({"state": state, "param_groups": groups})


def _weights(network: nn.Module, average: Average) -> dict[str, Tensor]:
    tensors = {f"model.{k}": v for k, v in network.state_dict().items()}
    return tensors | {f"average.{k}": v for k, v in average.items()}


def _with_prefix(tensors: dict[str, Tensor], prefix: str) -> dict[str, Tensor]:
    return {
        k.removeprefix(prefix): v for k, v in tensors.items() if k.startswith(prefix)
    }
