"""A function of tensors as a CUDA graph: its kernels start without a host in between."""

from collections.abc import Callable, Mapping
from typing import TypeVar

import torch
from torch import Tensor

Output = TypeVar("Output")
WARMUP = 3  # calls before a capture, in which libraries make their own memory
Graph = tuple[torch.cuda.CUDAGraph, list[Tensor | None], Tensor]


def capture(
    function: Callable[[], Output], device: torch.device
) -> tuple[torch.cuda.CUDAGraph, Output]:
    """A CUDA graph of a function, and the memory that its replays write the result to.

    The function runs a few times first, and what it writes to is written to.

    Raises:
        RuntimeError: the function makes the host wait.
    """
    graph, stream = torch.cuda.CUDAGraph(), torch.cuda.Stream(device)
    stream.wait_stream(torch.cuda.current_stream(device))
    with torch.cuda.stream(stream):
        for _ in range(WARMUP):
            function()
    torch.cuda.current_stream(device).wait_stream(stream)
    with torch.cuda.device(device), torch.cuda.graph(graph):
        output = function()
    return graph, output


class Captured:
    """Replays a function of tensors or None; captured anew for each of their shapes.

    The function returns one tensor and asks the device for nothing. ``state`` is all that
    it writes to: the calls before a capture leave no trace there.
    """

    def __init__(
        self, function: Callable[..., Tensor], state: Callable[[], Mapping[str, Tensor]]
    ) -> None:
        self.function, self.state = function, state
        self._graphs: dict[tuple, Graph] = {}

    def __call__(self, *given: Tensor | None) -> Tensor:
        """What the function returns; a copy, as the next replay overwrites it.

        Raises:
            RuntimeError: the function makes the host wait.
        """
        key = tuple(None if x is None else tuple(x.shape) for x in given)
        if key not in self._graphs:
            self._graphs[key] = self._capture(given)
        graph, inputs, output = self._graphs[key]
        for held, new in zip(inputs, given, strict=True):
            if held is not None and new is not None:
                held.copy_(new)
        graph.replay()
        return output.clone()

    def _capture(self, given: tuple[Tensor | None, ...]) -> Graph:
        inputs = [None if x is None else x.clone() for x in given]
        before = [(x, x.clone()) for x in self.state().values()]
        device = next(x.device for x in inputs if x is not None)
        graph, output = capture(lambda: self.function(*inputs), device)
        for tensor, value in before:
            tensor.copy_(value)
        return graph, inputs, output
