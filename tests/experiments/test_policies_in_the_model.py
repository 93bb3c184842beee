"""Policies that learn in a model alone: what fails there, the data, the whole of it."""

import json

import falls
import pytest
import tables
import torch
from noisy_dynamics import NoisyDynamics, StepErrors, step_errors
from policies_in_the_model import (
    PIECE,
    SEGMENT,
    Config,
    Trusted,
    in_the_model,
    main,
    pieces_along,
)
from torchrl.envs import EnvBase, TransformedEnv

from torchrl_nerd import NeRDEnv, from_pretrained, make_env
from torchrl_nerd.dynamics import NeRDDynamics
from torchrl_nerd.evaluation.policy import Policy, make_actor
from torchrl_nerd.keys import QPOS, QVEL
from torchrl_nerd.robots import make_task
from torchrl_nerd.seeds import fold_in


def test_an_episode_fails_where_the_model_has_no_data():
    env = TransformedEnv(
        NeRDEnv("cartpole/swingup", num_envs=2, guard="flag"), Trusted(0.5)
    )
    state = env.reset()
    state[QVEL][1] = 500.0
    after = env.rand_step(env.reset(state, set_state=True))["next"]
    assert after["trust"][0] > 0.5 > after["trust"][1]
    for key in ("done", "terminated"):
        assert after[key].flatten().tolist() == [False, True]


def test_a_robot_that_fell_starts_anew_and_others_go_on():
    task = make_task("gymnasium/Hopper-v5")
    actor = make_actor(Policy.for_env(make_env(task, "mujoco", 2, 0), 4, (8,), 1.0, 1))
    rows, pieces = 6, 5
    found = pieces_along(task, actor, rows, pieces * PIECE, fold_in(0, 1), noise=1.0)
    assert found.batch_size == (rows * pieces, PIECE)
    torch.testing.assert_close(found[:, 1:][QPOS], found[:, :-1]["next", QPOS])
    by_piece = found.reshape(pieces, rows, PIECE)
    after = {key: by_piece["next", key] for key in (QPOS, QVEL)}
    fell = task.terminated(after).any(-1)[:-1]  # (pieces - 1, rows)
    ends, starts = by_piece[:-1, :, -1]["next", QPOS], by_piece[1:, :, 0][QPOS]
    torch.testing.assert_close(starts[~fell], ends[~fell], rtol=0, atol=0)
    assert fell.any() and (starts[fell] - ends[fell]).abs().amax(-1).min() > 0.01
    assert not task.terminated({key: found[:, 0][key] for key in (QPOS, QVEL)}).any()


def test_noise_is_a_share_of_the_change():
    """With none it is the model; at rest it is a share of the least change."""
    model = from_pretrained("cartpole-mlp")
    start = make_env("cartpole/swingup", "mujoco", 4, 0).rollout(9)[:, -1]
    state, torque = start.select(QPOS, QVEL), torch.full((4, 1), 5.0)
    exact = NeRDDynamics(model).step(state, torque)
    error = torch.tensor([[0.3, -0.1]])
    for share in (0.0, 0.5):
        change = torch.linalg.vector_norm(exact[QVEL] - state[QVEL], dim=1)
        least = change.median()
        errors = StepErrors(error, least)
        found = NoisyDynamics(model, errors, share).step(state, torque)
        change = change.clamp(min=least)
        expected = exact[QVEL] + share * change[:, None] * error
        torch.testing.assert_close(found[QVEL], expected)
        torch.testing.assert_close(found[QPOS], exact[QPOS], rtol=0, atol=0)


def test_errors_are_those_of_one_step():
    """None on the model's own motion; on MuJoCo's they turn its step into MuJoCo's."""
    model = from_pretrained("cartpole-mlp")
    own = make_env("cartpole/swingup", "cartpole-mlp", 4, 0).rollout(9)
    assert step_errors(model, own).shares.abs().max() < 1e-5
    data = make_env("cartpole/swingup", "mujoco", 4, 0).rollout(9)
    errors = step_errors(model, data).shares
    assert len(errors) == 36 and errors.abs().max() > 1e-5
    one, found = data.reshape(-1)[:1], step_errors(model, data[:1, :1])
    step = NoisyDynamics(model, found, 1.0).step
    after = step(one.select(QPOS, QVEL), one["next", "joint_torque"])
    torch.testing.assert_close(after[QVEL], one["next", QVEL], rtol=1e-3, atol=1e-5)


