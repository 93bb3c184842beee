"""Ways to draw training data: what each promises, on every robot, and MuJoCo."""

import json
import math
from dataclasses import replace
from functools import partial
from pathlib import Path

import pytest
import torch
from helpers import slow_but
from sampling_study import TaskResets, strategies
from tensordict import TensorDict
from torch import Generator

from torchrl_nerd.checkpoint import make_card
from torchrl_nerd.cli import main
from torchrl_nerd.configs import NO_PREDICTIONS, DataConfig
from torchrl_nerd.data.generate import (
    CARD,
    generate,
    is_sound,
    load_data,
    simulate,
)
from torchrl_nerd.data.simulate import SEGMENT
from torchrl_nerd.data.strategies import (
    PerturbedRestStates,
    SettledStates,
    mix,
    preset_strategy,
    resample,
    strategy,
)
from torchrl_nerd.dynamics import MujocoDynamics
from torchrl_nerd.envs import GroundTruthEnv
from torchrl_nerd.envs.frame_stack import append_frame
from torchrl_nerd.files import read_json
from torchrl_nerd.geometry.manifold import differentiate_pos
from torchrl_nerd.modules.nerd import NeRD
from torchrl_nerd.modules.networks import NETWORKS
from torchrl_nerd.robots import PRESETS, SCENES, load_scene, make_task
from torchrl_nerd.scenes.sampling import (
    sample_commands,
    sample_correlated_commands,
    sample_scale,
)
from torchrl_nerd.seeds import fold_in
from torchrl_nerd.tasks import Task
from torchrl_nerd.training.policy_data import policy_data

STATE = ("qpos", "qvel")
BY_TORQUES = [s for s in map(load_scene, SCENES) if s.sampling.drive is None]
each_by_torques = pytest.mark.parametrize("scene", BY_TORQUES, ids=lambda s: s.name)
"""Scenes whose data are drawn by random torques, not by random actions."""


class Linear:
    """A policy: squashed sums of what it sees."""

    def __init__(self, task: Task, seed: int, frame_stack: int = 1) -> None:
        generator = Generator().manual_seed(seed)
        size = (frame_stack * task.observation_size, task.controller.num_actions)
        self.frame_stack = frame_stack
        self.weight = 0.3 * torch.randn(size, generator=generator)

    def __call__(self, td: TensorDict) -> TensorDict:
        return td.set("action", torch.tanh(td["observation"] @ self.weight))


def task_of(scene) -> Task:
    return make_task(PRESETS[scene.name].task)


def seeded(seed: int) -> Generator:
    return Generator().manual_seed(seed)


def assert_equal(data: TensorDict, expected: TensorDict) -> None:
    assert data.batch_size == expected.batch_size
    assert set(data.keys(True, True)) == set(expected.keys(True, True))
    for key in expected.keys(True, True):
        assert torch.equal(data[key], expected[key]), key


@each_by_torques
def test_the_default_draws_are_those_of_shipped_models(scene, seed):
    """Independent uniform torques, segment by segment, after the starts."""
    rows, steps = 5, 2 * SEGMENT + 3
    data, generator = simulate(scene, rows, steps, seeded(seed)), seeded(seed)
    start, scale = scene.sample_initial(rows, generator)
    counts = (SEGMENT, SEGMENT, 3)
    parts = [sample_commands(scene.sampling, scale, n, generator) for n in counts]
    assert torch.equal(data["next", "joint_torque"], torch.cat(parts, 1))
    for key, value in start.items():
        assert torch.equal(data[key][:, 0], value)


@pytest.mark.parametrize("name", slow_but(("cartpole", "anymal"), SCENES))
def test_every_strategy_gives_sound_data_of_the_same_layout(name, seed):
    scene = load_scene(name)
    task, expected = task_of(scene), simulate(scene, 7, 5, seeded(seed))
    found = strategies(scene, task, Linear(task, seed))
    assert set(found) >= {"uniform", "shares", "scales", "starts", "policy", "mixed"}
    assert ("correlated" in found) == (scene.sampling.drive is None)
    assert set(strategies(scene, task)) == set(found) - {"policy"}
    for name, draw in found.items():
        data = draw(7, 5, seeded(seed))
        assert is_sound(data).all(), name
        assert {k: (data[k].shape, data[k].dtype) for k in data.keys(True, True)} == {
            k: (expected[k].shape, expected[k].dtype) for k in expected.keys(True, True)
        }
        for key in STATE:
            assert torch.equal(data["next", key][:, :-1], data[key][:, 1:])
        assert_equal(draw(7, 5, seeded(seed)), data)
        other = draw(7, 5, seeded(seed + 1))
        assert not torch.equal(other["qpos"], data["qpos"]), name
        one = draw(1, 1, seeded(seed))
        assert one.batch_size == (1, 1)


