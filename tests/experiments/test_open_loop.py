"""A network that learns a third-party robot, measured beside MuJoCo."""

import json
from pathlib import Path

import pytest
import tables
import torch
from open_loop import BF16, Config, along_policy, by_unit, main, policy_set

from torchrl_nerd import make_env
from torchrl_nerd.dynamics import MujocoDynamics
from torchrl_nerd.evaluation.bench.errors import ErrorRow
from torchrl_nerd.evaluation.policy import Policy, save_policy
from torchrl_nerd.keys import QPOS
from torchrl_nerd.robots import load_scene

HOPPER = "gymnasium/Hopper-v5"


def row(quantity: str, unit: str, mean: float) -> ErrorRow:
    about = "passive", 20, "learned", "learned"
    return ErrorRow(*about, quantity, unit, mean, 0.1, 2.0 * mean, 3.0 * mean)


def test_joints_of_one_unit_are_averaged():
    rows = row("hip", "rad", 1.0), row("knee", "rad", 3.0), row("slider", "m", 5.0)
    found = by_unit(rows)["learned"]
    assert list(found) == ["passive, 20 steps, rad", "passive, 20 steps, m"]
    joints = found["passive, 20 steps, rad"]
    assert (joints["mean"], joints["final"], joints["p95"]) == (2.0, 4.0, 6.0)
    assert found["passive, 20 steps, m"]["mean"] == 5.0


def standing_policy(folder: Path) -> Path:
    """A saved policy of the Hopper that has learned nothing."""
    env = make_env("gymnasium/Hopper-v5", "mujoco", 2, 0)
    save_policy(Policy.for_env(env, 4, (8,), 1.0, 1), folder, {"task": HOPPER})
    return folder


@pytest.mark.slow
def test_motion_along_a_policy_is_what_the_policy_did(tmp_path):
    """Its actions from the recorded states give the recorded motion again."""
    cfg = Config(HOPPER, policy=standing_policy(tmp_path), test_trajectories=3)
    scene = load_scene(HOPPER)
    found = policy_set(scene, cfg)
    pieces = along_policy(scene, cfg, 3, cfg.test_seed, noise=0.0)
    same = (found.start[QPOS][:, None] == pieces[QPOS][:, 0]).all(-1)  # (3, pieces)
    chosen = same.int().argmax(1)
    assert same.any(1).all() and len(set(chosen.tolist())) == 3
    torch.testing.assert_close(found.ground_truth, pieces["next", QPOS][chosen])
    errors = found.errors(MujocoDynamics(scene))
    assert all((error == 0.0).all() for error in errors.values())


def test_a_policy_of_another_robot_is_refused(tmp_path):
    cfg = Config("gymnasium/Walker2d-v5", policy=standing_policy(tmp_path))
    with pytest.raises(SystemExit, match="Hopper-v5, expected gymnasium.Walker2d-v5"):
        along_policy(load_scene(cfg.robot), cfg, 2, 0, 0.0)


@pytest.mark.slow
def test_a_robot_of_seconds(tmp_path):
    """Data, training, the report, and the table of the site that is made of it."""
    sizes = {"trajectories": 20, "updates": 20, "rollout_updates": 2}
    sizes |= {"test_trajectories": 8, "batch": 8, "rounds": 1}
    path = tmp_path / "open_loop_Hopper-v5.json"
    sizes |= {"policy": standing_policy(tmp_path / "policy"), "along": 4}
    cfg = Config(HOPPER, network="mlp-1x16", out=tmp_path, **sizes)
    for _ in range(2):  # the second time it has learned already
        main(Config(**{**vars(cfg), "json": path}))
    found = json.loads(path.read_text())["results"]
    exact, errors = found["ground_truth"], found["errors"]
    assert all(x["mean"] == 0.0 for x in errors[exact].values())
    assert len(errors["learned"]) == 12  # cases, horizons, units
    for where, error in errors["learned"].items():
        assert 0.0 < error["mean"] <= error["p95"], where
        assert found["on_the_front"][where] in (True, False)
        assert found["on_the_front_in_bf16"][where] in (True, False)
        assert found["errors"][BF16][where]["mean"] != error["mean"]
    assert min(found["rates"]["compiled"], found["rates"]["compiled bf16"]) > 0.0
    table = tables.open_loop_table(tmp_path)
    assert (
        "| Hopper-v5 | passive |" in table
        and "| along a policy |" in table
        and "commit" in table
    )
