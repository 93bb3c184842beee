"""Gradients through rollouts of an env, window after window."""

import copy

import pytest
import torch
from dynamics_helpers import random_model

from torchrl_nerd.envs import NeRDEnv, make_env
from torchrl_nerd.envs.base import SceneEnv
from torchrl_nerd.robots import make_task

TASK = "cartpole/swingup"
ROWS, STEPS = 3, 4


@pytest.fixture
def env(generator) -> SceneEnv:
    task = make_task("cartpole/swingup")
    model = random_model(task.scene, generator).requires_grad_(False)
    return NeRDEnv(task, model, ROWS, differentiable=True)


def window(env: SceneEnv, gain: torch.Tensor, start) -> torch.Tensor:
    """Mean reward of a policy that is bounded, with a slope everywhere."""
    path = env.rollout(
        STEPS,
        lambda td: td.set("action", (td["observation"] @ gain).sin()),
        auto_reset=False,
        tensordict=start,
        break_when_any_done=False,
    )
    return path["next", "reward"].mean()


@pytest.mark.parametrize("goes_on", [True, False])
def test_windows_follow_on_each_other(env, goes_on, generator):
    """A reset of all envs leaves no graph behind, wherever it starts."""
    gain = torch.randn(4, 1, generator=generator).requires_grad_()
    start = env.reset()
    for _ in range(3):
        (gradient,) = torch.autograd.grad(window(env, gain, start), gain)
        assert gradient.isfinite().all() and gradient.any()
        where = env.state.detach()
        start = env.reset(where, set_state=True) if goes_on else env.reset()
        assert not any(value.requires_grad for value in start.values())
        assert torch.equal(start["qpos"], where["qpos"]) == goes_on


def test_gradient_of_other_rows_outlives_a_partial_reset(env, generator):
    gain = torch.randn(4, 1, generator=generator).requires_grad_()
    window(env, gain, env.reset())
    rows = torch.tensor([[True], [False], [False]])
    after = env.reset(env.state.set("_reset", rows))
    (gradient,) = torch.autograd.grad(after["qpos"][1].sum(), gain, retain_graph=True)
    assert gradient.any()
    (gradient,) = torch.autograd.grad(after["qpos"][0].sum(), gain)
    assert not gradient.any()


def test_a_partial_reset_in_inference_mode_goes_on(env, generator):
    gain = torch.randn(4, 1, generator=generator).requires_grad_()
    reward = window(env, gain, env.reset())
    with torch.inference_mode():
        rows = torch.tensor([[True], [False], [False]])
        start = env.reset(env.state.set("_reset", rows))
    assert torch.equal(start["qpos"], env.state["qpos"])
    for total in (reward, window(env, gain, start.clone())):
        (gradient,) = torch.autograd.grad(total, gain, retain_graph=True)
        assert gradient.isfinite().all() and gradient.any()


@pytest.mark.parametrize("dynamics", ["mujoco", "dm_control"])
def test_mujoco_dynamics_have_no_gradients(dynamics):
    with pytest.raises(ValueError, match=f"for gradients, got '{dynamics}'"):
        make_env("cartpole/swingup", dynamics, differentiable=True)


@pytest.mark.slow  # test_compile.py rolls the same pair out in a collector
def test_a_compiled_env_steps_as_an_eager_one(seed):
    generator = torch.Generator().manual_seed(seed)
    actions = 2.0 * torch.rand(STEPS, ROWS, 1, generator=generator) - 1.0
    envs = [
        make_env("cartpole/swingup", "nerd", ROWS, seed=1, compile=is_compiled)
        for is_compiled in (False, True)
    ]
    ends = []
    for env in envs:
        td = env.reset()
        for action in actions:
            td = env.step(td.set("action", action))["next"]
        ends.append(td["qpos"])
    torch.testing.assert_close(ends[0], ends[1], atol=1e-5, rtol=1e-5)


def test_a_loaded_state_has_no_past(env, generator):
    """And the graph of the past stays whole."""
    gain = torch.randn(4, 1, generator=generator).requires_grad_()
    reward = window(env, gain, env.reset())
    other = make_env(TASK, num_envs=ROWS)
    other.reset()
    env.load_state_dict(copy.deepcopy(other.state_dict()))
    after = env.step(env.rand_action())["next"]
    assert not after["qpos"].requires_grad
    (gradient,) = torch.autograd.grad(reward, gain)
    assert gradient.any()


@pytest.mark.parametrize("network", ["transformer-2x64", "gru", "mlp-2x32"])
@pytest.mark.parametrize("inference", ["streaming", "window"])
def test_no_grad_records_nothing_and_breaks_nothing(network, inference, generator):
    """Weights ask for gradients, and the history is part of an earlier graph."""
    model = random_model(make_task(TASK).scene, generator, network)
    env = NeRDEnv(TASK, model, ROWS, inference=inference, differentiable=True)
    weights = [*model.network.parameters()]
    slopes = []
    for is_followed in (False, True):
        env.set_seed(0)
        now = env.reset()
        for _ in range(2):
            now = env.step(now.set("action", 0.1 * torch.ones(ROWS, 1)))["next"]
            now = now.exclude("reward")
        total = now["qpos"].sum()
        if is_followed:
            with torch.no_grad():
                env.rollout(3, auto_reset=False, tensordict=now.detach())
            for value in vars(env.dynamics._memory).values():
                tensors = value if isinstance(value, list) else [value]
                assert not any(x.requires_grad for x in tensors)
        slopes.append(torch.autograd.grad(total, weights, allow_unused=True))
    for slope, expected in zip(*slopes, strict=True):
        assert (slope is None) == (expected is None)
        assert slope is None or torch.equal(slope, expected)


@pytest.mark.parametrize("dynamics", ["analytic", "nerd"])
@pytest.mark.parametrize(
    ("key", "column", "value"), [("qpos", 2, -20.0), ("qvel", 0, 1e20)]
)
def test_an_env_at_fault_leaves_the_gradients_of_others(dynamics, key, column, value):
    how = {"differentiable": True, "seed": 0, "state_dtype": torch.float32}
    gradients = []
    for is_broken in (False, True):
        env = make_env("ant/run", dynamics, ROWS, **how)
        start = env.reset()
        if is_broken:
            start[key][1, column] = value
            start = env.reset(start, set_state=True)
        gain = torch.ones((), requires_grad=True)
        for _ in range(2):
            action = gain * torch.full((ROWS, 8), 0.5)
            start = env.step(start.set("action", action))["next"].exclude("reward")
        assert not start["fault"][[0, 2]].any()
        found = start["qpos"][[0, 2]].sum()
        gradients += torch.autograd.grad(found, gain)
    assert gradients[0].isfinite() and gradients[0] != 0.0
    torch.testing.assert_close(gradients[1], gradients[0])


def test_gradients_of_a_compiled_env_are_those_of_an_eager_one(generator):
    """A later step or reset leaves what an earlier one recorded."""
    gradients = []
    for is_compiled in (False, True):
        env = make_env(TASK, "nerd", ROWS, seed=0, differentiable=True)
        if is_compiled:
            env.compile(backend="aot_eager")
        now, gain = env.reset(), torch.ones((), requires_grad=True)
        for step in range(5):
            if step == 3:
                rows = torch.tensor([[True], [False], [False]])
                now = env.reset(now.set("_reset", rows))
            action = gain * torch.full((ROWS, 1), 0.3)
            now = env.step(now.set("action", action))["next"].exclude("reward")
        gradients += torch.autograd.grad(now["qpos"].sum(), gain)
    assert gradients[0] != 0.0
    torch.testing.assert_close(gradients[1], gradients[0])
