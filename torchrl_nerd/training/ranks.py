"""Data-parallel training: every rank computes its share of each batch.

All ranks draw the same batch, each takes every n-th sample of it, and gradients are
averaged, so the result is that of one process up to rounding. Statistics of the data are
computed in shares, too, and merged exactly. Without `torchrun` there is one rank.
"""

import os
from collections.abc import Iterable

import torch
from torch import Tensor, distributed

from torchrl_nerd.transforms import Stats


def join(device: torch.device) -> None:
    """Connect the processes that `torchrun` started; does nothing without it."""
    if int(os.environ.get("WORLD_SIZE", "1")) > 1 and not distributed.is_initialized():
        backend = "nccl" if device.type == "cuda" else "gloo"
        if backend == "nccl":
            torch.cuda.set_device(int(os.environ.get("LOCAL_RANK", "0")))
        distributed.init_process_group(backend)


def leave() -> None:
    """Wait for all ranks, then disconnect."""
    wait()
    if distributed.is_initialized():
        distributed.destroy_process_group()


def rank() -> int:
    """Number of this process, from 0; rank 0 writes files."""
    return distributed.get_rank() if distributed.is_initialized() else 0


def world() -> int:
    """Number of processes."""
    return distributed.get_world_size() if distributed.is_initialized() else 1


def wait() -> None:
    """Wait until all ranks call this."""
    if distributed.is_initialized():
        distributed.barrier()


def share(x: Tensor) -> Tensor:
    """This rank's samples of a batch ``(n, ...)``."""
    return x[rank() :: world()]


def expect_shares(**sizes: int) -> None:
    """Raise a ValueError for batch sizes that the ranks cannot share equally."""
    for name, count in sizes.items():
        if count % world():
            raise ValueError(
                f"expected {name} to be a multiple of the {world()} ranks, got {count}"
            )


@torch.no_grad()
def average_gradients(parameters: Iterable[Tensor], loss: Tensor) -> Tensor:
    """Replace every gradient by its mean over the ranks; returns the mean loss ``()``."""
    if world() == 1:
        return loss.detach()
    gradients = [p.grad for p in parameters if p.grad is not None]
    flat = torch.cat([x.flatten() for x in (loss.detach(), *gradients)])
    distributed.all_reduce(flat)  # all in one message
    flat /= world()
    mean, *parts = flat.split([1, *(gradient.numel() for gradient in gradients)])
    for gradient, part in zip(gradients, parts, strict=True):
        gradient.copy_(part.view_as(gradient))
    return mean.squeeze(0)


def merge_stats(mine: Stats) -> Stats:
    """Statistics of all ranks' samples together, the same bits on every rank."""
    if world() == 1:
        return mine
    count = torch.tensor([mine.count], dtype=torch.float64)
    device = "cuda" if distributed.get_backend() == "nccl" else "cpu"
    packed = torch.cat((count, mine.mean.cpu(), mine.m2.cpu())).to(device)  # (1 + 2 D,)
    found = [torch.empty_like(packed) for _ in range(world())]
    distributed.all_gather(found, packed)
    parts = (Stats(int(x[0]), *x[1:].cpu().chunk(2)) for x in found if x[0] > 0)
    return Stats.merge_all(parts)