def test_presets_name_strategies_that_fit_their_scenes():
    chosen = {name: preset_strategy(load_scene(name)) for name in PRESETS}
    names = {name: pair[0] for name, pair in chosen.items() if pair}
    assert names["franka_gravity"] == "correlated" and names["cube"] == "resting"
    assert names["double_pendulum"] == "level" and "cartpole" not in names
    for name in ("level", "unknown"):
        with pytest.raises(ValueError, match=f"for 'cartpole', got {name}"):
            strategy(load_scene("cartpole"), name)


@pytest.mark.parametrize(
    "scene", [s for s in BY_TORQUES if s.actuated], ids=lambda s: s.name
)
def test_torques_keep_as_long_as_asked_and_stay_uniform(scene, generator):
    """The process before its distribution function has correlation exp(-t / tau)."""
    dt, rows, steps = scene.control_step, 1500, 60
    tau = dt * float(torch.empty(()).uniform_(2.0, 12.0, generator=generator))
    sampling = replace(scene.sampling, correlation_time=(tau, tau))
    one = torch.ones(rows, 1, dtype=torch.float64)
    torque = sample_correlated_commands(sampling, one, steps, dt, generator)
    share = (torque / torch.tensor(sampling.torque))[..., 0]
    assert share.abs().max() <= 1.0
    for time in (0, steps - 1):  # stationary: uniform at the start as at the end
        ordered = share[:, time].sort().values
        uniform = torch.linspace(-1.0, 1.0, rows, dtype=torch.float64)
        assert (ordered - uniform).abs().max() < 0.15
    for lag in (1, 3, 8, 20):
        rho = 6.0 / math.pi * math.asin(0.5 * math.exp(-lag * dt / tau))
        found = 3.0 * (share[:, lag:] * share[:, :-lag]).mean()
        assert abs(found - rho) < 0.08


def test_each_trajectory_has_a_correlation_time_of_its_own(generator):
    scene = load_scene("cartpole")
    sampling = replace(scene.sampling, correlation_time=(1e-3, 1e3))
    one = torch.ones(2000, 1, dtype=torch.float64)
    torque = sample_correlated_commands(
        sampling, one, 40, scene.control_step, generator
    )[..., 0]
    turns = (torque.diff(dim=1).abs() / sampling.torque[0]).mean(1)
    assert 0.2 < (turns < 0.05).double().mean() < 0.6  # kept
    assert 0.1 < (turns > 0.5).double().mean() < 0.4  # drawn anew at every step


def test_scales_are_as_likely_in_each_octave(generator):
    shares = {
        "zero_torque_fraction": 0.2,
        "low_torque_fraction": 0.0,
        "min_torque_scale": 1e-3,
    }
    sampling = replace(load_scene("cartpole").sampling, **shares)
    scale, speed = (x[:, 0] for x in sample_scale(sampling, 5000, generator))
    assert abs((scale == 0.0).double().mean() - 0.2) < 0.03
    assert (speed[scale > 0.0] == 1.0).all()
    octaves = scale[scale > 0.0].log().sort().values / math.log(1e-3)
    expected = torch.linspace(1.0, 0.0, len(octaves), dtype=torch.float64)
    assert (octaves - expected).abs().max() < 0.05


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"min_torque_scale": 0.0}, "min_torque_scale above 0 and up to 1, got 0.0"),
        ({"min_torque_scale": 2.0}, "min_torque_scale above 0 and up to 1, got 2.0"),
        (
            {"correlation_time": (0.0, 1.0)},
            r"above 0 s, the lower first, got \(0.0, 1.0\)",
        ),
        ({"correlation_time": (2.0, 1.0)}, "the lower first"),
        ({"correlation_time": (1.0, 2.0), "drive": torch.add}, "a drive, got both"),
    ],
)
def test_impossible_sampling_is_refused(change, words):
    with pytest.raises(ValueError, match=words):
        resample(load_scene("cartpole"), **change)


