"""TorchRL pipelines of `examples/` with tiny budgets: each has to show what it claims."""

import copy
import importlib
import os
import signal
from dataclasses import replace
from pathlib import Path
from types import ModuleType

import pytest
import torch
from dynamics_helpers import unequal_keys
from tensordict import TensorDict
from torch import nn
from torch.optim.lr_scheduler import LinearLR
from torchrl.envs.utils import check_env_specs

from torchrl_nerd import NeRDEnv, from_pretrained, load_scene, make_env
from torchrl_nerd.evaluation.policy import load_policy, make_actor
from torchrl_nerd.evaluation.policy_transfer import summarize
from torchrl_nerd.transforms import Stats

EXAMPLES = Path(__file__).parents[1] / "examples"
ROUNDING = 1e-7  # m/s and rad/s, of a model's float32 in batches of another size
slow = pytest.mark.slow


@pytest.fixture
def example(monkeypatch, seed):
    """Imports an example by its name."""
    monkeypatch.syspath_prepend(str(EXAMPLES))
    return importlib.import_module


@pytest.mark.parametrize("fraction", [0.0, 0.25, 1.0])
def test_sac_learns_from_the_asked_fraction_of_mujoco(example, fraction):
    sac: ModuleType = example("sac")
    cfg = sac.Config(
        mujoco_fraction=fraction,
        frames=128,
        num_envs=8,
        horizon=4,
        updates=1,
        batch_size=16,
    )
    agent, buffer = sac.train(cfg)
    stored = buffer[torch.arange(len(buffer))]
    assert len(buffer) == cfg.frames
    assert int(stored["is_mujoco"].sum()) == fraction * cfg.frames
    for name in ("mujoco", "nerd"):
        own = stored[stored["is_mujoco"] == (name == "mujoco")]
        assert not len(own) or step_error(name, own) < ROUNDING
    assert all(weight.isfinite().all() for weight in agent.loss.parameters())


def step_error(dynamics: str, rows: TensorDict) -> float:
    """How far from what they say these first steps of episodes lead in ``dynamics``.

    Of first steps alone, since learned dynamics may stack_frames what came before.
    """
    env = make_env("cartpole/swingup", dynamics, len(rows))
    env.reset(rows.select("qpos", "qvel"), set_state=True)
    after = env.step(rows.select("action"))["next"]
    return float((after["qvel"] - rows["next", "qvel"]).abs().min())


def test_sac_lowers_its_critics_error(example):
    sac = example("sac")
    env = make_env("cartpole/swingup", "nerd", 64)
    agent = sac.Agent(env)
    with torch.no_grad():
        batch = env.rollout(4, agent.actor, break_when_any_done=False).reshape(-1)

    def error() -> float:
        scaled = batch.clone()
        scaled["next", "reward"] *= 1 - agent.gamma
        with torch.no_grad():
            return float(agent.loss(scaled)["loss_qvalue"])

    before = error()
    for _ in range(100):
        agent.update(batch.clone())
    assert error() < 0.5 * before


def test_dyna_branches_start_at_replayed_states(example):
    dyna = example("dyna")
    cfg = dyna.Config(frames=32, num_envs=4, horizon=4, branch=2, starts=8, updates=1)
    agent, exact, learned = dyna.train(cfg)
    assert (len(exact), len(learned)) == (32, 2 * 8 * 2)
    exact, learned = (b[torch.arange(len(b))] for b in (exact, learned))
    assert exact["is_mujoco"].all() and not learned["is_mujoco"].any()
    starts = learned.reshape(-1, cfg.branch)[:, 0]
    is_replayed = (starts["qpos"][:, None] == exact["qpos"]).all(-1).any(-1)
    assert is_replayed.all()
    assert step_error("nerd", starts) < ROUNDING < step_error("mujoco", starts)

    env = make_env(cfg.task, "mujoco", len(starts))
    path = dyna.branches(env, agent, starts, steps=2)
    kept = path.clone()
    dyna.branches(env, agent, starts, steps=2)
    assert not unequal_keys(path, kept)  # a later branch writes into no earlier one


def test_planning_in_learned_dynamics_beats_no_action(example):
    plan = example("plan")
    cfg = plan.Config(
        num_envs=2, actions=8, horizon=10, candidates=32, best=4, rounds=2
    )
    planned = plan.play(plan.make_planner(cfg), cfg)
    idle = plan.play(plan.idle, cfg)
    assert planned.shape == idle.shape == (2, 8)
    assert planned.sum() > idle.sum()


