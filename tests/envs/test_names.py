"""Names and options of `make_env`: what they mean, and refusals in one sentence."""

from pathlib import Path

import pytest
import torch
from dynamics_helpers import random_model

from torchrl_nerd import GroundTruthEnv, NeRDEnv, from_pretrained, load_scene, make_env
from torchrl_nerd.dynamics import ENGINES
from torchrl_nerd.robots import TASKS, make_task
from torchrl_nerd.scenes import Scene
from torchrl_nerd.scenes.controllers import PDController, TorqueController
from torchrl_nerd.tasks import SceneTask

TASK = "ant/run"
HANGING = """<mujoco><worldbody><body><joint axis="0 1 0" range="-90 90" limited="true"/>
<geom type="capsule" fromto="0 0 0 0 0 -1" size="0.05" contype="0" conaffinity="0"/>
</body></worldbody></mujoco>"""


def refusal(make) -> str:
    with pytest.raises(ValueError) as caught:
        make()
    assert "\n" not in str(caught.value)
    return str(caught.value)


@pytest.mark.parametrize("dynamics", ["nerd", "analytic", "mujoco", "dm_control"])
@pytest.mark.parametrize("device", ["cuda:99", "meta", "gpu"])
def test_a_device_that_is_not_here_is_refused(dynamics, device):
    said = refusal(lambda: make_env(TASK, dynamics, device=device))
    assert "expected a device that torch finds here (cpu" in said
    assert f"got '{device}'" in said


@pytest.mark.parametrize("dynamics", [None, 5, ["nerd"]])
def test_dynamics_without_a_name_are_refused(dynamics):
    said = refusal(lambda: make_env(TASK, dynamics))
    assert "expected dynamics of nerd, hybrid" in said and f"got {dynamics!r}" in said


def test_a_refusal_lists_all_that_there_is():
    said = refusal(lambda: make_env(TASK, "newton"))
    assert all(name in said for name in ("nerd", "hybrid", "analytic", *ENGINES))
    assert "unconstrained" in said and "ant-mlp" in said


def test_a_step_that_knows_no_ground_is_refused_on_one():
    cube = load_scene("cube")
    assert "falls through" in refusal(lambda: make_env(cube, "unconstrained"))
    said = refusal(lambda: make_env("ant/run", "unconstrained"))
    assert "a floating base with them in scene 'ant'" in said
    assert make_env("cartpole/swingup", "unconstrained").dynamics.kind == "analytic"


@pytest.mark.parametrize("name", ["hybrid", "analytic", "penalty-contact", "nerd"])
def test_a_model_of_a_scene_needs_one(name):
    said = refusal(lambda: from_pretrained(name))
    assert said.startswith(f"expected a scene beside '{name}'")
    assert "did you mean 'nerd'" in refusal(lambda: make_env(TASK, "learned"))


