"""Examples with tiny budgets."""

import json
import math
import shlex
from pathlib import Path

import numpy as np
import pytest
import torch
import tyro
from dm_control import suite as dm_suite
from helpers import EXCERPT, slow_but

from torchrl_nerd.checkpoint import from_pretrained
from torchrl_nerd.dynamics import MujocoDynamics, dynamics_of
from torchrl_nerd.evaluation.policy import load_policy
from torchrl_nerd.evaluation.rollout_error import passive_errors, scene_of
from torchrl_nerd.robots import load_scene, make_task, protocol_of

EXAMPLES = Path(__file__).parents[1] / "examples"


@pytest.mark.slow
def test_a_suite_task_from_its_name_to_a_report(monkeypatch, tmp_path, seed, capsys):
    monkeypatch.syspath_prepend(str(EXAMPLES))
    import suite

    name, hold = "cartpole-balance", 20
    cfg = suite.Config(name, 8, 4, 512, 16, hold, 2, seed % 1000, tmp_path)
    suite.main(cfg)
    report = json.loads((tmp_path / name / "report.json").read_text())
    model = str(tmp_path / name / "model" / "best")
    assert set(report["returns"]) == {model, "mujoco", "dm_control"}
    assert report["returns"][model]["episodes"] == 2
    assert set(report["suite"]) == {"policy", "random"}
    assert all(0.0 < who["mean"] <= 1000.0 for who in report["suite"].values())
    assert "dm_control itself, 2 episodes, policy" in capsys.readouterr().out

    policy = load_policy(tmp_path / name)
    returns = suite.suite_returns(suite.mean_action(policy), name, hold, 1)
    env = dm_suite.load(*name.split("-"), task_kwargs={"random": 0})
    step, rewards = env.reset(), []
    while not step.last():
        if len(rewards) % hold == 0:
            seen = np.concatenate([np.ravel(x) for x in step.observation.values()])
            with torch.no_grad():
                action = policy(torch.tensor(seen).float())[0].tanh().numpy()
        step = env.step(action)
        rewards.append(step.reward)
    np.testing.assert_allclose(returns, [sum(rewards)], rtol=1e-9)


def test_a_library_that_knows_gymnasium_alone_learns_in_it(monkeypatch, seed, capsys):
    monkeypatch.syspath_prepend(str(EXAMPLES))
    pytest.importorskip("skrl")
    import gymnasium_skrl as example

    cfg = example.Config(num_envs=4, rollout=8, steps=16, episode=5, seed=seed % 1000)
    found = example.main(cfg)
    assert set(found) == {"nerd", "mujoco"}
    assert all(math.isfinite(mean) and mean != 0.0 for mean in found.values())
    np.testing.assert_allclose(found["nerd"], found["mujoco"], rtol=1e-3, atol=1e-3)
    assert "mujoco: " in capsys.readouterr().out


@pytest.mark.parametrize("dynamics", slow_but(["nerd"], ["nerd", "mujoco"]))
def test_ppo_learns_in_one_dynamics_and_is_measured_in_all(
    dynamics, monkeypatch, tmp_path, seed, capsys
):
    """What `make demo` does; the dynamics are one argument and nothing else changes."""
    monkeypatch.syspath_prepend(str(EXAMPLES))
    import ppo

    sizes = {"num_envs": 8, "horizon": 4, "total_frames": 64, "minibatch": 16}
    cfg = ppo.Run(dynamics=dynamics, seed=seed, episodes=4, out=tmp_path, **sizes)
    ppo.main(cfg)
    returns = json.loads((tmp_path / "returns.json").read_text())
    assert set(returns) == {"nerd", "mujoco", "dm_control"}
    for summary in returns.values():
        assert summary["episodes"] == 4 and abs(summary["difference"]) < 0.05
    assert "dm_control  " in capsys.readouterr().out
    (point,) = json.loads((tmp_path / "learning_curve.json").read_text())["curve"]
    assert point.keys() == {"frames", "nerd", "mujoco"} and point["frames"] == 64
    card = json.loads((tmp_path / "policy.json").read_text())
    assert card.items() >= {"dynamics": dynamics, "seed": seed, "horizon": 4}.items()
    load_policy(tmp_path, make_task(cfg.task))


def test_ppo_of_less_than_a_batch_is_refused(monkeypatch):
    monkeypatch.syspath_prepend(str(EXAMPLES))
    import ppo

    with pytest.raises(ValueError, match="total_frames of at least 2048, got 1000"):
        ppo.num_frames(ppo.Run(total_frames=1000, num_envs=64, horizon=32))


def test_ppo_is_short():
    assert len((EXAMPLES / "ppo.py").read_text().splitlines()) <= 150


def test_a_log_is_learned_from_and_measured(monkeypatch, capsys):
    monkeypatch.syspath_prepend(str(EXAMPLES))
    import finetune_cube

    argv = ["finetune_cube.py", "--log", str(EXCERPT), "--evaluations", "2"]
    monkeypatch.setattr("sys.argv", argv)
    finetune_cube.main()
    said = capsys.readouterr().out
    assert all(name in said for name in ("no motion", "before", "after"))


@pytest.mark.parametrize(
    "words", ["double_pendulum --case 'terrain 1'", "cartpole --dynamics analytic"]
)
def test_traces_are_drawn(words, monkeypatch, tmp_path, seed, capsys):
    """A figure, and the errors at its end as `nerd eval` finds them."""
    monkeypatch.syspath_prepend(str(EXAMPLES))
    import traces

    how = f"{words} --trajectories 4 --steps 5 --seed {seed} --out {tmp_path}/a.png"
    traces.main(tyro.cli(traces.Options, args=shlex.split(how)))
    assert (tmp_path / "a.png").read_bytes().startswith(b"\x89PNG")
    *said, where = capsys.readouterr().out.splitlines()
    name = words.split()[0]
    scene = load_scene(name)
    source = next(iter(protocol_of(scene).cases.values()))
    model = from_pretrained("analytic" if "analytic" in words else "nerd", scene)
    dynamics = dynamics_of(model.with_terrain(scene_of(source)))
    ground_truth = MujocoDynamics(dynamics.scene)
    found = passive_errors(source, dynamics, ground_truth, [5], 4, seed)[5]
    assert said == [
        f"{joint}: {error.final:.3g} {error.unit} after 5 steps"
        for joint, error in found.items()
    ]
    assert "4 trajectories" in where