def test_transforms_say_the_same_in_a_foreign_env_and_in_a_buffer(example):
    transforms = example("transforms")
    cfg = transforms.Config(frames=24)
    scene = load_scene(f"dm_control/{cfg.name}")
    env = transforms.make_suite_env(cfg, scene)
    check_env_specs(env)
    data = env.rollout(cfg.frames, break_when_any_done=False)
    features = transforms.Compose(*transforms.make_features(scene))
    buffer = transforms.make_buffer(data, features, cfg)
    assert torch.equal(data["position"], data["qpos"][:, 1:])
    seen = buffer[torch.arange(len(buffer))]
    for key in ("robot_state", "contact_distance", "contact_velocity"):
        assert torch.equal(seen[key], data[key])
        assert Stats.of(seen[key]).std.max() > 0.0
    assert torch.equal(seen["state_delta"], data["next", "state_delta"])

    mujoco = make_env(f"dm_control/{cfg.name}", "dm_control", cfg.frames)
    mujoco.reset(data.select("qpos", "qvel"), set_state=True)
    after = mujoco.step(TensorDict(action=data["action"].float()).auto_batch_size_(1))
    torch.testing.assert_close(
        after["next", "joint_torque"],
        data["next", "joint_torque"],
        rtol=1e-5,
        atol=1e-5,
    )


@slow
def test_a_model_learned_through_the_transforms_predicts_the_change(example):
    transforms = example("transforms")
    errors = transforms.main(transforms.Config(frames=200, updates=50, batch_size=64))
    assert set(errors) == {"robot", "robot and contacts"}
    assert all(error < 0.9 for error in errors.values())


@slow  # of processes; tests/envs has a ParallelEnv of both
@pytest.mark.parametrize("way", ["processes", "parallel_envs"])
def test_collectors_mix_both_dynamics(example, way):
    collect = example("collect")
    cfg = collect.Config(num_envs=3, horizon=4, batches=2)
    alone = {}
    for name in ("nerd", "mujoco"):
        collector = collect.one_process(cfg, [name])
        alone[name] = next(iter(collect.batches(collector)))
    collector = getattr(collect, way)(cfg, ("nerd", "mujoco"))
    first, second = collect.batches(collector)
    kept = first.clone()
    assert first.shape == (2, cfg.num_envs, cfg.horizon)
    assert torch.equal(first["next", "qpos"][:, :, -1], second["qpos"][:, :, 0])
    assert not unequal_keys(first, kept)
    for part in alone.values():
        for key in part.exclude("collector").keys(True, True):
            assert first[key].shape[1:] == part[key].shape, key
            assert first[key].dtype == part[key].dtype, key
    for index, name in enumerate(("nerd", "mujoco")):
        assert step_error(name, first[index, :, 0]) < ROUNDING
        assert step_error(name, first[1 - index, :, 0]) > ROUNDING


@slow
@pytest.mark.parametrize("moment", ["collecting", "learning"])
def test_ppo_outlives_a_worker_of_ray(example, moment, monkeypatch, capsys):
    """Killed while it collects, or while the policy learns; the next batch is whole."""
    ray = pytest.importorskip("ray")
    paths = [str(EXAMPLES), *os.environ.get("PYTHONPATH", "").split(os.pathsep)]
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join(paths))  # workers import it, too
    monkeypatch.setenv("RAY_worker_niceness", "0")
    ppo_ray, made = example("ppo_ray"), []

    def die(batch: TensorDict) -> None:
        os.kill(os.getpid(), signal.SIGKILL)

    make_collector = ppo_ray.make_collector

    def noted(*args):
        made.append(make_collector(*args))
        return made[-1]

    monkeypatch.setattr(ppo_ray, "make_collector", noted)
    cfg = ppo_ray.Run(dynamics="mujoco", num_envs=6, horizon=4, total_frames=72)
    env = make_env(cfg.task, cfg.dynamics, cfg.num_envs)
    policy, _ = example("ppo").make_policy_and_critic(env, cfg)
    batches = []
    for batch in ppo_ray.collect(cfg, env, make_actor(policy)):
        batches.append(batch)
        if len(batches) == 1:
            with torch.no_grad():  # all that is collected from now on goes one way
                policy.mlp[-1].bias.fill_(8.0)
            victim = made[0].remote_collectors[1]
            if moment == "learning":
                pid = ray.get(victim.__ray_call__.remote(lambda self: os.getpid()))
                os.kill(pid, signal.SIGKILL)
            else:
                ray.get(victim.set_post_collect_hook.remote(die))
    assert [batch.shape for batch in batches] == [(6, 4)] * 3
    assert len(made) == 2 and "a worker was lost" in capsys.readouterr().out
    assert (batches[0]["action"] < 0).any()
    assert all((batch["action"] > 0.9).all() for batch in batches[1:])
    starts = [batch["qpos"][:, 0] for batch in batches[:2]]
    assert not torch.equal(*starts)


