"""What a compiler's wait looks like from outside."""

import threading
import time

import pytest
import torch

from torchrl_nerd import compiled
from torchrl_nerd.compiled import Compiled


def slow_backend(graph, inputs):
    time.sleep(1.0)
    return graph.forward


@pytest.mark.parametrize(
    ("backend", "patience", "expected"),
    [
        pytest.param(slow_backend, 0.2, 1, id="longer than our patience"),
        pytest.param("eager", 120.0, 0, id="shorter"),
    ],
)
def test_a_long_compilation_is_announced_once_and_a_short_one_is_not(
    backend, patience, expected, capfd, monkeypatch
):
    monkeypatch.setattr(compiled, "PATIENCE", patience)
    before = set(threading.enumerate())
    double = Compiled(lambda x: 2.0 * x, warmup=0, backend=backend)
    for _ in range(3):
        assert double(torch.ones(2)).tolist() == [2.0, 2.0]
    for thread in set(threading.enumerate()) - before:
        if isinstance(
            thread, threading.Timer
        ):  # nothing is left that would speak later
            thread.join(10.0)
            assert not thread.is_alive()
    assert capfd.readouterr().err.count("compiling a step") == expected
