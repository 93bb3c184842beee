"""The view of an env that TorchRL's planners take."""

import pytest
import torch
from dynamics_helpers import EnvMaker

from torchrl_nerd import make_env
from torchrl_nerd.envs import StatelessEnv

STATES, CANDIDATES, STEPS = 2, 3, 4
each_pair = pytest.mark.parametrize("dynamics", ["streaming", "mujoco"])


@each_pair
def test_any_batch_is_stepped_from_its_own_state(task_id, dynamics, generator):
    """As rows of an env that was set to these states; history goes on on the way."""
    make = EnvMaker(task_id, dynamics, generator)
    env = StatelessEnv(make(STATES * CANDIDATES))
    start = make(STATES, seed=5).reset().unsqueeze(-1).expand(STATES, CANDIDATES)
    start = start.to_tensordict()
    shape = (STEPS, STATES, CANDIDATES, *env.action_spec.shape)
    actions = 2.0 * torch.rand(shape, generator=generator) - 1.0

    def roll(one, batch, td):
        moves = iter(actions)
        policy = lambda td: td.set("action", next(moves).reshape(*batch, shape[-1]))  # noqa: E731
        return one.rollout(
            STEPS, policy, auto_reset=False, tensordict=td, break_when_any_done=False
        )

    batch = (STATES, CANDIDATES)
    path = roll(env, batch, start.clone())
    assert path.shape == (*batch, STEPS)
    again = roll(env, batch, start.clone())  # whatever the env did in between
    rows = make(STATES * CANDIDATES)
    flat = rows.reset(start.reshape(-1), set_state=True)
    expected = roll(rows, (STATES * CANDIDATES,), flat)
    for key in ("qpos", "qvel", "reward", "observation"):
        alone = expected["next", key].reshape(path["next", key].shape)
        assert torch.equal(path["next", key], alone)
        assert torch.equal(path["next", key], again["next", key])


def test_specs_are_those_of_one_row(generator):
    one = EnvMaker("cartpole/swingup", "mujoco", generator)(1)
    env = StatelessEnv(one)
    assert env.action_spec.shape == one.action_spec.shape[1:]
    assert set(env.observation_spec.keys()) == set(one.observation_spec.keys())
    assert not env.batch_locked and env.batch_size == torch.Size([])


def test_a_reset_takes_what_the_env_has_just_given(generator):
    env = StatelessEnv(EnvMaker("cartpole/swingup", "mujoco", generator)(4))
    first = env.reset()
    before = first["qpos"].clone()
    again = env.reset(first)  # begins new episodes, as in ``env``
    assert not torch.equal(again["qpos"], before)
    before = again["qpos"].clone()
    mask = torch.tensor([True, False, True, False])[:, None]
    after = env.reset(again.set("_reset", mask))["qpos"]
    assert torch.equal(after[1::2], before[1::2])
    assert not (after[::2] == before[::2]).any()


def test_gradients_reach_the_state_that_the_env_already_has():
    """As they reach another."""
    found = []
    for far in (0.0, 1e-9):
        plain = make_env("cartpole/swingup", "nerd", 2, seed=0, differentiable=True)
        env = StatelessEnv(plain)
        start = env.reset()
        qpos = (start["qpos"] + far).requires_grad_()
        given = start.set("qpos", qpos).set("action", torch.zeros(2, 1))
        moved = env.step(given)["next", "qpos"].sum()
        found += torch.autograd.grad(moved, qpos)
    assert found[0].abs().min() > 0.5
    torch.testing.assert_close(*found, rtol=1e-5, atol=1e-5)
