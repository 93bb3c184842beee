"""PPO in several dynamics against time, and its policies in the models of others."""

import json
import math
import time

import own_policies
import pytest
import tables
import time_to_policy
import torch
import unmet_policies
from plot_time_to_policy import draw
from safetensors.torch import load_file
from time_to_policy import env_of, time_to, wanted_of

from torchrl_nerd import make_env
from torchrl_nerd.evaluation.policy import Policy, load_policy, make_actor, save_policy
from torchrl_nerd.evaluation.policy_transfer import transfer
from torchrl_nerd.robots import make_task


def curve(*returns):
    return [{"seconds": 10.0 * i, "return": r} for i, r in enumerate(returns)]


def test_time_counts_until_a_return_is_reached_for_good():
    assert time_to(curve(0, 5, 3, 5, 6), 4.0) == 30.0
    assert time_to(curve(5, 6), 4.0) == 0.0
    assert time_to(curve(0, 5, 3), 4.0) is None


def test_a_return_below_zero_can_be_wanted():
    assert wanted_of(curve(-200, -150, -100)) == pytest.approx(-110)
    assert wanted_of(curve(0, 50)) == pytest.approx(45)


def test_a_wanted_return_has_to_be_known():
    """Before anything is learned."""
    how = time_to_policy.Config("cartpole/swingup", ("cartpole-mlp",))
    with pytest.raises(ValueError, match="expected --wanted"):
        time_to_policy.main(how)


@pytest.mark.parametrize("name", ["mujoco-x", "cartpole-lstm"])
def test_unknown_dynamics_are_refused_before_any_learns(name, tmp_path):
    how = time_to_policy.Config("cartpole/swingup", ("mujoco", name), out=tmp_path)
    with pytest.raises(ValueError, match=name):
        time_to_policy.main(how)
    assert not list(tmp_path.iterdir())


def test_fewer_substeps_are_those_of_the_scene():
    """The same start and actions as MuJoCo with that scene, by itself."""
    few = make_task("cartpole/swingup").scene.with_substeps(1)
    env = env_of("mujoco-1", "cartpole/swingup", 4, 0)
    own = make_env("cartpole/swingup", "mujoco", 4, 0)
    assert env.task.scene.hash == few.hash != own.task.scene.hash
    start, same = env.reset(), own.reset()
    torch.testing.assert_close(start["qpos"], same["qpos"], rtol=0, atol=0)
    action = env.rand_action(start)["action"]
    moved = [x.step(s.set("action", action)) for x, s in ((env, start), (own, same))]
    first, second = (x["next", "qvel"] for x in moved)
    assert 0 < (first - second).abs().max() < 1.0


def test_models_are_judged_by_what_they_do_to_others():
    rows = [
        {"model": "a", "kind": "learned", "return": 10.0, "difference": 2.0},
        {"model": "a", "kind": "learned", "return": 100.0, "difference": -5.0},
        {"model": "b", "kind": "learned", "return": 100.0, "difference": 0.0},
    ]
    rows = [row | {"share": row["difference"] / row["return"]} for row in rows]
    first, second = unmet_policies.summaries(rows)
    assert (first["policies"], second["policies"]) == (2, 1)
    assert first["mean"] == pytest.approx(0.125)
    assert first["worst"] == pytest.approx(0.2)
    assert first["mean_of_best"] == pytest.approx(0.035)
    assert second["worst_of_best"] == 0.0


def test_a_folder_without_policies_is_refused(tmp_path):
    with pytest.raises(ValueError, match="expected policies"):
        unmet_policies.found_policies(tmp_path)


