"""What a compiler's wait looks like from outside."""

import time

import torch

from torchrl_nerd import compiled
from torchrl_nerd.compiled import Compiled


def test_a_long_compilation_is_announced_once_and_a_short_one_is_not(
    capfd, monkeypatch
):
    monkeypatch.setattr(compiled, "PATIENCE", 0.2)

    def slow_backend(graph, inputs):
        time.sleep(1.0)
        return graph.forward

    for backend, expected in ((slow_backend, 1), ("eager", 0)):
        double = Compiled(lambda x: 2.0 * x, warmup=0, backend=backend)
        torch.compile(torch.sin, backend="eager")(torch.zeros(1))  # torch's own start
        for _ in range(3):
            assert double(torch.ones(2)).tolist() == [2.0, 2.0]
        said = capfd.readouterr().err
        assert said.count("compiling a step") == expected
