"""A step and a reset ask nothing of the host, in no task and in no kind of dynamics.

What TorchRL itself asks is not tested here: whether any env is done, in
`step_and_maybe_reset` and its collectors.
"""

import copy
from contextlib import nullcontext

import pytest
import torch
from dynamics_helpers import MODELS, EnvMaker, random_actions, random_model, reset_rows
from helpers import slow_but
from meta_helpers import META, device_alone, meta, meta_env  # noqa: F401
from tensordict import TensorDict
from torch import Tensor

from torchrl_nerd import NeRDEnv, load_scene
from torchrl_nerd.dynamics import NeRDDynamics
from torchrl_nerd.dynamics.base import check_step
from torchrl_nerd.envs.base import SceneEnv
from torchrl_nerd.geometry import constants
from torchrl_nerd.robots import TASKS
from torchrl_nerd.scenes import Scene

ROWS, STEPS = 4, 50
QUICK = {("ant/run", "streaming"), ("anymal/forward", "analytic")}
QUICK |= {("double_pendulum/passive", "hybrid")}
CASES = [(task, kind) for task in TASKS for kind in MODELS]

# a robot of slides and hinges, and one that turns freely
TRACED = {("cartpole/swingup", "hybrid"), ("ant/run", "streaming")}

each_case = pytest.mark.parametrize(("task_id", "kind"), slow_but(QUICK, CASES))
each_traced = pytest.mark.parametrize(("task_id", "kind"), slow_but(TRACED, CASES))


def step_and_reset(env: SceneEnv) -> TensorDict:
    """A reset, a step, a reset of some envs, a step that leaves some where they are."""
    now = env._reset()
    flags = torch.empty(ROWS, 1, dtype=torch.bool, device=META)
    action = torch.empty(env.action_spec.shape, device=META)
    now = env._step(now.set("action", action))
    now = env._reset(now.set("_reset", flags))
    return env._step(now.set("action", action).set("_step", flags))


@each_case
def test_nothing_is_read_or_copied(task_id, kind, meta, generator):  # noqa: F811
    """The first pass moves constants to the device; from then on they are there."""
    env = meta_env(task_id, kind, ROWS, generator)
    for where in (nullcontext(), device_alone()):
        with where:
            after = step_and_reset(env)
        assert all(after[key].device == META for key in after.keys(True, True))


def test_a_look_at_a_number_is_noticed(meta, generator):  # noqa: F811
    env = meta_env("cartpole/swingup", "streaming", ROWS, generator)
    reward = env.task.reward
    vars(env.task)["reward"] = lambda *x: reward(*x) if x[1].any() else 0.0 * x[1]
    with pytest.raises(RuntimeError, match="meta"):
        step_and_reset(env)


@pytest.mark.parametrize(
    "copies",
    [
        lambda x: x + torch.ones(3).to(META),
        lambda x: x[[2, 1, 0]],
        lambda x: x + x.new_tensor((1.0, 2.0, 3.0)),
    ],
)
def test_a_copy_is_noticed(copies):
    with pytest.raises(AssertionError, match="host"), device_alone():
        copies(torch.empty(3, device=META))


@each_traced
def test_all_of_it_is_one_graph(task_id, kind, generator):
    """`torch.compile` finds no place where it would have to stop; nor on a device."""
    maker = EnvMaker(task_id, kind, generator)
    eager, traced = maker(ROWS), maker(ROWS)
    traced.compile(backend="eager", fullgraph=True)
    actions = random_actions(eager, 3, generator)
    paths = []
    for env in (eager, traced):
        after = env.reset()
        for number, action in enumerate(actions):
            after = env.step(TensorDict({"action": action}, [ROWS]))["next"]
            after = reset_rows(env, torch.arange(ROWS) == number, after)
        paths.append(after)
    for key, value in paths[0].items():
        torch.testing.assert_close(paths[1][key], value, rtol=1e-6, atol=1e-6)