@pytest.mark.slow
def test_both_scripts_with_tables_and_a_picture(tmp_path):
    sizes = {"frames": 4096, "num_envs": 64, "horizon": 16, "minibatch": 512}
    sizes |= {"points": 2, "episodes": 4}
    path = tmp_path / "time_to_policy_cartpole.json"
    dynamics = ("cartpole-mlp", "mujoco", "mujoco-1")
    how = time_to_policy.Config(
        "cartpole/swingup", dynamics, out=tmp_path, json=path, **sizes
    )
    time_to_policy.main(how)
    found = json.loads(path.read_text())["results"]
    assert found["curves"].keys() == set(dynamics)
    for points in found["curves"].values():
        assert [p["frames"] for p in points] == [0, 2048, 4096]
        assert all(math.isfinite(p["return"]) for p in points)
        times = [p["seconds"] for p in points]
        assert times == sorted(times)
    both = {
        name: [(p["return"], p["promised"]) for p in points]
        for name, points in found["curves"].items()
    }
    assert all(a == b for a, b in both["mujoco"])  # the same starts
    assert all(a != b for a, b in both["cartpole-mlp"])
    starts = [load_file(how.folder / n / "0/policy.safetensors") for n in dynamics]
    for key in (name for name in starts[0] if name.startswith("mlp.")):
        assert all(torch.equal(x[key], starts[0][key]) for x in starts)
    began = time.monotonic()
    again = {name: time_to_policy.learn_in(name, how) for name in dynamics}
    assert again == found["curves"] and time.monotonic() - began < 1.0
    draw(path, tmp_path / "picture.svg")
    assert "<svg" in (tmp_path / "picture.svg").read_text()
    assert "mujoco-1" in tables.time_to_policy_table(tmp_path)

    path = tmp_path / "unmet_policies_cartpole.json"
    models = ("cartpole-mlp", "analytic")
    unmet_policies.main(
        unmet_policies.Config(
            "cartpole/swingup", how.folder, models, episodes=4, json=path
        )
    )
    found = json.loads(path.read_text())["results"]
    counts = {m["model"]: m["policies"] for m in found["models"]}
    assert counts == {"cartpole-mlp": 6, "analytic": 9}  # its own three are left out
    assert "analytic" in tables.unmet_policies_table(tmp_path)


def test_a_policy_does_not_play_in_the_model_it_learned_in(tmp_path, monkeypatch):
    """Whatever that model is called."""
    played = []
    monkeypatch.setattr(
        unmet_policies, "transfer", lambda *given, **how: played.append(given[2]) or {}
    )
    monkeypatch.setattr(unmet_policies, "GROUND_TRUTH", "none")
    models = ("nerd", "cartpole", "cartpole-mlp")
    cfg = unmet_policies.Config("cartpole/swingup", tmp_path, models)
    about = {"task": "cartpole/swingup", "learned_in": "nerd"}
    folder = save_policy(Policy((4, 8, 1)), tmp_path / "any" / "0", about)
    with pytest.raises(KeyError, match="none"):
        unmet_policies.play(cfg, folder)
    assert played == [["cartpole-mlp"]]


def test_a_policy_plays_where_it_learned_and_in_mujoco(tmp_path):
    """The last of each dynamics; differences are those of one `nerd transfer`."""
    for seed in range(2):
        torch.manual_seed(seed)
        for name in ("mujoco", "mujoco-1", "cartpole-mlp"):
            for number in (2, 10):
                about = {"task": "cartpole/swingup", "learned_in": name}
                folder = tmp_path / f"{seed}" / name / f"{number}"
                save_policy(Policy((4, 8, 1)), folder, about)
    folders = tmp_path / "0", tmp_path / "1"
    last = [tmp_path / f"{seed}/cartpole-mlp/10" for seed in range(2)]
    assert [own_policies.last_policies(folder)[0] for folder in folders] == last
    path = tmp_path / "own_policies_cartpole.json"
    cfg = own_policies.Config("cartpole/swingup", folders, episodes=4, json=path)
    own_policies.main(cfg)
    found = json.loads(path.read_text())["results"]
    assert [row["model"] for row in found["policies"]] == ["cartpole-mlp"] * 2
    task = make_task("cartpole/swingup")
    actor = make_actor(load_policy(last[0], task))
    played = transfer(task, actor, ("cartpole-mlp",), 4, seed=cfg.seed)
    assert found["policies"][0]["share"] == played["cartpole-mlp"].difference
    (model,) = found["models"]
    shares = [row["share"] for row in found["policies"]]
    assert model["worst"] == max(shares, key=abs) and model["policies"] == 2
    promised, reached = (
        sum(row[key] for row in found["policies"]) for key in ("promised", "return")
    )
    assert model["difference"] == pytest.approx((promised - reached) / abs(reached))
    assert "cartpole-mlp, learned" in tables.own_policies_table(tmp_path)


def test_a_folder_of_engines_alone_is_refused(tmp_path):
    about = {"task": "cartpole/swingup", "learned_in": "mujoco-4"}
    save_policy(Policy((4, 8, 1)), tmp_path / "mujoco-4" / "0", about)
    with pytest.raises(ValueError, match="expected policies of a model"):
        own_policies.last_policies(tmp_path)
