"""A function of tensors as a CUDA graph: its kernels start without a host in between."""

from collections.abc import Callable, Mapping

import torch
from torch import Tensor

WARMUP = 3  # calls before a capture, in which libraries make their own memory
Key = tuple[tuple[int, ...] | None, ...]
Graph = tuple[torch.cuda.CUDAGraph, list[Tensor | None], Tensor]


class Captured:
    """Replays a function; captured anew for each shape of its arguments.

    Args:
        function: of tensors or None; returns one tensor and asks the device for nothing.
        state: all that it writes to; the calls before a capture leave no trace there.
    """

    def __init__(
        self, function: Callable[..., Tensor], state: Callable[[], Mapping[str, Tensor]]
    ) -> None:
        self.function, self.state = function, state
        self._graphs: dict[Key, Graph] = {}

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
        stream = torch.cuda.Stream()
        stream.wait_stream(torch.cuda.current_stream())
        with torch.cuda.stream(stream):
            for _ in range(WARMUP):
                self.function(*inputs)
        torch.cuda.current_stream().wait_stream(stream)
        for tensor, value in before:
            tensor.copy_(value)
        graph = torch.cuda.CUDAGraph()
        with torch.cuda.graph(graph):
            output = self.function(*inputs)
        return graph, inputs, output
