"""Trained on planes, run over other ground: the same weights, and MuJoCo's contacts."""

import mujoco
import pytest
import torch
from helpers import slow_but
from unseen_terrain import UNSEEN_TERRAIN, Options, double_pendulum_over, main

from torchrl_nerd.checkpoint import from_pretrained
from torchrl_nerd.dynamics import MujocoDynamics, NeRDDynamics
from torchrl_nerd.evaluation.results import read_results
from torchrl_nerd.evaluation.rollout_error import initial_states, open_loop
from torchrl_nerd.keys import QPOS
from torchrl_nerd.robots import load_scene
from torchrl_nerd.robots.double_pendulum.tasks import DoublePendulumPassive

CASES = UNSEEN_TERRAIN.cases
each_case = pytest.mark.parametrize("case", CASES)


@each_case
def test_only_the_ground_differs(case):
    scene, trained = CASES[case].scene, load_scene("double_pendulum")
    assert scene.robot_hash == trained.robot_hash and scene.hash != trained.hash
    assert not scene.terrain.is_per_env
    links = [scene.model.geom(name).id for name in ("link1", "link2")]
    others = [trained.model.geom(name).id for name in ("link1", "link2")]
    for field in ("geom_solref", "geom_solimp", "geom_friction", "geom_priority"):
        ours, theirs = getattr(scene.model, field), getattr(trained.model, field)
        assert (ours[links] == theirs[others]).all()


@each_case
def test_starts_are_those_over_planes_and_in_the_clear(case, seed):
    task = CASES[case]
    start = initial_states(task, 500, seed)
    over_planes = initial_states(DoublePendulumPassive(0), 500, seed)
    assert torch.equal(start[QPOS], over_planes[QPOS])
    assert "terrain" not in start.keys() and not task.parameters
    assert task.scene.clearances(start[QPOS]).min() > 0.0


@pytest.mark.parametrize("case", slow_but([*CASES][:1], CASES))
def test_the_pendulum_hits_the_ground_and_the_trained_model_follows(case, seed):
    """Far nearer to the ground truth than the same model without any ground in reach."""
    task, rows, steps = CASES[case], 64, 40
    start = initial_states(task, rows, seed)
    ground_truth = open_loop(MujocoDynamics(task.scene, 1), start, steps)
    model = from_pretrained("double_pendulum")
    learned = open_loop(NeRDDynamics(model.with_terrain(task.scene)), start, steps)
    air = torch.tensor([0.0, 0.0, 1.0, -50.0]).double().expand(rows, -1)
    blind = open_loop(NeRDDynamics(model), start.clone().set("terrain", air), steps)
    touching = task.scene.clearances(ground_truth).amin((1, 2)) < 0.0
    assert touching.any()
    errors = [(x - ground_truth)[touching].abs().mean() for x in (learned, blind)]
    assert errors[0] < 0.4 * errors[1]


def test_other_robots_and_other_features_are_refused():
    model = from_pretrained("double_pendulum")
    with pytest.raises(ValueError, match="got another robot in 'cartpole'"):
        model.with_terrain(load_scene("cartpole"))

    def floor(spec):
        spec.worldbody.add_geom(type=mujoco.mjtGeom.mjGEOM_PLANE, size=(1, 1, 1))

    with pytest.raises(ValueError, match="ground with the features .*contact_normal"):
        model.with_terrain(double_pendulum_over(floor))


@pytest.mark.slow
def test_the_script_measures_them(tmp_path, seed):
    out = tmp_path / "errors.json"
    main(Options(num_trajectories=4, seed=seed, json=out))
    rows = read_results(out)["results"]
    assert {row["case"] for row in rows} == {*CASES, "driven"}
    assert {"double_pendulum", "analytic"} <= {row["name"] for row in rows}