def test_a_folder_that_is_not_there_is_told_apart_from_a_name(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    said = refusal(lambda: make_env(TASK, "runs/ant/best"))
    assert said == "expected a checkpoint folder, found no folder runs/ant/best"
    for name in ("ant", "bar", "cube", "door", "eye", "fan"):
        folder = Path("runs", name, "last")
        folder.mkdir(parents=True)
        (folder / "card.json").write_text("{}")
    said = refusal(lambda: make_env(TASK, Path("runs/ant/best")))
    listed = ", ".join(f"runs/{x}/last" for x in ("ant", "bar", "cube", "door", "eye"))
    assert said.endswith(f"found no folder runs/ant/best, but checkpoints in {listed}")
    for odd in ("runs/a\0/b", f"{'x' * 300}/best/b", "\0/x/y"):
        assert "found no folder" in refusal(lambda odd=odd: make_env(TASK, odd))


def test_a_scene_stands_for_its_learned_model_as_it_does_in_from_pretrained():
    task, scene = "cube_slope/toss", "cube_slope"
    env, expected = make_env(task, scene), from_pretrained(scene).state_dict()
    weights = env.dynamics.model.state_dict()
    assert env.model_name == make_env(task, "nerd").model_name == "cube_slope-mlp"
    assert make_env(TASK, "nerd").model_name == "ant"
    assert all(weights[key].equal(value) for key, value in expected.items())


FILE = """<mujoco><worldbody><body><joint axis="0 1 0" {}/><geom size="0.1"/></body>
  </worldbody></mujoco>"""


@pytest.mark.parametrize("dynamics", ["nerd", "hybrid"])
@pytest.mark.parametrize("friction", ["", 'frictionloss="1"'])
def test_a_file_without_a_model_is_told_what_is_possible(friction, dynamics, tmp_path):
    """A hybrid needs an analytic step, and no analytic step knows dry friction."""
    path = tmp_path / "robot.xml"
    path.write_text(FILE.format(friction))
    said = refusal(lambda: make_env(path, dynamics))
    is_possible = dynamics == "hybrid" and not friction
    assert (
        f"no {'learned' if dynamics == 'nerd' else 'hybrid'} model of '{path}'" in said
    )
    assert f"`nerd data {path}`" in said and f"`nerd train {path}" in said
    assert ("--kind hybrid --step STEP" in said) == is_possible
    assert ("STEP being unconstrained" in said) == is_possible
    assert ("-hybrid/best" in said) == is_possible
    is_impossible = dynamics == "hybrid" and bool(friction)
    assert ("with dry friction): make a learned one" in said) == is_impossible
    if is_possible:
        words = said.partition("STEP being ")[2].partition(", with")[0].split(" or ")
        for step in words:
            assert make_env(path, step).dynamics.kind == "analytic"


@pytest.mark.parametrize("dynamics", ["mujoco", "dm_control", "analytic"])
@pytest.mark.parametrize("guard", ["flag", "nonsense"])
def test_a_guard_of_dynamics_without_a_network_is_refused(dynamics, guard):
    said = refusal(lambda: make_env(TASK, dynamics, guard=guard))
    assert f"learned or hybrid dynamics for guard '{guard}', got '{dynamics}'" in said


@pytest.mark.parametrize("inference", ["window", "bogus"])
def test_an_analytic_step_has_no_inference(inference):
    said = refusal(lambda: NeRDEnv(TASK, "analytic", inference=inference))
    assert f"dynamics for inference '{inference}', got 'analytic'" in said


def test_an_engine_is_no_model_and_a_model_is_no_engine():
    assert "got the engine 'mujoco'" in refusal(lambda: NeRDEnv(TASK, "mujoco"))
    assert "unknown engine 'nerd'" in refusal(lambda: GroundTruthEnv(TASK, "nerd"))


def test_a_model_of_another_robot_is_called_by_its_name():
    said = refusal(lambda: make_env(TASK, "cartpole-mlp"))
    assert said == "the model 'cartpole-mlp' is for robot 'cartpole', expected 'ant'"


@pytest.mark.parametrize(
    ("dynamics", "expected"),
    [
        ("nerd", "dynamics=NeRDDynamics, kind='learned', model='ant'"),
        ("analytic", "dynamics=AnalyticDynamics, kind='analytic', model='analytic'"),
        ("mujoco", "dynamics=MujocoDynamics, kind='ground truth'"),
    ],
)
def test_an_env_says_what_it_is(dynamics, expected):
    said = repr(make_env(TASK, dynamics, num_envs=3))
    assert f"(task='ant/run', {expected}, num_envs=3, device='cpu')" in said


def test_an_env_of_ones_own_says_what_it_is(generator):
    class Walk(type(make_task(TASK))):
        """A task without an id."""

    task = Walk()
    said = repr(NeRDEnv(task, random_model(task.scene, generator)))
    assert "task='Walk'" in said and "model='NeRD'" in said
    assert "task='dm_control/pendulum-swingup'" in repr(
        make_env("dm_control/pendulum-swingup", "mujoco")
    )


@pytest.mark.parametrize("task", [None, 5, Path("robot")])
@pytest.mark.parametrize("dynamics", ["analytic", "mujoco"])
def test_what_is_no_task_is_refused(task, dynamics):
    said = refusal(lambda: make_env(task, dynamics))
    shown = str(task) if isinstance(task, Path) else task
    assert f"unknown task {shown!r}, expected one of" in said


@pytest.mark.parametrize("name", TASKS)
def test_a_scene_given_for_a_task_and_the_reverse_is_told_what_was_meant(name):
    scene = name.partition("/")[0]
    with pytest.raises(ValueError, match=rf"did you mean '{scene}/\w+'\?"):
        make_env(scene, num_envs=1)
    with pytest.raises(ValueError, match=rf"did you mean '{scene}'\?"):
        load_scene(name)


def test_a_misspelt_name_is_told_the_nearest():
    with pytest.raises(ValueError, match=r"did you mean 'cartpole/swingup'\?"):
        make_env("cartpole/swing_up")
    with pytest.raises(ValueError, match=r"unknown scene 'xyz', expected"):
        load_scene("xyz")


@pytest.mark.parametrize("dynamics", ["analytic", "mujoco"])
@pytest.mark.parametrize("num_envs", [1.5, "2", None, 0, -1, True])
def test_the_number_of_envs_is_a_number(dynamics, num_envs):
    said = refusal(lambda: make_env("cartpole/swingup", dynamics, num_envs))
    assert said == f"expected num_envs, a whole number of at least 1, got {num_envs!r}"


@pytest.mark.parametrize("seed", ["a", 1.5, -1, 2**63])
def test_so_is_a_seed(seed):
    said = refusal(lambda: make_env("cartpole/swingup", "analytic", seed=seed))
    assert said == f"expected a seed from 0 to {2**63 - 1}, got {seed!r}"


@pytest.mark.parametrize("what", ["reward", "terminated"])
def test_a_task_says_one_thing_of_each_env(what):
    kind = type(make_task("cartpole/swingup"))
    once = getattr(kind, what)

    def twice(self, *args):
        return once(self, *args)[:, None]

    task = type("Mine", (kind,), {what: twice})()
    env = make_env(task, "analytic", num_envs=3)
    said = refusal(lambda: env.rollout(1))
    assert said == f"expected {what} of shape (3,) from Mine, got (3, 1)"


def test_a_robot_is_named_by_a_path_as_by_its_text(tmp_path):
    path = tmp_path / "rod.xml"
    path.write_text(HANGING)
    for name in (path, str(path)):
        assert load_scene(name).model.nq == make_env(name, "mujoco").scene.model.nq == 1


SWINGUP = type(make_task("cartpole/swingup"))


class Wide(SWINGUP):
    observation_size = 5


class Flat(SWINGUP):
    def observation(self, state):
        return state["qpos"][..., 0]


class Narrow(SWINGUP):
    def initial_state(self, u):
        return {"qpos": u[..., :1], "qvel": torch.zeros_like(u[..., :2])}


class Still(SWINGUP):
    def initial_state(self, u):
        return {"qpos": u[..., :2]}


@pytest.mark.parametrize(
    ("task", "said"),
    {
        Wide: "expected observation of shape (3, 5) from Wide, got (3, 4)",
        Flat: "expected observation of shape (3, 4) from Flat, got (3,)",
        Narrow: "expected initial qpos of shape (3, 2) from Narrow, got (3, 1)",
        Still: "expected qvel from initial_state of Still, got ['qpos']",
    }.items(),
)
def test_what_a_task_gives_has_the_shape_of_its_specs(task, said):
    with pytest.raises(ValueError) as refused:
        make_env(task(), "mujoco", num_envs=3, seed=0).reset()
    assert str(refused.value) == said


class Springs(SceneTask):
    @property
    def controller(self):
        joints = (
            tuple(range(7, 15)),
            tuple(range(6, 14)),
        )  # the motors' order is another
        return PDController(*joints, kp=(50.0,) * 8, kd=(0.0,) * 8, scale=(0.5,) * 8)


def test_a_controller_drives_the_motors_in_their_order():
    task = Springs(Scene.from_gymnasium("Ant-v5"))
    with pytest.raises(
        ValueError, match=r"dofs \(12, 13, 6, .* got one of dofs \(6, 7"
    ):
        make_env(task, "mujoco")


class Torques(type(make_task("dm_control/walker-run"))):
    @property
    def controller(self):
        return TorqueController((100.0,) * 6)


def test_a_reward_of_controls_needs_the_robots_own_actuators():
    with pytest.raises(ValueError, match="own actuators.*got a TorqueController"):
        make_env(Torques("dm_control/walker-run"), "mujoco", num_envs=2).rollout(2)
