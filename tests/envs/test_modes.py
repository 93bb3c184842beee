"""Modes and gradients of the caller's own, round and inside an env."""

from dataclasses import replace

import pytest
import torch
from dynamics_helpers import (
    EnvMaker,
    act_all,
    each_dynamics,
    hybrid_model,
    random_actions,
    random_model,
    start_at,
    unequal_keys,
)
from tensordict import TensorDict
from torch import Tensor

from torchrl_nerd import NeRDEnv, make_env
from torchrl_nerd.geometry.rotations import (
    orientation_error,
    quat_exp,
    quat_log,
    quat_normalize,
)
from torchrl_nerd.robots import make_task
from torchrl_nerd.transforms import RobotCentric

ROWS, STEPS = 3, 2
SMOOTH = ("learned", "hybrid", "analytic")


def policy(weight: Tensor):
    """With gradients, and linear layers that autocast rounds."""
    return lambda td: td.set("action", (td["observation"] @ weight).tanh())


@each_dynamics
def test_an_env_without_gradients_takes_actions_with_them(task_id, dynamics, generator):
    env = EnvMaker(task_id, dynamics, generator)(ROWS)
    shape = env.observation_spec["observation"].shape[-1], env.action_spec.shape[-1]
    weight = torch.randn(shape, generator=generator).requires_grad_()
    path = env.rollout(STEPS, policy(weight), break_when_any_done=False)
    for key, value in path["next"].items():
        assert not value.requires_grad, key
    state = env.state
    state["qvel"].requires_grad_()
    assert not env.reset(state, set_state=True)["qvel"].requires_grad
    torque = torch.zeros(ROWS, len(env.scene.actuated), requires_grad=True)
    env.dynamics.step(state, torque, state.get("terrain", None))


@each_dynamics
def test_inference_mode_and_autocast_leave_no_trace(task_id, dynamics, generator):
    make = EnvMaker(task_id, dynamics, generator, horizon=2)
    plain = make(ROWS)
    actions = random_actions(plain, STEPS, generator)
    plain.reset()
    expected = act_all(plain, actions)
    kept = plain.state_dict()
    shape = plain.observation_spec["observation"].shape[-1], actions.shape[-1]
    weight = torch.randn(shape, generator=generator)
    with torch.inference_mode(), torch.autocast("cpu", torch.bfloat16):
        env = make(ROWS)
        env.set_seed(0)
        env.reset()
        first = act_all(env, actions)
        env.rollout(3, policy(weight), break_when_any_done=False)
        env.reset()
        env.set_seed(0)
    assert not unequal_keys(first, expected)
    env.reset()
    assert not unequal_keys(act_all(env, actions), expected)
    env.load_state_dict(kept)
    assert not unequal_keys(env.state, plain.state)
    env.rollout(4, break_when_any_done=False)


def test_what_a_scene_keeps_is_made_for_gradients_too(generator):
    """A scene that was first asked in inference mode, and a new env of it."""
    task = make_task("ant/run")
    fresh = replace(task.scene)
    task.__dict__["scene"] = fresh
    with torch.inference_mode():
        env = make_env(task, "nerd", ROWS)
        start = env.reset()
        RobotCentric(fresh)(TensorDict(start.select("qpos", "qvel"), [ROWS]))
        fresh.clearances(start["qpos"])
    env = make_env(task, "nerd", ROWS, differentiable=True)
    action = torch.zeros(env.action_spec.shape, requires_grad=True)
    after = env.step(env.reset().set("action", action))["next"]
    (slope,) = torch.autograd.grad(after["qvel"].sum(), action)
    assert slope.isfinite().all() and slope.any()


@pytest.mark.parametrize("kind", SMOOTH)
def test_slopes_are_finite_at_rest(task_id, kind, generator):
    """A plan of no action, from rest."""
    task = make_task(task_id)
    if kind == "hybrid":
        model = hybrid_model(task.scene, None, generator)
    else:
        model = random_model(task.scene, generator) if kind == "learned" else "analytic"
    env = NeRDEnv(task, model, ROWS, 0, differentiable=True)
    actions = torch.zeros(STEPS, *env.action_spec.shape, requires_grad=True)
    start = env.reset().select(*env.state.keys())
    start["qvel"] = 0.0 * start["qvel"]
    for key in ("qpos", "qvel"):
        start[key].requires_grad_()
    given = [actions, start["qpos"], start["qvel"]]
    start_at(env, start)
    path = act_all(env, actions)
    keys = ("qpos", "qvel", "observation", "reward", "joint_torque")
    total = sum(path[key].double().sum() for key in keys)
    for slope in torch.autograd.grad(total, given, allow_unused=True):
        assert slope is None or slope.isfinite().all()


def test_tasks_have_finite_slopes(task_id, generator):
    """At rest, at the goal and far away from it."""
    env = EnvMaker(task_id, "mujoco", generator)(ROWS)
    task = env.task
    state = env.reset().select(*env.state.keys())
    action = torch.zeros(env.action_spec.shape).double()
    if "goal" in state.keys():
        state["goal"][0] = task.end_effector(state["qpos"])[0]
        state["goal"][1] += 10.0
    state["qvel"] = 0.0 * state["qvel"]
    given = [state["qpos"], state["qvel"], action]
    for value in given:
        value.requires_grad_()
    after = dict(state.items()) | {"action": action}
    earned = task.reward(state, action, after).sum() + task.observation(after).sum()
    for slope in torch.autograd.grad(earned, given, allow_unused=True):
        assert slope is None or slope.isfinite().all()


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_rotations_have_finite_slopes(dtype):
    """Of no turn, of half a turn, and of a quaternion of length zero."""
    turns = [[0.0, 0.0, 0.0], [torch.pi, 0.0, 0.0], [1e-9, 0.0, 0.0]]
    turn = torch.tensor(turns, dtype=dtype).requires_grad_()
    quat = quat_exp(turn)
    same = orientation_error(quat, quat.detach())
    (slope,) = torch.autograd.grad(quat_log(quat).sum() + same.sum(), turn)
    assert slope.isfinite().all()
    none = torch.zeros(4, dtype=dtype, requires_grad=True)
    (slope,) = torch.autograd.grad(quat_normalize(none).sum(), none)
    assert slope.isfinite().all()


def test_float32_too_is_made_for_gradients():
    """An env made in inference mode, and a task that was asked there."""
    task = make_task("franka/reach")
    with torch.inference_mode():
        qpos = torch.zeros(ROWS, 7)
        task.observation({"qpos": qpos, "goal": torch.zeros(ROWS, 3)})
        how = {"differentiable": True, "state_dtype": torch.float32}
        env = make_env(task, "nerd", ROWS, **how)
    action = torch.zeros(env.action_spec.shape, requires_grad=True)
    after = env.step(env.reset().set("action", action))["next"]
    slopes = after["observation"].sum() + after["reward"].sum()
    (slope,) = torch.autograd.grad(slopes, action)
    assert slope.isfinite().all() and slope.any()
