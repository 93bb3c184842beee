"""Every hard case runs on every robot, and MuJoCo is within its tolerances."""

from dataclasses import replace

import pytest
import torch
from dynamics_helpers import EnvMaker, random_model
from helpers import make_scene, slow_but

from torchrl_nerd.cli.main import INTERRUPTED, main
from torchrl_nerd.dynamics import MujocoDynamics, NeRDDynamics
from torchrl_nerd.evaluation.results import read_results
from torchrl_nerd.evaluation.stability.case import Case, Metric, as_table, run_cases
from torchrl_nerd.evaluation.stability.cases import CASES
from torchrl_nerd.evaluation.stability.states import (
    clear_of_ground,
    mechanics,
    sample_states,
    settled_states,
)
from torchrl_nerd.robots import SCENES, load_scene

SCALE = 0.001
COVER = ("cube", "cartpole", "double_pendulum", "franka")
SLOW = ("drop", "sliding", "resting", "horizon")
SHORT = [name for name in CASES if name not in SLOW]
INDEPENDENT = ("invalid_inputs", "quaternion_sign", "altitude")
ONCE: dict[str, list[str]] = {}
"""Every short case, by the first robot of `COVER` that it applies to."""
for _case in SHORT:
    _fitting = (name for name in COVER if CASES[_case].applies(load_scene(name)))
    ONCE.setdefault(next(_fitting), []).append(_case)


def results_of(scene, names, generator):
    tested = NeRDDynamics(random_model(scene, generator))
    seed = int(torch.randint(1000, (), generator=generator))
    return list(run_cases(tested, [CASES[name] for name in names], seed, SCALE))


def failures(results):
    """Metrics of the cases that MuJoCo itself fails."""
    return {r.case: r.ground_truth for r in results if not r.ground_truth_passes}


@pytest.mark.parametrize(
    ("name", "cases"),
    [
        *((name, tuple(cases)) for name, cases in ONCE.items()),
        *(pytest.param(name, SHORT, marks=pytest.mark.slow) for name in SCENES),
    ],
)
def test_mujoco_passes(name, cases, generator):
    scene = load_scene(name)
    results = results_of(scene, cases, generator)
    assert failures(results) == {}
    table = as_table(results)
    if name in ONCE:
        assert {result.case for result in results} >= set(ONCE[name])
    for result in results:
        assert result.case in table
        assert set(result.tolerances) <= set(result.tested)


@pytest.mark.slow
def test_mujoco_passes_long_cases(scene, generator):
    results = results_of(scene, list(SLOW), generator)
    assert failures(results) == {}


@pytest.mark.parametrize("name", slow_but(COVER[:2], SCENES))
def test_what_does_not_depend_on_weights_holds_for_any(name, generator):
    scene = load_scene(name)
    for result in results_of(scene, list(INDEPENDENT), generator):
        assert result.passes, (result.case, result.tested)


def test_joint_limits_are_tried_where_there_are_some(scene):
    has_limits = bool(scene.model.jnt_limited.any() and len(scene.actuated))
    assert CASES["joint_limits"].applies(scene) == has_limits


def test_every_seed_has_starts_of_its_own(generator):
    scene, drawn = load_scene("cartpole"), []
    case = Case(lambda trial: drawn.append(trial.starts(2)) or iter(()))
    for seed in (0, 1, 1, 2**20):
        list(run_cases(MujocoDynamics(scene), [case], seed))
    first, other, again, far = (x["qpos"] for x in drawn[::2])
    assert torch.equal(other, again)
    assert not torch.equal(first, other) and not torch.equal(first, far)


def test_a_case_that_cannot_be_measured_does_not_end_the_others():
    def restless(trial):
        """It rests."""
        raise ValueError("expected a robot that comes to rest, it did not")

    calm = Case(lambda _: iter([Metric("x", 0.5, 1.0)]))
    dynamics = MujocoDynamics(load_scene("cartpole"))
    skipped, result = run_cases(dynamics, [Case(restless), calm])
    assert skipped.skipped == "expected a robot that comes to rest, it did not"
    assert skipped.tested == skipped.ground_truth == {} and not result.skipped
    assert "restless" not in as_table([skipped, result]) and result.passes


FLOATING = """<mujoco><worldbody><body><freejoint/><geom size="0.1"/></body>
</worldbody></mujoco>"""


@pytest.mark.parametrize("name", ["drop", "resting", "sliding"])
def test_what_lands_needs_a_ground(name):
    cube = load_scene("cube")
    assert CASES[name].applies(cube)
    assert not CASES[name].applies(make_scene(FLOATING))
    assert not CASES[name].applies(load_scene("cartpole"))