def test_standing_starts_are_the_tasks_over_the_scenes_ground(scene, seed):
    task = task_of(scene)
    standing = resample(scene, starts=TaskResets(task))
    start, _ = standing.sample_initial(40, seeded(seed))
    size = (40, task.num_uniforms)
    u = torch.rand(size, dtype=torch.float64, generator=seeded(seed))
    for key in STATE:
        assert torch.equal(start[key], task.initial_state(u)[key])
    if "terrain" in start:  # never the task's, on which models are tested
        assert len(start["terrain"].unique(dim=0)) == 40


def test_fallen_starts_end_passive_trajectories(scene, seed):
    seconds, rows = 0.25, 6
    end = SettledStates(scene, seconds)(rows, seeded(seed))
    state, _ = scene.sample_initial(rows, seeded(seed))
    terrain = state.pop("terrain", None)
    steps = round(seconds / scene.control_step)
    idle = torch.zeros(rows, steps, len(scene.actuated), dtype=torch.float64)
    dynamics = MujocoDynamics(scene)
    path = dynamics.rollout(TensorDict(state, [rows]), idle, terrain)
    for key in STATE:
        torch.testing.assert_close(end[key], path[key][:, -1], rtol=1e-6, atol=1e-6)
    if terrain is not None:
        assert torch.equal(end["terrain"], terrain)


def test_the_ant_has_fallen_and_lies_still(generator):
    scene = load_scene("ant")
    start, _ = scene.sample_initial(24, generator)
    end = SettledStates(scene)(24, generator)
    assert (end["qpos"][:, 2] < start["qpos"][:, 2].min()).all()
    fast, slow = (x["qvel"].norm(dim=-1).median() for x in (start, end))
    assert slow < 0.1 * fast  # the median: one may still be rolling


@pytest.mark.parametrize("frame_stack", [1, 3])
def test_policy_data_is_what_the_env_does(task_id, frame_stack, seed):
    task, rows, steps = make_task(task_id), 4, 6
    actor = Linear(task, seed, frame_stack)
    data = policy_data(task, actor, rows, steps, seeded(seed), 0.0)
    size = (rows, task.num_uniforms)
    u = torch.rand(size, dtype=torch.float64, generator=seeded(seed))
    env = GroundTruthEnv(task, num_envs=rows)
    td = env.reset(TensorDict(task.initial_state(u), [rows]), set_state=True)
    every, recent = task.frame_skip, None
    for step in range(every - 1, steps, every):
        recent = append_frame(recent, td["observation"], frame_stack)
        td = env.step(actor(td.set("observation", recent)))["next"]
        for key in (*STATE, "joint_torque"):
            assert torch.equal(data["next", key][:, step], td[key])


def test_exploring_policies_stray_by_their_noise(seed):
    task = make_task("cartpole/swingup")
    actor, gain = Linear(task, seed), task.scene.sampling.torque[0]
    data = policy_data(task, actor, 300, 40, seeded(seed), noise=0.2)
    seen = task.observation(data).float()
    mean = actor(TensorDict({"observation": seen}, data.batch_size))["action"]
    stray = (data["next", "joint_torque"] / gain - mean)[..., 0]
    inside = mean[..., 0].abs() < 0.3  # where nothing is clipped
    spread = (stray[inside]).square().mean().sqrt()
    assert abs(spread - 0.2 / 3.0**0.5) < 0.02  # U(0, 0.2) has this root mean square
    again = MujocoDynamics(task.scene).rollout(
        data[:, 0].select(*STATE), data["next", "joint_torque"]
    )
    for key in STATE:
        torch.testing.assert_close(again[key], data["next", key], rtol=0, atol=1e-9)