def test_shapes_of_several_scenes_are_checked_in_one_graph():
    """From the second scene on, Dynamo takes a width for a symbol."""

    def checked(scene: Scene, state: TensorDict, torque: Tensor) -> Tensor:
        check_step(scene, state, torque, None)
        return torque + 1.0

    traced = torch.compile(checked, backend="eager", fullgraph=True)
    for name in ("cartpole", "cube", "franka"):
        scene = load_scene(name)
        qpos, qvel = (torch.zeros(ROWS, n) for n in (scene.model.nq, scene.model.nv))
        torque = torch.zeros(ROWS, len(scene.actuated))
        torch._dynamo.mark_static(qpos)
        state = TensorDict(qpos=qpos, qvel=qvel, batch_size=[ROWS])
        assert torch.equal(checked(scene, state, torque), traced(scene, state, torque))


@pytest.mark.parametrize("is_compiled", [False, True])
def test_constants_are_kept_on_an_accelerator(is_compiled, monkeypatch):
    """There compiled code takes them from where they are, as eager code does."""
    monkeypatch.setattr(constants, "_bakes", lambda device: False)
    x = torch.randn(2, 3, dtype=torch.float64)

    def scaled(x: Tensor) -> Tensor:
        return x * constants.constant(x, [3.0, 2.0, 1.0])

    run = torch.compile(scaled, backend="eager", fullgraph=True)
    for _ in range(2):
        scaled(x)
        found = run(x) if is_compiled else scaled(x)
        assert torch.equal(found, x * torch.tensor([3.0, 2.0, 1.0], dtype=x.dtype))
    assert constants.constant(x, (1.0,)) is constants.constant(x, [1.0])
    assert constants.constant(x.float(), (1.0,)).dtype == torch.float32


def test_places_are_taken_in_their_order(generator):
    x = torch.randn(4, 5, generator=generator)
    for dim, size in ((0, 4), (-1, 5)):
        places = torch.randperm(size, generator=generator).tolist()
        expected = x.index_select(dim, torch.tensor(places))
        assert torch.equal(constants.take(x, places, dim), expected)
        assert constants.take(x.to(META), places, dim).shape == expected.shape


def memory_of(env: SceneEnv) -> list[Tensor]:
    """All tensors of the history."""
    inner = env._torch_dynamics
    assert isinstance(inner, NeRDDynamics)
    fields = vars(inner._memory).values()
    return [x for y in fields for x in (y if isinstance(y, list) else [y])]


@pytest.mark.parametrize("network", ["transformer-2x64", "gru"])
@pytest.mark.parametrize("kind", ["streaming", "window"])
def test_a_history_stays_where_it_is(kind, network, generator):
    """So a CUDA graph finds it there; after a reset of all envs it is as good as new."""
    model = random_model(load_scene("cartpole"), generator, network)
    env = NeRDEnv("cartpole/swingup", model, ROWS, seed=0, inference=kind)
    env.reset()
    before = copy.deepcopy(memory_of(env))
    places = [x.data_ptr() for x in memory_of(env)]
    for number, action in enumerate(random_actions(env, STEPS, generator)):
        after = env.step(TensorDict({"action": action}, [ROWS]))["next"]
        if number % 3 == 0:
            reset_rows(env, torch.rand(ROWS, generator=generator) < 0.3, after)
    assert [x.data_ptr() for x in memory_of(env)] == places
    assert not all(map(torch.equal, memory_of(env), before))
    env.reset()
    assert [x.data_ptr() for x in memory_of(env)] == places
    old, new, state = env.dynamics, NeRDDynamics(model, kind), env.state
    new.reset(state)
    for _ in range(STEPS):  # fuller and fuller
        torque = torch.randn(ROWS, len(env.scene.actuated), generator=generator)
        state, other = (each.step(state, torque) for each in (old, new))
        assert torch.equal(state["qpos"], other["qpos"])
        assert torch.equal(state["qvel"], other["qvel"])
