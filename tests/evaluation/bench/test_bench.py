"""The benchmark: a ground truth that is one, equal protocol, a front that nobody beats."""

import math
from dataclasses import replace

import mujoco
import pytest
import torch
from draw_benchmarks import plot_bench
from helpers import slow_but

from torchrl_nerd.checkpoint import make_card, save_checkpoint, shipped_models
from torchrl_nerd.configs import FeatureConfig
from torchrl_nerd.dynamics import MujocoDynamics
from torchrl_nerd.evaluation.bench import rates
from torchrl_nerd.evaluation.bench.candidates import (
    COARSE,
    RIVALS,
    Candidate,
    NoMotion,
    models,
    mujoco_name,
    simulators,
)
from torchrl_nerd.evaluation.bench.errors import (
    DRIVEN,
    GROUND_TRUTH,
    PAPER,
    EvaluationSet,
    cases_of,
    error_rows,
    error_table,
    evaluation_set,
    measure,
)
from torchrl_nerd.evaluation.bench.rates import mid_states
from torchrl_nerd.evaluation.bench.report import (
    PERTURBATION,
    BenchConfig,
    BenchReport,
    bench,
    bench_table,
    pareto_front,
    reference_of,
)
from torchrl_nerd.evaluation.rollout_error import open_loop, scene_of
from torchrl_nerd.modules.nerd import NeRD
from torchrl_nerd.modules.networks import NETWORKS
from torchrl_nerd.robots import PRESETS, load_scene, protocol_of
from torchrl_nerd.scenes import Scene

QUICK = ("cartpole", "cube")  # the fewest models, still one in contact


@pytest.fixture(params=list(PRESETS))
def name(request) -> str:
    """Each scene with a protocol."""
    return request.param


def own(scene: Scene) -> MujocoDynamics:
    return MujocoDynamics(scene, num_threads=1)


def finest(scene: Scene) -> MujocoDynamics:
    return MujocoDynamics(reference_of(scene), num_threads=1)


def first_set(name: str, seed: int, make=own, count=8, steps=20) -> EvaluationSet:
    case, source, is_driven = next(cases_of(protocol_of(load_scene(name))))
    return evaluation_set(case, source, is_driven, make, count, steps, seed)


def by_name(scene: Scene) -> dict:
    return {c.name: c for c in simulators(scene, 1)}


def test_the_simulators_are_those_that_are_promised(name):
    """No motion; 1, 2, 4, ... and the scene's own substeps; rivals at 1 and 4."""
    scene = load_scene(name)
    found = simulators(scene, 1)
    assert found[0].name == "no motion" and isinstance(found[0].make(scene), NoMotion)
    made = [c.make(scene).scene for c in found[1:]]
    settings = {(s.model.opt.integrator, s.substeps) for s in made}
    assert len(settings) == len(found) - 1  # none twice
    doubling = {2**k for k in range(9) if 2**k < scene.substeps} | {scene.substeps}
    mine = scene.model.opt.integrator
    assert settings == {(mine, n) for n in doubling} | {
        (int(rival), n) for rival in RIVALS.values() for n in COARSE
    }
    assert mujoco_name(scene) in {c.name for c in found}
    for candidate, there in zip(found[1:], made, strict=True):
        assert there.control_step == pytest.approx(scene.control_step, rel=1e-12)
        assert str(there.substeps) in candidate.name.split()


def test_driven_beside_passive_where_there_are_actuators(name):
    protocol = protocol_of(load_scene(name))
    cases = list(cases_of(protocol))
    has_motors = bool(scene_of(next(iter(protocol.cases.values()))).actuated)
    assert [case for case, _, _ in cases][: len(protocol.cases)] == list(protocol.cases)
    assert any(is_driven for _, _, is_driven in cases) == has_motors
    extra = [case for case, _, _ in cases if case not in protocol.cases]
    assert extra == [DRIVEN] * (has_motors and not protocol.random_actions)


