"""Every hard case runs over every robot, and MuJoCo keeps the lines made for it."""

import json
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
from torchrl_nerd.evaluation.stability.case import Case
from torchrl_nerd.evaluation.stability.cases import CASES
from torchrl_nerd.evaluation.stability.measures import mechanics
from torchrl_nerd.evaluation.stability.run import as_table, choose_cases, run_cases
from torchrl_nerd.evaluation.stability.states import clear_of_ground, settled, starts
from torchrl_nerd.evaluation.stability.world import DynamicsWorld, EnvWorld
from torchrl_nerd.evaluation.traces import energy as traced_energy
from torchrl_nerd.robots import SCENES, load_scene
from torchrl_nerd.scenes import Scene

SCALE = 0.001
QUICK = ("cartpole", "double_pendulum", "franka", "cube")  # others take up to a minute
SLOW = (
    *("adversary", "chaos", "drop", "sliding", "resting", "margin", "horizon"),
    *("stiff_contact", "execution", "slope"),
)
SHORT = [name for name in CASES if name not in SLOW]
INDEPENDENT = (
    *("bad_rows", "rotations", "quaternion_norm", "quaternion_sign"),
    *("altitude", "history", "statistics", "tilt"),
)


def results_of(scene, names, generator):
    truth = DynamicsWorld(MujocoDynamics(scene, num_threads=1))
    learned = DynamicsWorld(NeRDDynamics(random_model(scene, generator)))
    seed = int(torch.randint(1000, (), generator=generator))
    return list(run_cases(truth, learned, choose_cases(names), seed, SCALE))


@pytest.mark.parametrize("name", slow_but(QUICK, SCENES))
def test_the_true_dynamics_keep_their_lines(name, generator):
    scene = load_scene(name)
    results = results_of(scene, SHORT, generator)
    assert {r.case: r.true for r in results if not r.true_passes} == {}
    table = as_table(results)
    for result in results:
        assert result.case in table
        assert set(result.lines) <= set(result.learned)


@pytest.mark.slow
def test_the_true_dynamics_keep_the_lines_of_long_cases(scene, generator):
    results = results_of(scene, list(SLOW), generator)
    assert {r.case: r.true for r in results if not r.true_passes} == {}


def test_what_does_not_depend_on_weights_holds_for_any(scene, generator):
    for result in results_of(scene, list(INDEPENDENT), generator):
        assert result.passes, (result.case, result.learned)


def test_every_seed_has_starts_of_its_own(generator):
    scene, drawn = load_scene("cartpole"), []
    case = Case(
        "made up", "", lambda w, g, _: drawn.append(starts(w.scene, 2, g)) or {}
    )
    world = DynamicsWorld(MujocoDynamics(scene))
    for seed in (0, 1, 1, 2**20):
        list(run_cases(world, world, [case], seed))
    first, other, again, far = (x["qpos"] for x in drawn[::2])
    assert torch.equal(other, again)
    assert not torch.equal(first, other) and not torch.equal(first, far)


def test_a_figure_that_is_no_number_keeps_no_line():
    case = Case("made up", "", lambda *_: {}, lines={"x": 1.0})
    assert case.passes({"x": 1.0}, is_true=False)
    assert not case.passes({"x": 1.1}, is_true=False)
    assert not case.passes({"x": float("nan")}, is_true=False)
    assert case.passes({"x": float("nan")}, is_true=True)  # no line for true dynamics


@pytest.mark.parametrize("dynamics", ["streaming", "mujoco"])
def test_an_env_is_a_world_too(dynamics, generator):
    make = EnvMaker("ant/run", dynamics, generator)
    world = EnvWorld(make(4))
    start = starts(world.scene, 4, generator)
    plain = DynamicsWorld(make(4).dynamics)
    mine, expected = (w.roll(start, 3) for w in (world, plain))
    torch.testing.assert_close(mine["qpos"], expected["qpos"], atol=1e-9, rtol=1e-9)
    few = world.roll(start[:3], 3)  # rows that are left over do not show
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
def test_cases_run_over_any_env_that_shows_qpos_and_qvel(name, generator):
    scene = load_scene(name)
    worlds = [
        DynamicsWorld(MujocoDynamics(scene, num_threads=1)),
        EnvWorld(Foreign(scene, 8), scene, is_true=True),
    ]
    results = list(run_cases(*worlds, choose_cases(SHORT), scale=SCALE))
    assert len(results) > 3
    for result in results:
        assert not CASES[result.case].needs_dynamics
        assert result.learned == pytest.approx(result.true, abs=1e-9, nan_ok=True)


def test_momentum_and_energy_are_those_of_a_falling_cube(generator):
    make = EnvMaker("cube/toss", "mujoco", generator)
    scene = make.task.scene
    start = clear_of_ground(scene, starts(scene, 3, generator))
    found = mechanics(scene, start)
    mass = scene.model.body_mass[1]
    qvel, height = start["qvel"].numpy(), start["qpos"][:, 2].numpy()
    momentum = mass * qvel[:, :3]
    assert abs(found["momentum"] - momentum).max() < 1e-9
    spin = scene.model.body_inertia[1][0] * qvel[:, 3:]
    energy = 0.5 * (momentum * qvel[:, :3]).sum(1) + 0.5 * (spin * qvel[:, 3:]).sum(1)
    energy -= mass * scene.model.opt.gravity[2] * height
    found = traced_energy(scene, start["qpos"], start["qvel"]).numpy()
    assert abs(found - energy).max() < 1e-9 * abs(energy).max()


def test_a_robot_that_never_rests_is_named():
    with pytest.raises(ValueError, match="'cartpole' did in none of 16"):
        settled(load_scene("cartpole"), 1)


def test_the_command_writes_table_json_and_plot(tmp_path, capsys):
    out, plot = tmp_path / "s.json", tmp_path / "s.png"
    arguments = ["cartpole", "--cases", "history", "batching", "--scale", "0.01"]
    assert main(["stability", *arguments, "--json", str(out), "--plot", str(plot)]) == 0
    shown = capsys.readouterr().out
    assert "| history |" in shown and "| batching |" in shown
    named = {"scene", "seed", "scale", "history", "batching"}
    assert named <= set(json.loads(out.read_text()))
    assert plot.stat().st_size > 1000


def test_figures_outlive_an_interruption(tmp_path, monkeypatch):
    out, run = tmp_path / "s.json", CASES["batching"].run

    def interrupted(*arguments):
        assert "history" in json.loads(out.read_text())
        assert run(*arguments)
        raise KeyboardInterrupt

    broken = replace(CASES["batching"], run=interrupted)
    monkeypatch.setitem(CASES, "batching", broken)
    arguments = ["cartpole", "--cases", "history", "batching", "--scale", "0.01"]
    assert main(["stability", *arguments, "--json", str(out)]) == INTERRUPTED
    written = json.loads(out.read_text())
    assert written["configuration"]["scene"] == written["scene"] == "cartpole"
    assert "history" in written and "batching" not in written


def test_bad_settings_are_named(capsys):
    assert main(["stability", "cartpole", "--cases", "luck"]) == 2
    assert "unknown case 'luck'" in capsys.readouterr().err
    assert main(["stability", "cartpole", "--scale", "0"]) == 2
    assert "expected a scale in (0, 1], got 0.0" in capsys.readouterr().err
