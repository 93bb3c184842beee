"""A network that learns a third-party robot, measured beside MuJoCo."""

import json

import pytest
import tables
from open_loop import Config, by_unit, main

from torchrl_nerd.evaluation.bench.errors import ErrorRow


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


@pytest.mark.slow
def test_a_robot_of_seconds(tmp_path):
    """Data, training, the report, and the table of the site that is made of it."""
    sizes = {"trajectories": 20, "updates": 20, "rollout_updates": 2}
    sizes |= {"test_trajectories": 8, "batch": 8, "rounds": 1}
    path = tmp_path / "open_loop_Hopper-v5.json"
    cfg = Config("gymnasium/Hopper-v5", network="mlp-1x16", out=tmp_path, **sizes)
    for _ in range(2):  # the second time it has learned already
        main(Config(**{**vars(cfg), "json": path}))
    found = json.loads(path.read_text())["results"]
    exact, errors = found["ground_truth"], found["errors"]
    assert all(x["mean"] == 0.0 for x in errors[exact].values())
    assert len(errors["learned"]) == 8  # cases, horizons, units
    for where, error in errors["learned"].items():
        assert 0.0 < error["mean"] <= error["p95"], where
        assert found["on_the_front"][where] in (True, False)
    assert found["rates"]["compiled"] > 0.0
    table = tables.open_loop_table(tmp_path)
    assert "| Hopper-v5 | passive |" in table and "commit" in table