@pytest.mark.parametrize("name", slow_but(QUICK[1:], PRESETS))
def test_a_whole_benchmark(name, tmp_path, monkeypatch):
    monkeypatch.setattr(rates, "SAMPLE_SECONDS", 0.01)  # speeds need not be exact here
    scene = load_scene(name)
    sizes = {"num_trajectories": 4, "rounds": 1, "steps": 3}
    report = bench(scene, BenchConfig(batches=(1, 3), variants=(), **sizes))
    expected = {c.name for c in [*simulators(scene, 1), *models(scene)]}
    shown = {row.name for row in report.errors if row.kind != "sensitivity"} - {PAPER}
    assert shown == expected and set(shipped_models(scene)) <= expected
    for batch in report.batches:
        speeds = report.speeds(batch)
        assert set(speeds) == expected - {"no motion"}
        assert min(speeds.values()) > 0.0
    assert all(row.warm_up_s > 0.0 for row in report.rates)
    text = bench_table(report)
    assert report.ground_truth in text and all(row in text for row in expected)
    plot_bench(report, tmp_path / "bench.png")
    assert (tmp_path / "bench.png").read_bytes().startswith(b"\x89PNG")
    coarse = report.errors[len({row.quantity for row in report.errors})].name
    broken = [  # as a coarse step of the Ant's does
        replace(row, mean=math.nan) if row.name == coarse else row
        for row in report.errors
    ]
    report = replace(report, errors=broken)
    assert "diverges" in bench_table(report)
    plot_bench(report, tmp_path / "broken.png")
    assert (tmp_path / "broken.png").exists()


def brief(scene: Scene, **how) -> BenchReport:
    """Two trajectories, two steps, nothing compiled."""
    how = {"num_trajectories": 2, "rounds": 1, "steps": 2, "variants": ()} | how
    return bench(scene, BenchConfig(batches=(2,), **how))


def test_a_third_party_robot_with_a_model_of_ones_own(tmp_path, monkeypatch):
    """An untrained one here: it is slow and wrong, and says so."""
    monkeypatch.setattr(rates, "SAMPLE_SECONDS", 0.01)
    scene = load_scene("dm_control/hopper-stand")
    model = NeRD(scene, FeatureConfig(), NETWORKS["mlp-1x32"]).eval()
    folder = save_checkpoint(model, tmp_path / "hopper", make_card(model))
    report = brief(scene, models=(str(folder),))
    assert {row.name for row in report.errors if row.kind == "learned"} == {str(folder)}
    means = {(row.name, row.quantity): row.mean for row in report.errors}
    for row in report.errors:
        if row.kind == "learned":
            assert row.mean > means[mujoco_name(scene), row.quantity]
    assert report.speeds(2)[str(folder)] > 0.0


def test_a_variant_is_one_more_candidate(monkeypatch):
    monkeypatch.setattr(rates, "SAMPLE_SECONDS", 0.01)
    report = brief(load_scene("cartpole"), variants=("window",))
    rivals = {f"MuJoCo {name}, 1 substep" for name in RIVALS}
    rivals |= {f"MuJoCo {name}, 4 substeps" for name in RIVALS}
    assert set(report.speeds(2)) >= rivals | {"cartpole", "cartpole, window"}


def test_another_number_of_substeps_is_the_same_control_step(name):
    scene = load_scene(name)
    same = scene.with_substeps(scene.substeps)
    task = next(iter(PRESETS[name].protocol.cases.values()))
    start = mid_states(task, 5, 1)
    paths = [open_loop(MujocoDynamics(s), start, 3) for s in (task.scene, same)]
    torch.testing.assert_close(paths[0], paths[1], rtol=0, atol=1e-9)