def test_workers_of_ray_have_no_gpu(example):
    """Said before any of them starts."""
    pytest.importorskip("ray")
    ppo_ray = example("ppo_ray")
    batches = ppo_ray.collect(ppo_ray.Run(device="cuda"), None, None)
    with pytest.raises(ValueError, match="expected device cpu"):
        next(batches)


@pytest.mark.slow
def test_gradients_through_learned_dynamics_help_in_true_ones(example, tmp_path):
    first_order = example("first_order")
    cfg = first_order.Config(
        num_envs=16,
        window=8,
        episode=8,
        updates=12,
        lr=1e-2,
        evaluate_every=12,
        episodes=8,
        out=tmp_path,
    )

    def early(cfg, policy):  # so few updates help the first steps of an episode alone
        env = NeRDEnv(cfg.task, num_envs=64, seed=cfg.seed + 1)
        with torch.no_grad():
            reward, *_ = first_order.window_reward(env, policy, env.reset(), None, 24)
        return summarize(reward.expand(2), reward.expand(2))

    policy, rewards = first_order.train(cfg, early)
    assert len(rewards) == cfg.updates
    idle = copy.deepcopy(policy)
    nn.init.zeros_(idle.mlp[-1].weight)
    nn.init.zeros_(idle.mlp[-1].bias)
    env = make_env(cfg.task, "mujoco", 64)
    start, earned = env.reset(), []
    for each in (policy, idle):
        now = env.reset(start.select(*env.state.keys()), set_state=True)
        with torch.no_grad():
            reward, *_ = first_order.window_reward(env, each, now, None, 24)
        earned.append(float(reward))
    assert earned[0] > earned[1] + 0.01
    first_order.main(replace(cfg, start=tmp_path, updates=1, lr=0.0))
    kept = load_policy(tmp_path).state_dict()
    assert all(torch.equal(kept[k], x) for k, x in policy.state_dict().items())
    assert (tmp_path / "returns.json").is_file()


@slow
def test_a_step_that_makes_it_worse_is_taken_back(example, tmp_path):
    """However large the step, nothing is lost: the start is what is left then."""
    first_order = example("first_order")
    cfg = first_order.Config(
        num_envs=4, window=2, episode=4, updates=4, lr=1e3, evaluate_every=1, episodes=8
    )
    policy = first_order.make_policy(cfg, make_env(cfg.task, "nerd", 4))
    with torch.no_grad():  # an arm that stays put earns more than one that flails
        policy.mlp[-1].weight.zero_()
    start = tmp_path / "start"
    first_order.keep(replace(cfg, out=start), policy)
    cfg = replace(cfg, start=start, out=tmp_path / "out")
    learned, rewards = first_order.train(cfg)
    assert len(rewards) == cfg.updates
    earned, before = (first_order.measure(cfg, p).mean for p in (learned, policy))
    assert earned >= before
    optimizer = torch.optim.Adam(learned.mlp.parameters(), 1e-2)
    schedule = LinearLR(optimizer, 1.0, 0.5, total_iters=10)
    for _ in range(3):
        optimizer.step()
        schedule.step()
    rate = optimizer.param_groups[0]["lr"]
    first_order.step_back(learned, policy, optimizer)
    schedule.step()
    assert optimizer.param_groups[0]["lr"] < 0.5 * rate  # and it goes on falling
    for name, weight in learned.state_dict().items():
        assert torch.equal(weight, policy.state_dict()[name])


def test_windows_go_on_where_the_last_one_ended(example, generator):
    """The sum of a rollout in windows is that of the whole."""
    first_order = example("first_order")
    cfg = first_order.Config(num_envs=4)
    model = from_pretrained("franka").requires_grad_(False)
    env = NeRDEnv(cfg.task, model, 4, differentiable=True)
    policy = first_order.make_policy(cfg, env)
    start = env.reset()
    whole, *_ = first_order.window_reward(env, policy, start, None, 6)
    now, recent, parts = env.reset(start, set_state=True), None, []
    for _ in range(2):
        part, recent, _ = first_order.window_reward(env, policy, now, recent, 3)
        parts.append(part)
        ended = torch.zeros(4, dtype=torch.bool)
        now, recent = first_order.go_on(env, recent, policy.frame_stack, ended)
    torch.testing.assert_close(sum(parts) / 2, whole)
    gradients = torch.autograd.grad(whole, list(policy.mlp.parameters()))
    assert all(gradient.any() for gradient in gradients)


