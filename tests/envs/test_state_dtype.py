"""Envs whose state is float32: the same physics, and no float64 on the device."""

import pytest
import torch
from dynamics_helpers import MODELS, random_actions
from helpers import slow_but
from meta_helpers import META, meta, meta_env  # noqa: F401
from tensordict import TensorDict
from torch import Tensor
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_leaves
from torchrl.envs import TransformedEnv
from torchrl.envs.utils import check_env_specs
from transform_helpers import CLASSES, TASK_OF, make_transform

from torchrl_nerd import NeRDEnv, make_env
from torchrl_nerd.checkpoint import from_pretrained
from torchrl_nerd.dynamics import ENGINES
from torchrl_nerd.geometry.constants import cast_constants
from torchrl_nerd.robots import TASKS, load_scene
from torchrl_nerd.settings import expect_device
from torchrl_nerd.tasks import SceneTask

STEPS, ROWS = 5, 8
DYNAMICS = ("nerd", "analytic", "mujoco")
QUICK = {("ant/run", "nerd"), ("franka/reach_osc", "mujoco"), ("cube/toss", "analytic")}
CASES = [(task, dynamics) for task in TASKS for dynamics in DYNAMICS]
WITHOUT_FLOAT64 = [x for x in TASKS if x != "franka/reach_osc"]  # its chain needs it
ON_DEVICE = [(task, kind) for task in WITHOUT_FLOAT64 for kind in MODELS]
QUICK_ON_DEVICE = {("ant/run", "streaming"), ("double_pendulum/passive", "hybrid")}


@pytest.mark.parametrize(("task", "dynamics"), slow_but(QUICK, CASES))
def test_it_steps_as_in_float64(task, dynamics, generator):
    """To rounding, which an impact multiplies."""
    envs = [
        make_env(task, dynamics, ROWS, seed=0, state_dtype=dtype)
        for dtype in (torch.float64, torch.float32)
    ]
    found = [env.reset() for env in envs]
    for action in random_actions(envs[0], STEPS, generator):
        found = [
            env.step(now.set("action", action))["next"]
            for env, now in zip(envs, found, strict=True)
        ]
    fine, coarse = (x["qpos"] for x in found)
    assert not any(x.dtype == torch.float64 for x in found[1].values())
    torch.testing.assert_close(coarse.double(), fine, rtol=0.0, atol=2e-3)
    if dynamics not in ENGINES:
        check_env_specs(make_env(task, dynamics, 2, state_dtype=torch.float32))


def test_suite_tasks_hand_out_float32():
    """Theirs are float64 numbers of NumPy."""
    how = {"num_envs": 2, "state_dtype": torch.float32}
    env = make_env("dm_control/cartpole-swingup", "dm_control", **how)
    check_env_specs(env)
    assert env.rollout(2)["qpos"].dtype == torch.float32


@pytest.mark.parametrize("name", [*CLASSES])
def test_transforms_take_float32_states(name):
    """Their features are those of the same states in float64."""
    for scene in ("ant", "cube_slope"):
        env = make_env(TASK_OF[scene], "mujoco", ROWS, 0, state_dtype=torch.float32)
        env = TransformedEnv(env, make_transform(name, scene))
        check_env_specs(env)
        path = env.rollout(STEPS, break_when_any_done=False)
        fine = path.apply(lambda x: x.double() if x.dtype == torch.float32 else x)
        fine = make_transform(name, scene)(fine.exclude(*env.transform.out_keys))
        shown = path["next"] if name == "StateDelta" else path
        for key in env.transform.out_keys:
            want = fine[key].float()
            torch.testing.assert_close(shown[key], want, rtol=0.0, atol=1e-4)


class _NoFloat64(TorchDispatchMode):
    """Refuses float64 on the device, which some devices do not have."""

    def __torch_dispatch__(self, func, types, args=(), kwargs=None):
        result = func(*args, **(kwargs or {}))
        for x in tree_leaves(result):
            if isinstance(x, Tensor) and x.device == META:
                assert x.dtype != torch.float64, func.name()
        return result


