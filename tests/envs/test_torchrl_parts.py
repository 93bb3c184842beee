"""The envs under TorchRL's own collectors, wrappers, buffers and losses."""

import functools

import pytest
import torch
from dynamics_helpers import EnvMaker, each_dynamics, unequal_keys
from tensordict import TensorDict
from tensordict.nn import NormalParamExtractor, TensorDictModule
from torch import nn
from torchrl.collectors import Collector, MultiCollector
from torchrl.data import LazyTensorStorage, ReplayBuffer
from torchrl.envs import (
    Compose,
    InitTracker,
    ParallelEnv,
    RewardSum,
    SerialEnv,
    StepCounter,
    TransformedEnv,
)
from torchrl.envs.utils import check_env_specs
from torchrl.modules import ProbabilisticActor, TanhNormal, ValueOperator
from torchrl.objectives import ClipPPOLoss
from torchrl.objectives.value import GAE

from torchrl_nerd.transforms import ContactFeatures, RobotCentric

ROWS, HORIZON = 3, 4
TASK = "cartpole/swingup"
each_pair = pytest.mark.parametrize("dynamics", ["streaming", "mujoco"])


def make_actor(env) -> ProbabilisticActor:
    size, actions = env.observation_spec["observation"].shape[-1], env.action_spec
    net = nn.Sequential(nn.Linear(size, 2 * actions.shape[-1]), NormalParamExtractor())
    return ProbabilisticActor(
        TensorDictModule(net, ["observation"], ["loc", "scale"]),
        in_keys=["loc", "scale"],
        spec=env.full_action_spec,
        distribution_class=TanhNormal,
        return_log_prob=True,
    )


def check_batch(data: TensorDict) -> None:
    """Rows go on where they were, or are reset where they were done."""
    done = data["next", "done"][:, :-1, 0]
    for key in ("qpos", "qvel", "observation"):
        ended, following = data["next", key][:, :-1], data[key][:, 1:]
        assert torch.equal(ended[~done], following[~done]), key
        assert (ended[done] != following[done]).any(-1).all(), key
    assert done.any() and not done.all()
    assert data["next", "reward"].isfinite().all()


@each_dynamics
def test_collector_and_ppo(task_id, dynamics, generator):
    env = EnvMaker(task_id, dynamics, generator, HORIZON)(ROWS)
    actor = make_actor(env)
    collector = Collector(env, actor, frames_per_batch=30, total_frames=60)
    batches = list(collector)
    collector.shutdown()
    assert [batch.shape for batch in batches] == [(ROWS, 10)] * 2
    for batch in batches:
        check_batch(batch)
    assert not batches[0].is_shared()

    size = env.observation_spec["observation"].shape[-1]
    critic = ValueOperator(nn.Linear(size, 1), in_keys=["observation"])
    GAE(gamma=0.99, lmbda=0.95, value_network=critic)(batches[0])
    losses = ClipPPOLoss(actor, critic)(batches[0].reshape(-1))
    sum(losses[key] for key in ("loss_objective", "loss_critic")).backward()
    for weight in (*actor.parameters(), *critic.parameters()):
        assert weight.grad is not None and weight.grad.isfinite().all()


@each_pair
def test_episode_transforms(task_id, dynamics, generator):
    base = EnvMaker(task_id, dynamics, generator, HORIZON)(ROWS)
    env = TransformedEnv(base, Compose(StepCounter(), RewardSum(), InitTracker()))
    check_env_specs(env)
    data = env.rollout(2 * HORIZON, break_when_any_done=False)
    ends = data["next", "step_count"] == HORIZON
    assert torch.equal(data["next", "truncated"], ends) and ends.any()
    starts = data["is_init"]
    assert torch.equal(starts[:, 1:], data["next", "done"][:, :-1])
    rewards, total = data["next", "reward"], torch.zeros(ROWS, 1)
    for step in range(data.shape[1]):
        total = torch.where(starts[:, step], 0.0, total) + rewards[:, step]
        torch.testing.assert_close(data["next", "episode_reward"][:, step], total)


