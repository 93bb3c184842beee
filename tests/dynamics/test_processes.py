"""Ground truth in forked processes, on threads, and on the processors it may use."""

import multiprocessing
import os
import signal
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor

import pytest
import torch
from dynamics_helpers import unequal_keys
from tensordict import TensorDict
from torch.utils.data import DataLoader, Dataset

from torchrl_nerd import load_scene, make_env
from torchrl_nerd.dynamics import MujocoDynamics
from torchrl_nerd.dynamics.mujoco import default_threads
from torchrl_nerd.tasks.suite import SuiteTask

PATIENCE = 120.0  # s until a child counts as hanging
needs_fork = pytest.mark.skipif(not hasattr(os, "fork"), reason="no fork on Windows")


def some_steps(env) -> TensorDict:
    """A few steps from a reset, with the actions of the env's own stream of numbers."""
    action = torch.linspace(-1.0, 1.0, env.action_spec.shape.numel())
    action = action.reshape(env.action_spec.shape)
    td = env.reset()
    for _ in range(3):
        td = env.step(td.set("action", action))["next"].exclude("reward")
    return td.select("qpos", "qvel", "observation")


def in_child(function, *args):
    """What a function gives in a forked child; fails where the child hangs."""
    fork = multiprocessing.get_context("fork")
    mine, its = fork.Pipe()
    child = fork.Process(target=lambda: its.send(function(*args)), daemon=True)
    child.start()
    try:
        assert mine.poll(PATIENCE), "the child hangs"
        return mine.recv()
    finally:
        child.kill()
        child.join()


@needs_fork
@pytest.mark.parametrize(
    ("task", "dynamics", "how"),
    [
        ("ant/run", "mujoco", {}),
        ("double_pendulum/passive", "dm_control", {}),
        ("cartpole/swingup", "nerd", {"guard": "fallback"}),
        ("dm_control/pendulum-swingup", "mujoco", {}),
    ],
)
def test_a_forked_child_goes_on_as_its_parent(task, dynamics, how):
    env = make_env(task, dynamics, num_envs=4, seed=0, **how)
    some_steps(env)  # threads are there before the fork
    child = in_child(lambda: some_steps(env).numpy())
    expected = some_steps(env)
    assert not unequal_keys(TensorDict(child, [4]), expected)


@needs_fork
@pytest.mark.slow
def test_a_child_that_never_steps_ends_by_itself():
    script = (
        "import os, sys; from torchrl_nerd import make_env; "
        "env = make_env('ant/run', 'mujoco', num_envs=2, seed=0); env.rollout(2); "
        "child = os.fork(); "
        "sys.exit(0) if not child else sys.exit(os.waitpid(child, 0)[1])"
    )
    done = subprocess.run([sys.executable, "-c", script], timeout=PATIENCE)
    assert done.returncode == 0


@needs_fork
def test_a_forked_child_steps_a_model_of_many_threads():
    """Which torch has by default; the tests' own process may have one."""
    script = (
        "import os, sys, torch; from torchrl_nerd import make_env; "
        "env = make_env('cartpole/swingup', 'nerd', 4, seed=0); env.rollout(2); "
        "child = os.fork(); child or (env.rollout(2), os._exit(0)); "
        "sys.exit(os.waitpid(child, 0)[1])"
    )
    command, threads = [sys.executable, "-c", script], {"OMP_NUM_THREADS": "2"}
    with subprocess.Popen(
        command, env={**os.environ, **threads}, start_new_session=True
    ) as parent:
        try:
            assert parent.wait(PATIENCE) == 0
        finally:
            if parent.poll() is None:
                os.killpg(parent.pid, signal.SIGKILL)


class Steps(Dataset):
    """States of an env that was made and stepped in the parent."""

    def __init__(self) -> None:
        self.dynamics = MujocoDynamics(load_scene("cartpole"), num_threads=2)
        self.state = TensorDict(
            {"qpos": torch.rand(4, 2).double(), "qvel": torch.rand(4, 2).double()}, [4]
        )
        self.expected = self[0]

    def __len__(self) -> int:
        return 4

    def __getitem__(self, index: int) -> torch.Tensor:
        self.dynamics.reset(self.state)
        return self.dynamics.step(self.state, torch.ones(4, 1).double())["qpos"]


@needs_fork
def test_workers_of_a_data_loader_step_mujoco():
    steps = Steps()
    loader = DataLoader(
        steps, num_workers=2, multiprocessing_context="fork", timeout=PATIENCE
    )
    for batch in loader:
        assert torch.equal(batch[0], steps.expected)


def test_threads_share_a_suite_task():
    task = SuiteTask("dm_control/hopper-hop")
    envs = [make_env(task, "mujoco", num_envs=3, seed=i) for i in range(3)]
    expected = [some_steps(env) for env in envs]
    with ThreadPoolExecutor(len(envs)) as threads:
        for _ in range(3):
            for i, env in enumerate(envs):
                env.set_seed(i)
            for got, td in zip(threads.map(some_steps, envs), expected, strict=True):
                assert not unequal_keys(got, td)


@pytest.mark.skipif(not hasattr(os, "sched_setaffinity"), reason="Linux alone has it")
def test_threads_are_as_many_as_processors_are_allowed(monkeypatch):
    monkeypatch.delenv("NERD_THREADS", raising=False)
    allowed = os.sched_getaffinity(0)
    assert default_threads() == len(allowed)
    os.sched_setaffinity(0, {min(allowed)})
    try:
        assert MujocoDynamics(load_scene("cartpole")).num_threads == 1
    finally:
        os.sched_setaffinity(0, allowed)


@pytest.mark.slow
def test_no_warning_becomes_an_error():
    """Imports of others are excepted; what this package does afterwards is not."""
    script = (
        "import warnings; import torchrl.envs, dm_control.suite, mujoco; "
        "from torchrl_nerd import make_env; warnings.simplefilter('error')\n"
        "for dynamics in ('nerd', 'analytic', 'mujoco', 'dm_control'):\n"
        "    env = make_env('ant/run', dynamics, num_envs=2, seed=0)\n"
        "    env.rollout(3, break_when_any_done=False); env.close()"
    )
    done = subprocess.run(
        [sys.executable, "-c", script], capture_output=True, text=True
    )
    assert done.returncode == 0, done.stderr