def test_a_mixture_has_equal_shares_in_order(generator):
    scene = load_scene("cartpole")
    seen = []

    def part(rows: int, steps: int, generator: Generator) -> TensorDict:
        seen.append(rows)
        return simulate(scene, rows, steps, generator)

    for rows, counts in ((10, [3, 3, 4]), (2, [1, 1]), (1, [1])):
        seen.clear()
        assert mix(part, part, part)(rows, 2, generator).batch_size == (rows, 2)
        assert seen == counts


def test_a_folder_holds_one_strategy(tmp_path, seed):
    scene, config = load_scene("cartpole"), DataConfig(9, 4, seed)
    calm = partial(simulate, resample(scene, zero_torque_fraction=1.0))
    generate(scene, config, tmp_path, quiet=True, strategy=("calm", calm))
    data = load_data(scene, tmp_path)
    assert_equal(TensorDict(dict(data.items()), [9, 4]), calm(9, 4, fold_in(seed, 0)))
    for other in (None, ("wild", partial(simulate, scene))):
        with pytest.raises(ValueError, match=f"{tmp_path} already holds.*strategy"):
            generate(scene, config, tmp_path, quiet=True, strategy=other)
    generate(scene, config, tmp_path, quiet=True, strategy=("calm", calm))


def test_the_command_draws_by_a_named_strategy(tmp_path, monkeypatch, seed):
    scene, size = load_scene("cartpole"), ("--trajectories", "9", "--steps", "4")
    monkeypatch.chdir(tmp_path)
    asked = ("--strategy", "resting", "--seed", str(seed), "--quiet")
    assert main(["data", "cartpole", *asked, *size]) == 0
    folder = Path("datasets/cartpole-resting")
    assert read_json(folder / CARD)["strategy"] == "resting"
    drawn = strategy(scene, "resting")(9, 4, fold_in(seed, 0))
    data = load_data(scene, folder)
    assert_equal(TensorDict(dict(data.items()), [9, 4]), drawn)


def test_cards_say_what_is_set(scene, tmp_path, seed):
    config, ranges = DataConfig(3, 2, seed), scene.sampling.ranges()
    generate(scene, config, tmp_path, quiet=True)
    card, expected = read_json(tmp_path / CARD), json.loads(json.dumps(ranges))
    model = make_card(NeRD(scene, NO_PREDICTIONS, NETWORKS["mlp-4x64"]))
    assert (
        card["ranges"] == json.loads(json.dumps(model["training_ranges"])) == expected
    )
    assert {"torque", "zero_torque_fraction"} <= set(ranges)
    assert not {"ground", "drive", "starts"} & set(ranges)


def test_perturbed_robots_are_stopped_where_they_fell_and_pushed(scene, generator):
    seed, rows = int(torch.randint(2**31, (), generator=generator)), 64
    fallen = SettledStates(scene, 0.2)
    rest = fallen(rows, seeded(seed))
    perturbed = PerturbedRestStates(fallen)(rows, seeded(seed))
    push = perturbed["qvel"].abs().amax(-1)
    assert push.max() < 3.0 * 6.0  # six deviations of the largest unit
    assert push.min() > 0.0
    assert push.quantile(0.25) < 0.1 * push.quantile(0.75)  # over decades
    moved = differentiate_pos(scene.layout, rest["qpos"], perturbed["qpos"])
    assert moved.abs().max() < 0.03 * 6.0
    stopped = PerturbedRestStates(fallen, 1e-9)(rows, seeded(seed))
    assert stopped["qvel"].abs().amax(-1).min() < 1e-4


def test_a_cube_stopped_on_a_steep_slope_begins_to_slide_anew(generator):
    scene, rows, steps = load_scene("cube_slope"), 24, 148
    start = PerturbedRestStates(SettledStates(scene))(rows, generator)
    steep = start["terrain"][:, 2].acos() > math.atan(0.25)  # friction: 0.15
    torque = torch.zeros(rows, steps, 0, dtype=torch.float64)
    state = TensorDict({key: start[key] for key in STATE}, [rows])
    path = MujocoDynamics(scene).rollout(state, torque, start["terrain"])
    downhill = start["terrain"][:, None, :2]
    speed = (path["qvel"][..., :2] * downhill).sum(-1) / downhill.norm(dim=-1)
    gained = speed[:, -1] - speed[:, 0]
    assert steep.any() and (gained[steep] > 0.5).all()  # g (sin - mu cos): 0.95
