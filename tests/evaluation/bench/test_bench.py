"""The race: a truth that is one, honest rows, a front that nobody beats."""

import json
import math
from dataclasses import replace

import mujoco
import pytest
import torch
from helpers import slow_but

from torchrl_nerd.checkpoint import (
    make_card,
    make_model,
    save_checkpoint,
    shipped_models,
)
from torchrl_nerd.dynamics import MujocoDynamics
from torchrl_nerd.evaluation.bench import rates
from torchrl_nerd.evaluation.bench.contenders import (
    contenders,
    mujoco_contenders,
    truth,
)
from torchrl_nerd.evaluation.bench.errors import (
    PERTURBATIONS,
    chaos_floor,
    contender_errors,
    courses,
)
from torchrl_nerd.evaluation.bench.pareto import best_within, pareto_front
from torchrl_nerd.evaluation.bench.plot import plot_race
from torchrl_nerd.evaluation.bench.rates import states_on_the_way
from torchrl_nerd.evaluation.bench.report import BenchReport, bench
from torchrl_nerd.evaluation.bench.table import bench_table
from torchrl_nerd.evaluation.rollout_error import open_loop
from torchrl_nerd.modules.networks import NETWORKS
from torchrl_nerd.robots import PRESETS, load_scene
from torchrl_nerd.scenes import Scene

QUICK = ("cartpole", "franka", "cube")  # the fewest models, still one in contact


@pytest.fixture(params=list(PRESETS))
def name(request) -> str:
    """Each scene with a protocol."""
    return request.param


@pytest.mark.parametrize("name", slow_but(QUICK, PRESETS))
def test_a_whole_race(name, tmp_path, monkeypatch):
    monkeypatch.setattr(rates, "VISIT", 0.01)  # speeds need not be exact here
    scene = load_scene(name)
    report = bench(
        scene, (1, 3), rows=4, rounds=1, steps=3, is_compiling=False, threads=1
    )
    expected = {who.name for who in contenders(scene, 1, is_compiling=False)}
    assert set(report.errors) == expected
    shipped = [m for m in shipped_models() if m.split("-")[0] == name]
    assert set(shipped) <= expected
    for by_name in report.rates.values():
        assert set(by_name) == expected
        for rate in by_name.values():
            assert min(rate.steps_per_s, rate.envs_per_s, rate.warm_up_s) > 0.0
        for row, cost in report.costs.items():
            share = by_name[row].matrix_share
            assert cost.flop > 0.0 and share is not None and 0.0 < share < 1.0
    assert set(report.costs) == {row for row in expected if "MuJoCo" not in row}
    for errors in report.errors.values():
        assert all(math.isfinite(error.mean) for error in errors.values())
    text = bench_table(report)
    assert all(row in text for row in expected)
    read = json.loads(json.dumps(report.figures()))
    assert BenchReport.from_figures(read) == report
    plot_race(report, tmp_path / "race.png")
    assert (tmp_path / "race.png").read_bytes().startswith(b"\x89PNG")
    for quantity in report.quantities:
        assert report.front(3, quantity)
        broken = report.errors["MuJoCo x1"]  # as a coarse step of the Ant's does
        broken[quantity] = replace(broken[quantity], mean=math.nan)
    plot_race(report, tmp_path / "broken.png")
    assert (tmp_path / "broken.png").exists()


def brief_race(scene: Scene, **how) -> BenchReport:
    """Of two rows and two steps, nothing compiled."""
    sizes = {"rows": 2, "rounds": 1, "steps": 2, "threads": 1}
    return bench(scene, (2,), is_compiling=False, **sizes, **how)


def test_a_robot_of_the_suite_races_with_a_model_of_ones_own(tmp_path, monkeypatch):
    """An untrained one here: it is slow and wrong, and says so."""
    monkeypatch.setattr(rates, "VISIT", 0.01)
    scene = load_scene("dm_control/hopper-stand")
    model = make_model(scene, NETWORKS["mlp-1x32"]).eval()
    folder = save_checkpoint(model, tmp_path / "hopper", make_card(model))
    words = "guarded", "bf16", "RK4", "implicitfast"
    report = brief_race(scene, without=words, models=[str(folder)])
    learned = {row for row in report.errors if not row.startswith("MuJoCo")}
    assert learned == {str(folder)} == set(report.costs)
    own = report.errors[f"MuJoCo x{scene.substeps}"]
    for quantity, error in report.errors[str(folder)].items():
        assert error.mean > own[quantity].mean
    assert not report.published and report.rates[2][str(folder)].envs_per_s > 0.0


