"""Gymnasium's locomotion tasks: its own environments are the only reference."""

import gymnasium
import mujoco
import numpy as np
import pytest
import torch
from gymnasium.envs.mujoco.humanoid_v5 import mass_center
from torchrl.envs.utils import check_env_specs

from torchrl_nerd import make_env
from torchrl_nerd.robots import make_task, task_id
from torchrl_nerd.tasks.locomotion import TASKS, LocomotionTask

PLAIN = {  # what learned dynamics cannot show
    "Ant-v5": {"include_cfrc_ext_in_observation": False},
    "Humanoid-v5": {
        f"include_{part}_in_observation": False
        for part in ("cinert", "cvel", "qfrc_actuator", "cfrc_ext")
    },
}
each_task = pytest.mark.parametrize("env_id", TASKS)


def gymnasium_env(env_id: str):
    how = PLAIN.get(env_id, {})
    if how:
        how = how | {"contact_cost_weight": 0.0}
    return gymnasium.make(env_id, **how)


@each_task
def test_every_step_is_judged_as_gymnasium_does(env_id, seed):
    """Along its own random episodes, until it falls and beyond."""
    theirs, task = gymnasium_env(env_id), make_task(f"gymnasium/{env_id}")
    assert theirs.spec.max_episode_steps == task.horizon
    assert isinstance(task, LocomotionTask)
    raw, rng = theirs.unwrapped, np.random.default_rng(seed)
    low, high = raw.action_space.low, raw.action_space.high

    def now() -> dict[str, torch.Tensor]:
        parts = {"qpos": raw.data.qpos, "qvel": raw.data.qvel}
        return {key: torch.from_numpy(x.copy())[None] for key, x in parts.items()}

    def place() -> float:
        """Along the track, of this state: theirs is that of the substep before."""
        mujoco.mj_forward(raw.model, raw.data)
        if TASKS[env_id].by_centre:
            return mass_center(raw.model, raw.data)[0]
        return raw.data.body("torso").xpos[0]

    theirs.reset(seed=seed)
    seen, *_ = raw.step(
        0.0 * low
    )  # its starts have quaternions of other lengths than one
    ends, is_stale = [], env_id in PLAIN
    for _ in range(120):
        start, before = place() if is_stale else 0.0, now()
        assert np.abs(task.observation(before)[0].numpy() - seen).max() < 1e-12
        u = rng.uniform(-1.0, 1.0, raw.action_space.shape)
        ctrl = low + (high - low) * (0.5 * u + 0.5)
        seen, reward, is_end, *_ = raw.step(ctrl)
        after, action = now(), torch.from_numpy(u)[None]
        if is_stale:
            reward, _ = raw._get_rew((place() - start) / raw.dt, ctrl)
        mine = task.reward(before, action, after)
        assert abs(float(mine) - reward) < 1e-8 * (1.0 + abs(reward))
        assert bool(task.terminated(after)) == is_end
        ends.append(is_end)
    falls = TASKS[env_id].height is not None
    assert any(ends) == falls or env_id == "Ant-v5", "no step told the two apart"


@each_task
def test_starts_are_spread_as_gymnasiums(env_id):
    task, theirs = (
        LocomotionTask(f"gymnasium/{env_id}"),
        gymnasium_env(env_id).unwrapped,
    )
    u = torch.rand(2000, task.num_uniforms, dtype=torch.float64)
    start, numbers = task.initial_state(u), task.numbers
    states = []
    for number in range(200):
        theirs.reset(seed=number)
        states.append(np.concatenate((theirs.data.qpos, theirs.data.qvel)))
    quat = (
        slice(3, 7) if task.scene.base.is_floating else slice(0)
    )  # of length one here
    mine = torch.cat((start["qpos"], start["qvel"]), -1).numpy()
    kept = np.delete(np.arange(mine.shape[1]), np.arange(mine.shape[1])[quat])
    expected = np.array(states)[:, kept]
    assert np.abs(mine[:, kept].mean(0) - expected.mean(0)).max() < 0.3 * numbers.noise
    ratio = mine[:, kept].std(0) / expected.std(0)
    assert 0.8 < ratio.min() and ratio.max() < 1.25


@pytest.mark.parametrize("env_id", ["Hopper-v5", "Humanoid-v5"])
def test_an_env_of_it_keeps_torchrls_contract(env_id):
    env = make_env(f"gymnasium/{env_id}", dynamics="mujoco", num_envs=3, seed=0)
    check_env_specs(env)
    path = env.rollout(200, break_when_any_done=False)
    assert path["next", "terminated"].any()
    assert task_id(env.task) == f"gymnasium/{env_id}"


def test_a_task_that_is_none_is_named():
    with pytest.raises(ValueError, match="expected a task of Ant-v5.*got 'Pusher-v5'"):
        LocomotionTask("gymnasium/Pusher-v5")