@pytest.mark.parametrize(("task", "kind"), slow_but(QUICK_ON_DEVICE, ON_DEVICE))
def test_there_is_no_float64_on_the_device(task, kind, meta, generator):  # noqa: F811
    env = meta_env(task, kind, ROWS, generator, torch.float32)
    with _NoFloat64():
        now = env._reset()
        action = torch.empty(env.action_spec.shape, device=META)
        now = env._step(now.set("action", action))
        flags = torch.empty(ROWS, 1, dtype=torch.bool, device=META)
        env._reset(now.set("_reset", flags))


def test_a_state_that_is_set_is_rounded():
    env = make_env("cartpole/swingup", num_envs=1, state_dtype=torch.float32)
    third = torch.full((1, 2), 1.0 / 3.0, dtype=torch.float64)
    given = TensorDict({"qpos": third, "qvel": third}, [1])
    state = env.reset(given, set_state=True)
    assert torch.equal(state["qvel"], third.float())


def test_the_model_that_was_given_stays_as_it_is():
    model = from_pretrained("cartpole")
    before = {k: v.clone() for k, v in model.state_dict().items()}
    env = NeRDEnv("cartpole/swingup", model, state_dtype=torch.float32)
    env.rollout(2)
    after = model.state_dict()
    assert all(
        v.dtype == after[k].dtype and v.equal(after[k]) for k, v in before.items()
    )


def test_bounds_beyond_float32_stay_finite():
    module = torch.nn.Module()
    module.register_buffer("bound", torch.tensor([-1e300, 0.5, 1e300]).double())
    bound = cast_constants(module, torch.float32).get_buffer("bound")
    assert bound.dtype == torch.float32 and bound.isfinite().all() and bound[1] == 0.5


def test_another_precision_is_refused():
    with pytest.raises(
        ValueError, match=r"float32 or torch\.float64, got torch\.int64"
    ):
        make_env("cartpole/swingup", state_dtype=torch.int64)


@pytest.mark.parametrize("device", ["cpu:0", torch.device("cpu", 0)])
def test_there_is_one_cpu(device):
    env = make_env("cartpole/swingup", device=device)
    assert env.device == torch.device("cpu")
    for name in ("cpu:1", "cuda:cpu:0"):
        with pytest.raises(ValueError, match=f"that torch finds here .*, got '{name}'"):
            expect_device(name)


def test_a_device_without_float64_takes_float32_alone(monkeypatch):
    monkeypatch.setattr(torch.backends.mps, "is_available", lambda: True)
    assert expect_device("mps", torch.float32) == torch.device("mps")
    with pytest.raises(ValueError, match=r"that torch finds here .*, got 'mps'"):
        expect_device("mps")


class OwnVelocity(SceneTask):
    """Hands out views of the state."""

    def __init__(self, scene):
        super().__init__(scene)
        self.observation_size = scene.model.nv

    def observation(self, state):
        return state["qvel"]

    def reward(self, state, action, next_state):
        return next_state["qvel"][..., 0]


@pytest.mark.parametrize("dynamics", ["mujoco", "nerd"])
def test_nothing_handed_out_is_the_envs_own_memory(dynamics):
    task = OwnVelocity(load_scene("cartpole"))
    env = make_env(task, dynamics, ROWS, seed=0, state_dtype=torch.float32)
    found = env.reset()
    for shown in (found, env.rand_step(found)["next"]):
        kept = env.state.clone()
        for key in {"observation", "reward", "qpos", "qvel"} & {*shown.keys()}:
            shown[key].fill_(9.0)
        assert (env.state == kept).all()


def test_a_state_that_float32_cannot_hold_is_refused():
    env = make_env("cartpole/swingup", "nerd", 2, seed=0, state_dtype=torch.float32)
    given = env.reset().select("qpos", "qvel").double()
    given["qvel"][0] = 1e39
    with pytest.raises(ValueError, match="expected finite qvel"):
        env.reset(given, set_state=True)