def test_who_is_left_out_takes_no_part(monkeypatch):
    monkeypatch.setattr(rates, "VISIT", 0.01)
    words = "MuJoCo x", "guarded", "bf16", "fine", "micro"
    scene = load_scene("cartpole")
    report = brief_race(scene, without=words)
    integrators = ("MuJoCo implicitfast", "MuJoCo RK4")
    coarse = {f"{name} x{n}" for name in integrators for n in (1, 4)}
    assert set(report.errors) == coarse | {"cartpole", "cartpole, window"}
    assert set(report.rates[2]) == set(report.errors)


def test_another_number_of_substeps_is_the_same_control_step(name, generator):
    scene = load_scene(name)
    for substeps in (1, 3, 16):
        other = scene.with_substeps(substeps)
        assert other.control_step == pytest.approx(scene.control_step, rel=1e-12)
        assert other.substeps == substeps
    same = scene.with_substeps(scene.substeps)
    task = next(iter(PRESETS[name].protocol().cases.values()))
    start = states_on_the_way(task, 5, 1)
    paths = [open_loop(MujocoDynamics(s), start, 3) for s in (task.scene, same)]
    torch.testing.assert_close(paths[0], paths[1], rtol=0, atol=1e-9)


def test_errors_shrink_with_the_substeps_and_the_truth_has_none(seed):
    """Without contact Euler's error is of first order."""
    ground = courses(PRESETS["cartpole"].protocol(), 16, seed, 1, steps=30)
    rows = {who.name: who for who in mujoco_contenders(ground[0].scene, 1)}
    coarse, fine = (
        contender_errors(rows[f"MuJoCo x{n}"], ground)["hinge"].mean for n in (2, 8)
    )
    assert 3.0 < coarse / fine < 6.0
    again = ground[0].errors(truth(ground[0].scene, 1))
    assert all(not error.any() for error in again.values())


@pytest.mark.parametrize("robot", ["cartpole", "franka"])
def test_nothing_is_finer_than_a_truth_without_contact(robot, seed):
    """Of the error of the scene's own substeps, finer ones move it by a ten-thousandth."""
    course = courses(PRESETS[robot].protocol(), 8, seed, 1, steps=20)[0]
    rk4 = int(mujoco.mjtIntegrator.mjINT_RK4)
    finer = MujocoDynamics(
        course.scene.reference.with_substeps(16 * course.scene.substeps, rk4)
    )
    own = course.errors(MujocoDynamics(course.scene))
    for name, error in course.errors(finer).items():
        assert error.max() < 1e-4 * own[name].max()


def test_the_chaos_floor_is_as_high_as_the_push(seed):
    ground = courses(PRESETS["cartpole"].protocol(), 64, seed, 1, steps=2)
    floors = chaos_floor(ground, 1, seed).values()
    for size, errors in zip(PERTURBATIONS, floors, strict=True):
        for error in errors.values():  # mean of |N(0, 1)| is 0.8
            assert 0.4 * size < error.mean < 2.0 * size


def test_nobody_beats_the_front(generator):
    draw = torch.rand(40, 2, generator=generator).tolist()
    points = {str(i): (error, rate) for i, (error, rate) in enumerate(draw)}
    points["blown up"] = (float("nan"), 9.0)
    points["also"] = (float("inf"), 9.0)
    front = pareto_front(points)
    for name, (error, rate) in points.items():
        beaten = any(
            e <= error and r >= rate and (e, r) != (error, rate)
            for e, r in points.values()
        )
        if math.isfinite(error):
            assert (name in front) != beaten
        else:
            assert name not in front


def test_the_choice_is_the_fastest_within_the_budget():
    errors = {"a": (1.0, 1.0), "b": (2.0, 1.0), "c": (0.5, 3.0)}
    rates = {"a": 1.0, "b": 2.0, "c": 3.0}
    assert best_within(errors, rates, (2.0, 2.0)) == "b"
    assert best_within(errors, rates, (1.0, 9.0)) == "c"
    assert best_within(errors, rates, (0.1, 0.1)) is None
    with pytest.raises(ValueError, match="expected a budget of 2 numbers, got 1"):
        best_within(errors, rates, (1.0,))


def test_bad_requests_are_refused_in_a_sentence():
    scene = load_scene("cartpole")
    with pytest.raises(ValueError, match="rounds"):
        bench(scene, rounds=0)
    with pytest.raises(ValueError, match="batch 0"):
        bench(scene, (0,))
    with pytest.raises(ValueError, match="none without MuJoCo, cartpole"):
        bench(scene, without=("MuJoCo", "cartpole"))
    with pytest.raises(ValueError, match="robot with a task.*'gymnasium/Hopper-v5'"):
        bench(load_scene("gymnasium/Hopper-v5"))
    with pytest.raises(ValueError, match="checkpoint folder, got 'nowhere'"):
        bench(scene, models=["nowhere"])