def test_models_of_another_run_are_left_alone(tmp_path):
    cfg = Config("gymnasium/Hopper-v5", out=tmp_path)
    (cfg.folder / "model_0").mkdir(parents=True)
    with pytest.raises(ValueError, match="expected no models in .*Hopper-v5, got some"):
        main(cfg)


@pytest.mark.parametrize(
    "given", [{}, {"every": 0}, {"ahead": (5, 0)}, {"noise": (float("nan"),)}]
)
def test_falls_need_models_and_settings_in_range(given, tmp_path):
    with pytest.raises(ValueError, match="expected "):
        falls.main(falls.Config("gymnasium/Ant-v5", tmp_path, **given))


@pytest.mark.slow
def test_a_round_of_seconds(tmp_path):
    """Both ways, the report, and the table of the site that is made of it."""
    sizes = {"trajectories": 20, "updates": 20, "more_updates": 10, "rounds": 2}
    sizes |= {"along": 4, "length": SEGMENT, "frames": 4096, "num_envs": 64}
    sizes |= {"horizon": 16, "minibatch": 512, "episodes": 4, "last_updates": 10}
    path = tmp_path / "policies_Hopper.json"
    main(Config("gymnasium/Hopper-v5", out=tmp_path, json=path, **sizes))
    found = json.loads(path.read_text())["results"]
    assert [x["robot_frames"] for x in found["mujoco"]] == [2048, 4096]
    assert found["model"][-1]["robot_frames"] >= 20 * SEGMENT
    assert {"data", "model", "policy"} == found["seconds"]["model"].keys()
    assert tables.policies_table(tmp_path).count("| gymnasium/Hopper-v5 |") == 3
    assert tables.policy_curves_table(tmp_path).count("| gymnasium/Hopper-v5 |") == 2


@pytest.mark.slow
def test_falls_are_counted_in_mujoco_and_in_the_model(tmp_path):
    """Of a run of seconds; and a robot whose base is fixed is refused."""
    sizes = {"trajectories": 20, "updates": 20, "rounds": 1, "along": 4, "frames": 1024}
    sizes |= {"length": SEGMENT, "num_envs": 64, "horizon": 16, "episodes": 4}
    sizes |= {"last_updates": 10}
    learned = Config("gymnasium/Ant-v5", out=tmp_path, minibatch=512, **sizes)
    in_the_model(learned)
    path, how = tmp_path / "falls_Ant.json", {"robots": 4, "actions": 20, "every": 10}
    how |= {"ahead": (1, 5)}
    falls.main(falls.Config(learned.name, learned.folder, json=path, **how))
    found = json.loads(path.read_text())["results"]
    rows, ahead = found["on_their_back"], found["ahead_m"]
    assert len(rows) == 4 and len(ahead) == 3 and len(found["progress_m"]) == 2
    one, _ = (abs(x["mean"]) for x in ahead["model, noise 0"])
    assert 0 < one < 0.05  # m, from equal states
    assert all(len(x) == 2 and all(0 <= y <= 1 for y in x) for x in rows.values())
    assert "| MuJoCo |" in tables.falls_table(tmp_path)
    with pytest.raises(ValueError, match="expected a robot whose base moves freely"):
        falls.main(falls.Config("gymnasium/Hopper-v5", tmp_path))


def test_a_robot_upside_down_is_on_its_back():
    env = make_env("gymnasium/Ant-v5", "mujoco", 2, 0)
    actor = make_actor(Policy.for_env(env, 4, (8,), 1.0, 1))
    turned = torch.tensor([0.0, 1.0, 0.0, 0.0], dtype=torch.float64)
    assert falls.falls(env, actor, 2, 1) == [0.0, 0.0]
    start = env.reset()
    start[QPOS][1, 3:7] = turned
    env.reset = lambda: EnvBase.reset(env, start, set_state=True)
    assert falls.falls(env, actor, 2, 1) == [0.5, 0.5]
