"""A compiled env steps and resets as an eager one does.

One env goes through the compiler by default, others through its tracer alone.
"""

import copy
import pickle
from collections.abc import Iterator
from functools import partial
from itertools import cycle
from typing import get_args

import pytest
import torch
from dynamics_helpers import (
    HAS_COMPILER,
    EnvMaker,
    random_actions,
    random_model,
    row_uniforms,
)
from helpers import slow_but
from tensordict import TensorDictBase
from torchrl.collectors import Collector

from torchrl_nerd import NeRDEnv, load_scene, make_env
from torchrl_nerd.compiled import Compiled
from torchrl_nerd.dynamics.guarded import Guard
from torchrl_nerd.envs.base import SceneEnv
from torchrl_nerd.envs.streams import uniforms
from torchrl_nerd.robots import TASKS, make_task

TASK = "cartpole/swingup"
ROWS, STEPS = 4, 5
CLOSE = {"atol": 1e-5, "rtol": 1e-5}


def path(env: SceneEnv, actions: torch.Tensor) -> list[TensorDictBase]:
    """Steps with a partial reset after each."""
    now, records = env.reset(), []
    rows = torch.arange(ROWS)[:, None]
    for number, action in enumerate(actions):
        record = env.step(now.set("action", action))
        now = env.reset(record["next"].clone().set("_reset", rows == number % ROWS))
        records += [record.exclude("next"), record["next"], now.clone()]
    return records


@pytest.mark.parametrize("task_id", slow_but([TASK], TASKS))
def test_its_pieces_are_the_eager_steps(task_id, generator):
    """Traced, and run as they were traced: every bit is the same.

    But of robots with legs, whose contact points traced code finds by sums in another
    order, and of a linear solve, whose last bits depend on where its operands lie.
    """
    maker = EnvMaker(task_id, "streaming", generator)
    sums = 1e-13 * task_id.startswith(("ant", "anymal"))
    solves = 1e-9 * (task_id == "franka/reach_osc")
    eager, traced = maker(ROWS), maker(ROWS)
    traced.compile(backend="eager", fullgraph=True)
    actions = random_actions(eager, STEPS, generator)
    for one, other in zip(path(eager, actions), path(traced, actions), strict=True):
        assert set(one.keys()) == set(other.keys())
        bound = {"atol": sums + solves, "rtol": sums}
        torch.testing.assert_close(one, other, **bound)


@pytest.mark.slow
def test_a_compiled_task_is_close_to_eager(task_id, generator):
    maker = EnvMaker(task_id, "streaming", generator)
    eager, compiled = maker(ROWS), maker(ROWS).compile()
    actions = random_actions(eager, STEPS, generator)
    for one, other in zip(path(eager, actions), path(compiled, actions), strict=True):
        torch.testing.assert_close(one, other, **CLOSE)
    check_is_compiled(compiled)


def check_is_compiled(env: SceneEnv) -> None:
    """Step and reset went through the compiler, where there is one."""
    transition = env._transition
    is_held = env.task.frame_skip > 1  # over control steps, each a piece of its own
    apart = (transition._advance, transition._judge) if is_held else (env._transit,)
    for piece in (*apart, env._restart):
        assert isinstance(piece, Compiled)
        assert (piece._run is not None) == HAS_COMPILER


@pytest.mark.slow
def test_compiled_starts_are_the_eager_ones(generator):
    """To the bit, whatever the seed: products of 64-bit numbers overflow as they should."""
    for rows in (1, 3, 64):
        drawn = int(torch.randint(2**63 - 1, (), generator=generator))
        for seed in (0, 1, drawn):
            env = make_env(TASK, num_envs=rows, seed=seed)
            count = env.task.num_uniforms
            draw = Compiled(uniforms, warmup=0)
            for _ in range(3):
                episode = torch.randint(10**6, (rows,), generator=generator)
                given = env._keys, episode, env._offsets
                expected = row_uniforms(seed, episode, count)
                assert torch.equal(uniforms(*given), expected)
                assert torch.equal(draw(*given), expected)


def act_next(actions: Iterator[torch.Tensor], td: TensorDictBase) -> TensorDictBase:
    return td.set("action", next(actions))


@pytest.mark.parametrize(
    ("model", "guard"),
    [
        ("cartpole-mlp", None),
        *(
            pytest.param("cartpole", guard, marks=pytest.mark.slow)
            for guard in (None, *get_args(Guard))
        ),
    ],
)
def test_torchrl_rolls_it_out(model, guard, seed):
    """With automatic resets, whatever looks at its steps."""
    task = make_task(TASK)
    task.horizon = 3
    how = {"num_envs": ROWS, "seed": 1, "guard": guard}
    envs = [NeRDEnv(task, model, **how) for _ in range(2)]
    envs[1].compile()
    paths = []
    for env in envs:
        generator = torch.Generator().manual_seed(seed)
        actions = cycle(random_actions(env, 2 * STEPS, generator))
        collector = Collector(
            env,
            partial(act_next, actions),
            frames_per_batch=2 * STEPS * ROWS,
            total_frames=2 * STEPS * ROWS,
            auto_register_policy_transforms=False,
        )
        (batch,) = collector
        paths.append(batch.exclude("collector"))
    assert paths[0]["next", "done"].any()
    torch.testing.assert_close(*paths, **CLOSE)
    check_is_compiled(envs[1])