@pytest.mark.parametrize("value", [1.0, 1.1, float("nan"), float("inf")])
@pytest.mark.parametrize("limit", [1.0, float("inf")])
@pytest.mark.parametrize("mujoco_limit", [None, 1.05, float("inf")])
def test_a_metric_beyond_its_limit_fails(value, limit, mujoco_limit):
    """NaN is beyond every limit; an infinite limit is none."""
    case = Case(lambda _: iter([Metric("x", value, limit, mujoco_limit)]))
    (result,) = run_cases(MujocoDynamics(load_scene("cartpole")), [case])
    assert result.passes == (value == 1.0 or limit > 1.0)
    exact = limit if mujoco_limit is None else mujoco_limit
    assert result.ground_truth_passes == (value == 1.0 or exact > 1.1)
    assert result.tolerances == ({"x": 1.0} if limit == 1.0 else {})
    assert set(result.tested) == {"x"} == set(result.ground_truth)


class Pumped(MujocoDynamics):
    """MuJoCo that gains speed at every step."""

    def step(self, *given, **how):
        after = super().step(*given, **how)
        return after.set("qvel", 1.001 * after["qvel"])


@pytest.mark.parametrize(("kind", "passes"), [(MujocoDynamics, True), (Pumped, False)])
def test_energy_need_not_be_kept_better_than_by_mujoco(kind, passes):
    """Euler changes that of the double pendulum by hundredths in 100 steps."""
    dynamics = kind(load_scene("double_pendulum"))
    (result,) = run_cases(dynamics, [CASES["energy"]], scale=0.01)
    drift, limit = (next(iter(x.values())) for x in (result.tested, result.tolerances))
    assert result.ground_truth_passes and result.passes == passes
    assert 0.005 < limit - 0.005 < 0.1 and (drift <= limit) == passes


def test_momentum_and_energy_are_those_of_a_falling_cube(generator):
    make = EnvMaker("cube/toss", "mujoco", generator)
    scene = make.task.scene
    start = clear_of_ground(scene, sample_states(scene, 3, generator))
    found = mechanics(scene, start)
    mass = scene.model.body_mass[1]
    qvel, height = start["qvel"], start["qpos"][:, 2]
    momentum = mass * qvel[:, :3]
    assert (found["momentum"] - momentum).abs().max() < 1e-9
    spin = scene.model.body_inertia[1][0] * qvel[:, 3:]
    energy = 0.5 * (momentum * qvel[:, :3]).sum(1) + 0.5 * (spin * qvel[:, 3:]).sum(1)
    energy -= mass * scene.model.opt.gravity[2] * height
    assert (found["energy"] - energy).abs().max() < 1e-9 * energy.abs().max()


def test_a_robot_that_never_rests_is_named():
    with pytest.raises(ValueError, match="'cartpole' did in none of 16"):
        settled_states(load_scene("cartpole"), 1)


def test_the_command_writes_table_and_json(tmp_path, capsys):
    out = tmp_path / "s.json"
    arguments = ["cartpole", "--cases", "hinge_turns", "batching", "--scale", "0.01"]
    assert main(["stability", *arguments, "--json", str(out)]) == 0
    shown = capsys.readouterr().out
    assert "| hinge_turns |" in shown and "| batching |" in shown
    named = {"scene", "seed", "scale", "hinge_turns", "batching"}
    found = read_results(out)["results"]
    assert named <= set(found)
    assert (found["model"], found["kind"]) == ("cartpole", "learned")


def test_results_outlive_an_interruption(tmp_path, monkeypatch):
    out, run = tmp_path / "s.json", CASES["batching"].run

    def interrupted(*arguments):
        assert "hinge_turns" in read_results(out)["results"]
        assert list(run(*arguments))
        raise KeyboardInterrupt

    interrupted.__name__ = "batching"
    broken = replace(CASES["batching"], run=interrupted)
    monkeypatch.setitem(CASES, "batching", broken)
    arguments = ["cartpole", "--cases", "hinge_turns", "batching", "--scale", "0.01"]
    assert main(["stability", *arguments, "--json", str(out)]) == INTERRUPTED
    record = read_results(out)
    written = record["results"]
    assert written["scene"] == "cartpole" and "stability cartpole" in record["command"]
    assert "hinge_turns" in written and "batching" not in written


def test_bad_settings_are_named(capsys):
    assert main(["stability", "cartpole", "--cases", "luck"]) == 2
    assert "unknown case 'luck'" in capsys.readouterr().err
    assert main(["stability", "cartpole", "--scale", "0"]) == 2
    assert "expected a scale in (0, 1], got 0.0" in capsys.readouterr().err


@pytest.mark.parametrize("integrator", ["Euler", "RK4"])
def test_a_fall_is_that_of_the_robots_integrator(integrator):
    body = '<body pos="0 0 9"><freejoint/><geom size="0.1"/></body>'
    how = f'<option timestep="0.01" integrator="{integrator}"/>'
    floor = '<geom type="plane" size="0 0 1"/>'
    scene = make_scene(f"<mujoco>{how}<worldbody>{floor}{body}</worldbody></mujoco>")
    found = list(run_cases(MujocoDynamics(scene), [CASES["free_fall"]], 0))
    values = list(found[0].ground_truth.values())
    assert values and max(values) < 1e-4