def test_an_episode_that_is_over_earns_nothing_and_begins_anew(example):
    """Two Ants on the ground, and two as they start."""
    first_order = example("first_order")
    model = from_pretrained("ant-mlp").requires_grad_(False)
    env = NeRDEnv("ant/run", model, 4, 0, differentiable=True)
    policy = first_order.make_policy(first_order.Config("ant/run", num_envs=4), env)
    state = env.reset().clone()
    state["qpos"][:2, 2] = 0.25
    paid = []
    for fell in (state, state[[2, 3, 2, 3]]):  # two lie there, and none does
        start = env.reset(fell, set_state=True)
        reward, *_ = first_order.window_reward(env, policy, start, None, 3)
        paid.append(float(reward.detach()))
    assert paid[0] < paid[1]
    start = env.reset(state, set_state=True)
    *_, ended = first_order.window_reward(env, policy, start, None, 1)
    assert ended.tolist() == [True, True, False, False]
    start = env.reset(state, set_state=True)
    _, recent, ended = first_order.window_reward(env, policy, start, None, 2)
    assert ended.tolist() == [True, True, False, False]
    standing = env.state["qpos"][2:].clone()
    now, _ = first_order.go_on(env, recent, policy.frame_stack, ended)
    torch.testing.assert_close(now["qpos"][2:], standing)
    fresh = env.task.initial_state(torch.rand(64, env.task.num_uniforms).double())
    low, high = fresh["qpos"][:, 2].aminmax()
    assert (
        (now["qpos"][:2, 2] >= low - 0.1) & (now["qpos"][:2, 2] <= high + 0.1)
    ).all()
    assert not now["qvel"][:2].abs().max() > fresh["qvel"].abs().max() + 0.1


def test_rows_whose_episode_ended_begin_anew_and_the_others_go_on(example, seed):
    first_order = example("first_order")
    model = from_pretrained("franka").requires_grad_(False)
    env = NeRDEnv("franka/reach", model, 6, seed, differentiable=True)
    policy = first_order.make_policy(first_order.Config(num_envs=6), env)
    _, recent, _ = first_order.window_reward(env, policy, env.reset(), None, 4)
    before, ended = env.state, torch.arange(6) % 2 == 0
    now, seen = first_order.go_on(env, recent, policy.frame_stack, ended)
    assert not any(x.requires_grad for x in now.values(True, True))
    assert torch.equal(now["qpos"][~ended], before["qpos"][~ended])
    assert torch.equal(now["goal"][~ended], before["goal"][~ended])
    assert torch.equal(seen[~ended], recent[~ended])
    assert not now["qvel"][ended].any()  # at rest, as episodes of this task begin
    assert (now["goal"] != before["goal"])[ended].all()
    first = now["observation"].tile(policy.frame_stack)
    assert torch.equal(seen[ended], first[ended])


def test_no_row_points_the_batch_its_way(example, generator):
    """Rows sensitive to the initial state are shortened, others left alone to the bit."""
    bound_gradients = example("first_order").bound_gradients
    gradient = torch.randn(65, 7, dtype=torch.float64, generator=generator)
    gradient /= gradient.norm(dim=-1, keepdim=True)
    gradient *= torch.linspace(0.5, 1.5, 65, dtype=torch.float64)[:, None]
    assert torch.equal(bound_gradients(gradient), gradient)
    wild = gradient.clone()
    wild[:4] *= torch.tensor([1e3, 1e30, 1e150, 20.0], dtype=torch.float64)[:, None]
    wild[4, 2], wild[5, 1] = torch.nan, torch.inf
    found = bound_gradients(wild)
    assert found.isfinite().all() and torch.equal(found[6:], wild[6:])
    median = wild.nan_to_num(0.0, 0.0, 0.0).norm(dim=-1).median()
    assert (found.norm(dim=-1) < 4.0 * median * (1 + 1e-9)).all()
    along = (found[:4] * gradient[:4]).sum(-1)  # their direction stays
    torch.testing.assert_close(
        along, found[:4].norm(dim=-1) * gradient[:4].norm(dim=-1)
    )
