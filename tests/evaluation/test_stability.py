"""Every hard case runs on every robot, and MuJoCo is within its tolerances."""

from dataclasses import replace

import pytest
import torch
from dynamics_helpers import EnvMaker, random_model
from helpers import slow_but
from tensordict import TensorDictBase
from torchrl.data import Composite, Unbounded
from torchrl.envs import EnvBase

from torchrl_nerd.cli.main import INTERRUPTED, main
from torchrl_nerd.dynamics import MujocoDynamics, NeRDDynamics
from torchrl_nerd.evaluation.results import read_results
from torchrl_nerd.evaluation.stability.case import Case
from torchrl_nerd.evaluation.stability.cases import CASES
from torchrl_nerd.evaluation.stability.run import as_table, choose_cases, run_cases
from torchrl_nerd.evaluation.stability.states import (
    clear_of_ground,
    sample_states,
    settled_states,
)
from torchrl_nerd.evaluation.stability.stepper import DynamicsStepper, EnvStepper
from torchrl_nerd.evaluation.traces import mechanics
from torchrl_nerd.robots import SCENES, load_scene
from torchrl_nerd.scenes import Scene

SCALE = 0.001
QUICK = ("cartpole", "double_pendulum", "franka", "cube")  # others take up to a minute
SLOW = ("drop", "sliding", "resting", "horizon", "slope")
SHORT = [name for name in CASES if name not in SLOW]
INDEPENDENT = ("invalid_inputs", "quaternion_sign", "altitude", "tilt")


def results_of(scene, names, generator):
    ground_truth = DynamicsStepper(MujocoDynamics(scene, num_threads=1))
    tested = DynamicsStepper(NeRDDynamics(random_model(scene, generator)))
    seed = int(torch.randint(1000, (), generator=generator))
    return list(run_cases(ground_truth, tested, choose_cases(names), seed, SCALE))


def failures(results):
    """Metrics of the cases that MuJoCo itself fails."""
    return {r.case: r.ground_truth for r in results if not r.ground_truth_passes}


@pytest.mark.parametrize("name", slow_but(QUICK, SCENES))
def test_mujoco_passes(name, generator):
    scene = load_scene(name)
    results = results_of(scene, SHORT, generator)
    assert failures(results) == {}
    table = as_table(results)
    for result in results:
        assert result.case in table
        assert set(result.tolerances) <= set(result.tested)


@pytest.mark.slow
def test_mujoco_passes_long_cases(scene, generator):
    results = results_of(scene, list(SLOW), generator)
    assert failures(results) == {}


def test_what_does_not_depend_on_weights_holds_for_any(scene, generator):
    for result in results_of(scene, list(INDEPENDENT), generator):
        assert result.passes, (result.case, result.tested)


def test_every_seed_has_starts_of_its_own(generator):
    scene, drawn = load_scene("cartpole"), []
    case = Case("made up", "", lambda trial: drawn.append(trial.starts(2)) or {})
    stepper = DynamicsStepper(MujocoDynamics(scene))
    for seed in (0, 1, 1, 2**20):
        list(run_cases(stepper, stepper, [case], seed))
    first, other, again, far = (x["qpos"] for x in drawn[::2])
    assert torch.equal(other, again)
    assert not torch.equal(first, other) and not torch.equal(first, far)


def test_a_metric_that_is_nan_fails():
    case = Case("made up", "", lambda _: {}, tolerances={"x": 1.0})
    assert case.passes({"x": 1.0}, is_ground_truth=False)
    assert not case.passes({"x": 1.1}, is_ground_truth=False)
    assert not case.passes({"x": float("nan")}, is_ground_truth=False)
    assert case.passes({"x": float("nan")}, is_ground_truth=True)  # without a tolerance


@pytest.mark.parametrize("dynamics", ["streaming", "mujoco"])
def test_an_env_is_stepped_like_dynamics(dynamics, generator):
    make = EnvMaker("ant/run", dynamics, generator)
    stepper = EnvStepper(make(4))
    start = sample_states(stepper.scene, 4, generator)
    plain = DynamicsStepper(make(4).dynamics)
    mine, expected = (s.roll(start, 3) for s in (stepper, plain))
    torch.testing.assert_close(mine["qpos"], expected["qpos"], atol=1e-9, rtol=1e-9)
    few = stepper.roll(start[:3], 3)  # envs that are left over do not show
    torch.testing.assert_close(few["qpos"], mine["qpos"][:3])


class Foreign(EnvBase):
    """A scene in an env that is none of this package's: qpos, qvel and an action."""

    _supports_set_state = True

    def __init__(self, scene: Scene, rows: int) -> None:
        super().__init__(batch_size=[rows])
        self.dynamics = MujocoDynamics(scene, num_threads=1)
        self.high = torch.tensor(scene.sampling.torque, dtype=torch.float64)
        model = scene.model

        def numbers(size: int) -> Unbounded:
            return Unbounded((rows, size), dtype=torch.float64)

        sizes = {"qpos": model.nq, "qvel": model.nv}
        self.observation_spec = Composite(
            {key: numbers(size) for key, size in sizes.items()}, shape=[rows]
        )
        self.action_spec = numbers(len(self.high))
        self.reward_spec = numbers(1)

    def _reset(self, tensordict: TensorDictBase, **kwargs) -> TensorDictBase:
        self.now = tensordict.select("qpos", "qvel").clone()
        self.dynamics.reset(self.now)
        return self.now.clone()

    def _step(self, tensordict: TensorDictBase) -> TensorDictBase:
        self.now = self.dynamics.step(self.now, self.high * tensordict["action"])
        over = torch.zeros(*self.batch_size, 1, dtype=torch.bool)
        return self.now.clone().update({"reward": over.double(), "done": over})

    def _set_seed(self, seed: int | None) -> None:
        """Nothing is drawn."""


@pytest.mark.parametrize("name", ["cartpole", "cube"])
def test_cases_run_on_any_env_with_qpos_and_qvel(name, generator):
    scene = load_scene(name)
    steppers = [
        DynamicsStepper(MujocoDynamics(scene, num_threads=1)),
        EnvStepper(Foreign(scene, 8), scene, is_ground_truth=True),
    ]
    results = list(run_cases(*steppers, choose_cases(SHORT), scale=SCALE))
    assert len(results) > 3
    for result in results:
        assert CASES[result.case].needs == "states"
        assert result.tested == pytest.approx(
            result.ground_truth, abs=1e-9, nan_ok=True
        )


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


def test_the_command_writes_table_json_and_plot(tmp_path, capsys):
    out, plot = tmp_path / "s.json", tmp_path / "s.png"
    arguments = ["cartpole", "--cases", "hinge_turns", "batching", "--scale", "0.01"]
    assert main(["stability", *arguments, "--json", str(out), "--plot", str(plot)]) == 0
    shown = capsys.readouterr().out
    assert "| hinge_turns |" in shown and "| batching |" in shown
    named = {"scene", "seed", "scale", "hinge_turns", "batching"}
    assert named <= set(read_results(out)["results"])
    assert plot.stat().st_size > 1000


def test_results_outlive_an_interruption(tmp_path, monkeypatch):
    out, run = tmp_path / "s.json", CASES["batching"].run

    def interrupted(*arguments):
        assert "hinge_turns" in read_results(out)["results"]
        assert run(*arguments)
        raise KeyboardInterrupt

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
