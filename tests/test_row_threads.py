"""Rows worked on in parts are the rows worked on at once."""

import os
import threading
from concurrent.futures import ThreadPoolExecutor
from dataclasses import fields
from itertools import count

import pytest
import torch
from dynamics_helpers import HAS_COMPILER, random_actions, random_drive, roll
from torch import Tensor

from torchrl_nerd import NeRDEnv, from_pretrained
from torchrl_nerd.compiled import WARM, RowThreads, parts_of
from torchrl_nerd.dynamics import NeRDDynamics, models
from torchrl_nerd.modules.history import WindowNetwork
from torchrl_nerd.modules.networks import GRUConfig, MLPConfig
from torchrl_nerd.modules.transformer import TransformerConfig

TASK, ROWS, STEPS = "double_pendulum/passive", 6, 4
CLOSE = {"atol": 1e-5, "rtol": 1e-5}


@pytest.fixture(autouse=True)
def two_threads():
    before = torch.get_num_threads()
    torch.set_num_threads(2)
    yield
    torch.set_num_threads(before)


@pytest.mark.parametrize("parts", [1, 2, 3])
def test_parts_are_the_whole(parts, generator):
    def double(x: Tensor, y: Tensor | None, number: int) -> tuple:
        return 2.0 * x, y, number

    x = torch.rand(6, 2, generator=generator)
    for other in (None, torch.rand(6, generator=generator)):
        found = RowThreads(double)(parts, x, other, 5)
        assert torch.equal(found[0], 2.0 * x) and found[2] == 5
        assert found[1] is other if other is None else torch.equal(found[1], other)


def test_as_many_parts_as_pay():
    assert [parts_of(rows, 4) for rows in (1, 7, 8, 9, 100)] == [1, 1, 2, 1, 2]
    torch.set_num_threads(4)
    assert [parts_of(rows, 4) for rows in (12, 15, 16, 100, 101)] == [3, 3, 4, 4, 1]


def test_each_part_has_a_thread_and_each_thread_is_alone():
    """Both parts are at work at the same time, in threads with one of torch's each."""
    gate, seen, calls = threading.Barrier(2, timeout=60), [], count(1)

    def meet(x: Tensor) -> tuple[Tensor]:
        if next(calls) > 2 * WARM:
            gate.wait()
        seen.append((threading.get_ident(), torch.get_num_threads()))
        assert not torch.is_grad_enabled()
        return (x,)

    each = RowThreads(meet)
    for _ in range(WARM + 2):
        seen.clear()
        each(2, torch.zeros(2))
    assert len({ident for ident, _ in seen}) == 2
    assert threading.get_ident() not in dict(seen)
    assert [number for _, number in seen] == [1, 1]
    assert torch.get_num_threads() == 2  # here, and where a thread begins later
    with ThreadPoolExecutor(1) as other:
        assert other.submit(torch.get_num_threads).result() == 2


def test_it_raises_what_a_part_raises():
    def refuse(x: Tensor) -> tuple[Tensor]:
        if x[0] > 0:
            raise ValueError("expected none of those")
        return (x,)

    with pytest.raises(ValueError, match="none of those"):
        RowThreads(refuse)(2, torch.arange(2))


@pytest.mark.skipif(not hasattr(os, "fork"), reason="no fork here")
@pytest.mark.filterwarnings("ignore:.*fork.*:DeprecationWarning")
def test_a_forked_process_has_threads_of_its_own():
    each = RowThreads(lambda x: (-x,))
    each(2, torch.arange(4))
    child = os.fork()
    if not child:
        is_right = torch.equal(each(2, torch.arange(4))[0], -torch.arange(4))
        os._exit(0 if is_right else 1)
    assert os.waitpid(child, 0)[1] == 0


@pytest.mark.slow
@pytest.mark.parametrize(
    "name", ["double_pendulum-hybrid", "double_pendulum-mlp", "double_pendulum"]
)
def test_a_compiled_step_in_parts_is_the_eager_one(name, generator, monkeypatch):
    monkeypatch.setattr(models, "MIN_WORK", 2)
    model = from_pretrained(name)
    drive = random_drive(model.scene, ROWS, STEPS, generator)
    dynamics = NeRDDynamics(model, compile=True)
    assert dynamics.parts(ROWS) == 2
    found, expected = roll(dynamics, *drive), roll(NeRDDynamics(model), *drive)
    torch.testing.assert_close(found, expected, **CLOSE)
    assert dynamics._compiled.is_eager != HAS_COMPILER

    eager, env = (NeRDEnv(TASK, model, ROWS, seed=3) for _ in range(2))
    env.compile()
    assert env._transition.is_round
    actions = random_actions(eager, STEPS, generator)
    for action in actions:
        ends = [each.step(each.reset().set("action", action)) for each in (eager, env)]
        torch.testing.assert_close(*ends, **CLOSE)
    assert not env.eager().dynamics.compile


def test_learned_models_step_in_parts():
    """Where there are enough envs, and threads."""
    for name in ("ant-mlp", "ant"):
        torch.set_num_threads(2)
        dynamics = NeRDDynamics(from_pretrained(name))
        assert dynamics.is_single_threaded
        assert dynamics.parts(512) == 2 and dynamics.parts(64) == 1
        torch.set_num_threads(1)
        assert dynamics.parts(512) == 1


def test_what_is_kept_of_the_past_is_work():
    """Of two networks of one robot, that with a band of 64 and that with one of 10."""
    torch.set_num_threads(2)
    names = "cartpole-adaptive", "cartpole"
    parts = [NeRDDynamics(from_pretrained(name)).parts(512) for name in names]
    assert parts == [2, 1]


def test_what_must_stay_whole_does(generator, monkeypatch):
    """Gradients, and one thread."""
    monkeypatch.setattr(models, "MIN_WORK", 2)
    model = from_pretrained("double_pendulum-hybrid")
    assert NeRDDynamics(model, differentiable=True).parts(ROWS) == 1
    torch.set_num_threads(1)
    assert NeRDDynamics(model).parts(ROWS) == 1


NETWORKS = {
    "mlp": MLPConfig(1, 16),
    "gru": GRUConfig(1, 16),
    "transformer": TransformerConfig(2, 16, 2, band=4),
    "pairs": TransformerConfig(2, 16, 2, band=4, pairs=True),
}


@torch.no_grad()
@pytest.mark.parametrize("is_window", [False, True])
@pytest.mark.parametrize("name", NETWORKS)
def test_a_history_in_parts_is_the_whole_history(name, is_window, generator):
    """Through resets of some envs, and beyond the end of the ring."""
    network = NETWORKS[name].build(5, 3)
    network = WindowNetwork(network, 3, 5) if is_window else network
    whole, cut = (network.empty_memory(ROWS) for _ in range(2))
    for step in range(7):
        token = torch.randn(ROWS, 5, generator=generator)
        expected = network.step(token, whole)
        parts = RowThreads(lambda x, memory: (network.step(x, memory),))
        (found,) = parts(2, token, cut)
        torch.testing.assert_close(found, expected, **CLOSE)
        if step % 3 == 1:
            is_reset = torch.rand(ROWS, generator=generator) < 0.5
            whole.clear(is_reset)
            cut.clear(is_reset)
    for field in fields(whole):
        same = (getattr(x, field.name) for x in (whole, cut))
        torch.testing.assert_close(*same, **CLOSE)