def test_every_way_to_ask_for_it(generator):
    """TorchRL's keyword, its method and `make_env` do the same; `eager` undoes it."""
    envs = [
        NeRDEnv(TASK, num_envs=ROWS, compile=True),  # pyright: ignore
        make_env(TASK, num_envs=ROWS, compile=True),
        make_env(TASK, num_envs=ROWS).compile(),
    ]
    for env in envs:
        assert isinstance(env._transit, Compiled)
        assert isinstance(env._restart, Compiled)
        assert "_compiled_step_and_maybe_reset" not in vars(env)
        assert not isinstance(env.eager()._transit, Compiled)


@pytest.mark.slow
@pytest.mark.parametrize(
    "clone", [copy.deepcopy, lambda x: pickle.loads(pickle.dumps(x))]
)
def test_a_copy_goes_its_own_way(clone, generator):
    env = make_env(TASK, num_envs=ROWS, seed=3, compile=True)
    actions = random_actions(env, 2 * STEPS, generator)
    now = env.reset()
    for action in actions[:STEPS]:
        now = env.step(now.set("action", action))["next"]
    twin = clone(env)
    assert twin._transit.function.__self__.dynamics is twin.dynamics
    ends = []
    for each in (env, twin):
        here = now.clone()
        for action in actions[STEPS:]:
            here = each.step(here.set("action", action))["next"]
        ends.append(here)
    torch.testing.assert_close(*ends, **CLOSE)


@pytest.mark.slow
def test_gradients_pass_through(generator):
    scene = load_scene("cartpole")
    model = random_model(scene, generator, "mlp-4x64").requires_grad_(False)
    start = generator.initial_seed() % 2**32
    gradients = []
    for is_compiled in (False, True):
        env = NeRDEnv(TASK, model, ROWS, seed=start, differentiable=True)
        env = env.compile() if is_compiled else env
        gain = torch.ones(4, 1, requires_grad=True)
        now, total = env.reset(), torch.zeros(())
        for _ in range(STEPS):
            now.set("action", (now["observation"] @ gain).tanh())
            now = env.step(now)["next"]
            total = total + now["reward"].mean()
        gradients += torch.autograd.grad(total, gain)
    assert gradients[0].any()
    torch.testing.assert_close(*gradients, atol=1e-4, rtol=1e-4)


@pytest.mark.slow
@pytest.mark.parametrize("task_id", [TASK, "dm_control/cartpole-swingup"])
@pytest.mark.parametrize("dynamics", ["streaming", "mujoco", "dm_control"])
def test_it_compiles_round_what_cannot_be_compiled(task_id, dynamics, generator):
    """A simulator, and the judge of a suite."""
    maker = EnvMaker(task_id, dynamics, generator)
    eager, compiled = maker(ROWS), maker(ROWS).compile()
    actions = random_actions(eager, STEPS, generator)
    for one, other in zip(path(eager, actions), path(compiled, actions), strict=True):
        torch.testing.assert_close(one, other, **CLOSE)


def test_without_a_compiler_it_says_so_once_and_goes_on(generator, monkeypatch):
    def broken(graph, inputs):
        raise RuntimeError("no compiler here")

    env = make_env(TASK, num_envs=ROWS, seed=2).compile(backend=broken)
    expected = make_env(TASK, num_envs=ROWS, seed=2)
    actions = random_actions(env, STEPS, generator)
    with pytest.warns(UserWarning, match="running eagerly: .*no compiler here") as said:
        found = path(env, actions)
    ours = [str(w.message) for w in said if "running eagerly" in str(w.message)]
    assert len(ours) == 2  # a step, a reset
    for one, other in zip(found, path(expected, actions), strict=True):
        assert all(torch.equal(one[key], other[key]) for key in one.keys())


def test_eager_steps_come_first(generator):
    """As many as asked, of a task whose actions are held too."""
    env = make_env("franka/reach", num_envs=ROWS).compile(warmup=2, backend="eager")
    now, pieces = env.reset(), (env._transition._advance, env._transition._judge)
    for step in range(3):
        assert all(piece._run is None for piece in pieces), step
        now = env.step(now.set("action", torch.zeros(ROWS, 7)))["next"]
        now = now.exclude("reward")
    assert all(piece._run is not None for piece in pieces)