def test_errors_shrink_with_the_substeps_and_the_ground_truth_has_none(seed):
    """Without contact Euler's error is of first order."""
    chosen = first_set("cartpole", seed, finest, 16, 30)
    rows = by_name(chosen.scene)
    coarse, fine = (
        chosen.errors(rows[f"MuJoCo Euler, {n} substep{s}"].make(chosen.scene))
        for n, s in ((1, ""), (4, "s"))
    )
    assert 3.0 < coarse["hinge"].mean() / fine["hinge"].mean() < 6.0
    again = chosen.errors(finest(chosen.scene))
    assert all(not error.any() for error in again.values())
    itself = Candidate(chosen.solver, "simulator", NoMotion)  # it is not rolled out
    assert all(not error.any() for error in chosen.candidate_errors(itself).values())
    assert list(measure([chosen], [itself])) == [(chosen.solver, GROUND_TRUTH)]


def test_no_motion_has_the_error_of_staying_where_one_is(name, seed):
    chosen = first_set(name, seed, steps=5, count=3)
    stays = chosen.start["qpos"][:, None].expand_as(chosen.ground_truth)
    other = replace(chosen, ground_truth=stays).errors(own(chosen.scene))
    found = chosen.errors(NoMotion(chosen.scene))
    for quantity, error in found.items():
        torch.testing.assert_close(error, other[quantity], atol=1e-9, rtol=0)
    assert any(error.any() for error in found.values())


@pytest.mark.parametrize("robot", ["cartpole", "franka"])
def test_nothing_is_finer_than_the_reference_without_contact(robot, seed):
    """Of the error of the scene's own substeps, finer ones move it by a ten-thousandth."""
    chosen = first_set(robot, seed, finest)
    rk4 = int(mujoco.mjtIntegrator.mjINT_RK4)
    finer = MujocoDynamics(
        chosen.scene.reference.with_substeps(16 * chosen.scene.substeps, rk4)
    )
    coarse = chosen.errors(own(chosen.scene))
    for quantity, error in chosen.errors(finer).items():
        assert error.max() < 1e-4 * coarse[quantity].max()


def test_a_perturbed_start_is_off_by_the_perturbation(seed):
    chosen = first_set("cartpole", seed, count=64, steps=2)
    start = chosen.perturbed(PERTURBATION, seed)
    for error in chosen.errors(own(chosen.scene), start).values():
        assert 0.4 < error.mean() / PERTURBATION < 2.0  # mean of |N(0, 1)| is 0.8


def test_a_rollout_that_diverges_is_not_rolled_out_further(seed):
    """An engine takes minutes over states that are not finite."""
    chosen = first_set("cartpole", seed, count=3, steps=6)
    steps = []

    class Diverging(NoMotion):
        def step(self, state, joint_torque, terrain=None, ctrl=None):
            steps.append(1)
            state = super().step(state, joint_torque, terrain).clone()
            if len(steps) == 3:
                state["qpos"][1] = math.nan
            return state

    errors = chosen.errors(Diverging(chosen.scene))
    assert len(steps) == 3
    for error in errors.values():
        assert error[:, :2].isfinite().all() and error[:, 3:].isnan().all()
    rows = error_rows(chosen.scene, "passive", 6, {("x", "learned"): errors}, {})
    assert "diverges" in error_table(rows)


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


def test_bad_requests_are_refused_in_a_sentence():
    scene = load_scene("cartpole")
    with pytest.raises(ValueError, match="rounds"):
        bench(scene, BenchConfig(rounds=0))
    with pytest.raises(ValueError, match="steps of at least 1, got -5"):
        bench(scene, BenchConfig(steps=-5))
    with pytest.raises(ValueError, match="batches of at least 1, got 0"):
        bench(scene, BenchConfig(batches=()))
    with pytest.raises(ValueError, match="batch 0"):
        bench(scene, BenchConfig(batches=(0,)))
    with pytest.raises(ValueError, match="unknown dynamics 'nowhere'"):
        bench(scene, BenchConfig(models=("nowhere",)))
    with pytest.raises(ValueError, match="unknown variant 'fast'"):
        bench(scene, BenchConfig(variants=("fast",)))
