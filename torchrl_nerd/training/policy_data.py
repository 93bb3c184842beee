"""Training data from trajectories of an exploring policy, or of saved ones."""

import hashlib
from collections.abc import Sequence
from functools import partial
from pathlib import Path

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Generator
from torchrl.envs.utils import ExplorationType, set_exploration_type

from torchrl_nerd.data.generate import Draw
from torchrl_nerd.data.simulate import as_transitions
from torchrl_nerd.data.strategies import mix
from torchrl_nerd.dynamics import MujocoDynamics
from torchrl_nerd.envs.actor import Actor
from torchrl_nerd.envs.frame_stack import append_frame, frame_stack_of
from torchrl_nerd.evaluation.policy import WEIGHTS, load_policy, make_actor, policy_task
from torchrl_nerd.keys import ACTION, OBSERVATION, PARAMETERS, QPOS, QVEL, TERRAIN
from torchrl_nerd.scenes import Scene
from torchrl_nerd.scenes.commands import actuate
from torchrl_nerd.settings import expect_at_least
from torchrl_nerd.tasks import Task


@torch.no_grad()
def policy_data(
    task: Task,
    actor: Actor,
    trajectories: int,
    steps: int,
    generator: Generator,
    noise: float = 0.5,
    start: TensorDictBase | None = None,
) -> TensorDict:
    """Draw ``[trajectories, steps]`` of a policy in MuJoCo, diverged ones included.

    They start with the task's resets, or in the states ``start [trajectories]``, with its
    hidden parameters where it has some, and continue where an episode would end. Actions
    are the policy's mean plus normal noise, clipped to [-1, 1]; the noise of each
    trajectory has a standard deviation from U(0, ``noise``), in units of the action.

    Raises:
        ValueError: a task that drives a robot with servos by torques.
    """
    scene, controller = task.scene, task.controller
    size = (trajectories, task.num_uniforms)
    u = torch.rand(size, dtype=torch.float64, generator=generator)
    share = torch.rand(trajectories, 1, dtype=torch.float64, generator=generator)
    spread = noise * share
    fresh = TensorDict(task.initial_state(u), [trajectories])
    current = fresh if start is None else start.select(*fresh.keys())
    terrain = current.get(TERRAIN, None)
    dynamics = MujocoDynamics(scene)
    dynamics.reset(current)
    state: TensorDictBase = current.select(QPOS, QVEL)
    if start is not None and PARAMETERS in start.keys():
        state[PARAMETERS] = start[PARAMETERS]
    elif scene.variation is not None:
        state[PARAMETERS] = scene.variation.draw(trajectories, generator)
    action = torch.zeros(trajectories, controller.num_actions, dtype=torch.float64)
    states, commands, recent = [state.select(QPOS, QVEL)[:, None]], [], None
    with set_exploration_type(ExplorationType.DETERMINISTIC):
        for step in range(steps):
            if step % task.frame_skip == 0:
                seen = task.observation(current.update(state)).float()
                recent = append_frame(recent, seen, frame_stack_of(actor))
                shown = TensorDict({OBSERVATION: recent}, [trajectories])
                mean = actor(shown)[ACTION].double()
                kick = torch.randn(mean.shape, dtype=mean.dtype, generator=generator)
                action = (mean + spread * kick).clamp(-1.0, 1.0)
            torque, ctrl = actuate(controller, action, state[QPOS], state[QVEL])
            state = dynamics.step(state, torque, terrain, ctrl)
            states.append(state.select(QPOS, QVEL)[:, None])
            command = torque if scene.servos is None else ctrl
            if command is None:
                raise ValueError(
                    f"expected a task that drives the servos of '{scene.name}', got one "
                    f"with a {type(controller).__name__}"
                )
            commands.append(command[:, None])
    parameters = state.get(PARAMETERS, None)
    return as_transitions(scene, states, commands, terrain, parameters)


def along_policies(
    scene: Scene, folders: Sequence[Path], noise: float = 0.5
) -> tuple[str, Draw]:
    """Saved policies as a strategy for `generate`: its name, and what it draws.

    Each policy gets an equal share of the trajectories. The name contains a hash of the
    weights and the noise: no data set is continued with other policies.
    See `save_policy` for the folders, whose cards name the tasks, and `policy_data`.

    Raises:
        ValueError: in one sentence, no such policy, one for another scene, or a
            negative noise.
    """
    expect_at_least(0.0, noise=noise)
    draws = mix(*(_along(scene, folder, noise) for folder in folders))
    weights = b"".join((folder / WEIGHTS).read_bytes() for folder in folders)
    names = "policy" if len(folders) == 1 else f"{len(folders)} policies"
    digest = hashlib.sha256(weights).hexdigest()[:16]
    return f"{names} {digest} with noise {noise:g}", draws


def _along(scene: Scene, folder: Path, noise: float) -> Draw:
    task = policy_task(folder)
    if task.scene.hash != scene.hash:
        raise ValueError(
            f"the policy in {folder} acts in scene '{task.scene.name}' "
            f"({task.scene.hash}), expected '{scene.name}' ({scene.hash})"
        )
    if scene.variation is not None:  # which a scene's hash leaves out
        task = task.with_scene(scene)
    policy = load_policy(folder, task)
    return partial(policy_data, task, make_actor(policy), noise=noise)