@each_pair
@pytest.mark.parametrize("features", [RobotCentric, ContactFeatures])
def test_features_beside_the_state(task_id, dynamics, features, generator):
    base = EnvMaker(task_id, dynamics, generator, HORIZON)(ROWS)
    transform = features(base.scene)
    env = TransformedEnv(base, transform)
    check_env_specs(env)
    data = env.rollout(2 * HORIZON, break_when_any_done=False)
    keys = set(transform.out_keys) & set(data.keys())
    alone = features(base.scene)(data.select(*transform.in_keys).clone())
    following = features(base.scene)(data["next"].select(*transform.in_keys).clone())
    for key in keys:
        assert torch.equal(data[key], alone[key])
        assert torch.equal(data["next", key], following[key])
    assert keys or not transform.out_keys


@each_pair
def test_replay_buffer_returns_what_was_stored(task_id, dynamics, generator):
    env = EnvMaker(task_id, dynamics, generator, HORIZON)(ROWS)
    data = env.rollout(10, break_when_any_done=False).reshape(-1)
    buffer = ReplayBuffer(storage=LazyTensorStorage(len(data)), batch_size=16)
    kept = data.clone()
    buffer.extend(data)
    env.rollout(10, break_when_any_done=False)
    stored = buffer[torch.arange(len(kept))]
    assert not unequal_keys(stored.exclude("index"), kept)
    assert buffer.sample()["next", "qpos"].dtype == torch.float64


@each_pair
def test_serial_env_is_its_envs_side_by_side(task_id, dynamics, generator):
    make = EnvMaker(task_id, dynamics, generator, HORIZON)
    serial = SerialEnv(2, [functools.partial(make, ROWS, s) for s in (1, 2)])
    check_env_specs(serial)
    serial = SerialEnv(2, [functools.partial(make, ROWS, s) for s in (1, 2)])
    policy = idle_policy(serial)
    together = serial.rollout(10, policy, break_when_any_done=False)
    assert together.shape == (2, ROWS, 10)
    for index, seed in enumerate((1, 2)):
        alone = make(ROWS, seed).rollout(10, policy, break_when_any_done=False)
        assert torch.equal(together["next", "qpos"][index], alone["next", "qpos"])
        assert torch.equal(together["next", "done"][index], alone["next", "done"])


def idle_policy(env):
    """No action at all: the same wherever an env runs."""
    width = env.action_spec.shape[-1]
    return lambda td: td.set("action", torch.zeros(*td.batch_size, width))


@pytest.mark.slow
def test_parallel_env_may_mix_learned_and_mujoco_dynamics(generator):
    makers = [EnvMaker(TASK, d, generator, HORIZON) for d in ("window", "mujoco")]
    parallel = ParallelEnv(2, [functools.partial(make, ROWS) for make in makers])
    try:
        parallel.set_seed(7)
        data = parallel.rollout(10, idle_policy(parallel), break_when_any_done=False)
    finally:
        parallel.close(raise_if_closed=False)
    assert data.shape == (2, ROWS, 10)
    for index in range(2):
        check_batch(data[index])
    assert (data["qpos"][0, :, 0] != data["qpos"][1, :, 0]).any(-1).all()
    ground_truth = makers[1](ROWS)
    start = data[1, :, 0].select("qpos", "qvel", "terrain", strict=False)
    ground_truth.reset(start.clone(), set_state=True)
    action = torch.zeros(ground_truth.action_spec.shape)
    after = ground_truth.step(TensorDict({"action": action}, [ROWS]))["next"]
    assert torch.equal(after["qpos"], data["next", "qpos"][1, :, 0])


@pytest.mark.slow
def test_multi_collector(generator):
    makers = [EnvMaker(TASK, d, generator, HORIZON) for d in ("streaming", "mujoco")]
    actor = make_actor(makers[1](ROWS))
    collector = MultiCollector(
        [functools.partial(make, ROWS) for make in makers],
        actor,
        sync=True,
        frames_per_batch=60,
        total_frames=120,
    )
    try:
        for batch in collector:
            assert batch.shape == (2, ROWS, 10)
            check_batch(batch[0])
            check_batch(batch[1])
    finally:
        collector.shutdown()
