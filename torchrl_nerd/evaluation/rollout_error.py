"""Open-loop error: two dynamics from the same initial states, never corrected.

Protocol of the paper's Fig. 3 and appendix C.2: initial states of the task's reset
distribution, the same actions in both (zero: passive), the error averaged over time and
trajectories.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import cast

import torch
from scipy.special import stdtrit
from tensordict import TensorDict, TensorDictBase
from torch import Generator, Tensor

from torchrl_nerd.dynamics.base import Dynamics, warm_up
from torchrl_nerd.evaluation.position_error import Errors, position_errors, unit_of
from torchrl_nerd.keys import CTRL, JOINT_TORQUE, PARAMETERS, QPOS, QVEL, TERRAIN
from torchrl_nerd.robots import Source
from torchrl_nerd.scenes import Scene
from torchrl_nerd.scenes.commands import actuate, drive, idle
from torchrl_nerd.seeds import fold_in

# the part of a seed that starts in a scene's ranges have: no data set has so many chunks
UNSEEN = 2**24 - 1

Drive = Callable[[int, TensorDictBase], tuple[Tensor, Tensor | None]]
"""``(step, state [n]) -> joint torque (n, num_actuated), N and N m, and ctrl (n, nu)``."""


def scene_of(source: Source) -> Scene:
    """The robot and its terrain."""
    return source if isinstance(source, Scene) else source.scene


@dataclass(frozen=True)
class ErrorSummary:
    """Error of one quantity over a horizon."""

    unit: str  # m or rad
    mean: float  # over all steps and trajectories
    interval: float  # half width of the mean's 95% interval, over trajectories
    final: float  # mean over trajectories at the last step
    p95: float  # 95th percentile over trajectories of their mean over time


def initial_states(source: Source, num_trajectories: int, seed: int) -> TensorDict:
    """Initial states ``[n]`` of a task's resets or a scene's sampling ranges."""
    generator, n = Generator().manual_seed(seed), num_trajectories
    if isinstance(source, Scene):
        generator = fold_in(seed, UNSEEN)
        values = source.sample_initial(n, generator)[0]
    else:
        u = torch.rand(n, source.num_uniforms, generator=generator, dtype=torch.float64)
        values = source.initial_state(u)
    if (variation := scene_of(source).variation) is not None:
        values[PARAMETERS] = variation.draw(n, generator)
    return TensorDict(values, [n])


def action_drive(
    source: Source,
    num_trajectories: int,
    steps: int,
    seed: int,
    random_actions: bool = False,
) -> Drive:
    """The source's controller on actions that do not depend on the state.

    Actions are zero, or uniform in [-1, 1] at every step. The controller sees the state of
    the dynamics that it drives.
    """
    generator = fold_in(seed, 1)  # not those of the initial states
    shape = (steps, num_trajectories, source.controller.num_actions)
    draw = torch.rand(shape, dtype=torch.float64, generator=generator)
    # (steps, n, num_actions), the same for every dynamics
    actions = 2.0 * draw - 1.0 if random_actions else torch.zeros_like(draw)

    def act(step: int, state: TensorDictBase) -> tuple[Tensor, Tensor | None]:
        qpos, qvel = state[QPOS], state[QVEL]
        return actuate(source.controller, actions[step].to(qpos.device), qpos, qvel)

    return act


def states_of(
    dynamics: Dynamics,
    start: TensorDict,
    steps: int,
    command: Tensor | Drive | None = None,
    history: TensorDict | None = None,
) -> Iterator[TensorDictBase]:
    """The state ``[n]`` after each step of a rollout.

    Args:
        dynamics: any; its past is forgotten.
        start: ``qpos``, ``qvel``; where they vary ``terrain`` and ``parameters``; ``[n]``.
        steps: control steps.
        command: ``(n, T, m)``, torques or servos' controls, repeated after T steps; or a
            function of step and state; None for no torque (passive motion), or servos in
            mid range.
        history: motion ``[n, T]`` that ends in the start, see `warm_up`; None: no past.
    """
    terrain = start.get(TERRAIN, None)
    state: TensorDictBase = start.select(QPOS, QVEL, PARAMETERS, strict=False)
    if command is None:
        command = idle(dynamics.scene, len(start), 1).to(start[QPOS])
    if history is None:
        dynamics.reset(state)
    else:
        warm_up(dynamics, history, len(start))
    for step in range(steps):
        if callable(command):
            torque, ctrl = command(step, state)
        else:
            now = command[:, step % command.shape[1]]
            torque, ctrl = drive(dynamics.scene, now, state[QPOS], state[QVEL])
        state = dynamics.step(state, torque, terrain, ctrl)
        yield state


def motion_before(
    ground_truth: Dynamics, start: TensorDict, steps: int, drive: Drive
) -> tuple[TensorDict, TensorDict | None, Drive]:
    """What is seen before a rollout, by the ground truth from the ``start [n]``.

    Returns:
        Where the motion ends, ``[n]``; its transitions ``[n, steps]``, None of no steps;
        and the drive from there on.
    """
    if not steps:
        return start, None, drive
    seen: list[TensorDictBase] = []

    def act(step: int, state: TensorDictBase) -> tuple[Tensor, Tensor | None]:
        torque, ctrl = drive(step, state)
        given = {JOINT_TORQUE: torque, CTRL: ctrl, TERRAIN: start.get(TERRAIN, None)}
        given = {key: x for key, x in given.items() if x is not None}
        seen.append(state.select(QPOS, QVEL, PARAMETERS, strict=False).update(given))
        return torque, ctrl

    *_, last = states_of(ground_truth, start, steps, act)
    end = start.clone().update(last.select(QPOS, QVEL))
    motion = cast(TensorDict, TensorDict.stack(seen, 1))
    return end, motion, lambda step, state: drive(steps + step, state)


def open_loop(
    dynamics: Dynamics,
    start: TensorDict,
    steps: int,
    command: Tensor | Drive | None = None,
    stop_at_nan: bool = False,
    history: TensorDict | None = None,
) -> Tensor:
    """Positions after each step, ``(n, steps, nq)``; see `states_of`.

    ``stop_at_nan``: stop once a trajectory is not finite; what is left is NaN. An engine
    takes long over states that diverge.
    """
    shape = (len(start), steps, start[QPOS].shape[1])
    positions = torch.full(shape, torch.nan).to(start[QPOS])
    states = states_of(dynamics, start, steps, command, history)
    for step, state in enumerate(states):
        positions[:, step] = state[QPOS]
        if stop_at_nan and not state[QPOS].isfinite().all():
            break
    return positions


def rollout(
    dynamics: Dynamics,
    start: TensorDict,
    steps: int,
    command: Tensor | Drive | None = None,
    every: int = 1,
) -> TensorDict:
    """States ``[n, 1 + steps // every]`` at the start and after ``every`` so many steps."""
    kept: list[TensorDictBase] = [start.select(QPOS, QVEL)]
    for step, state in enumerate(states_of(dynamics, start, steps, command), 1):
        if step % every == 0:
            kept.append(state.select(QPOS, QVEL))
    return cast(TensorDict, TensorDict.stack(kept, 1))


def interval_of_mean(samples: Tensor) -> float:
    """Half width of the 95% interval of the mean of independent samples ``(n,)``."""
    width = float(stdtrit(len(samples) - 1, 0.975))  # Student's, for few samples
    return float(width * samples.std() / len(samples) ** 0.5)


def summarize(
    scene: Scene, errors: Errors, horizon: int | None = None
) -> dict[str, ErrorSummary]:
    """Summary of each quantity of `position_errors` over so many steps, or all.

    Errors that are not finite stay visible.
    """
    summaries = {}
    for name, all_steps in errors.items():
        error = all_steps[:, :horizon]  # (n, horizon)
        over_time = error.mean(1)  # (n,)
        summaries[name] = ErrorSummary(
            unit=unit_of(scene, name),
            mean=float(over_time.mean()),
            # trajectories are independent, steps of one are not
            interval=interval_of_mean(over_time),
            final=float(error[:, -1].mean()),
            p95=float(over_time.quantile(0.95)),
        )
    return summaries


def means_by_horizon(errors: dict[int, dict[str, ErrorSummary]]) -> dict[str, float]:
    """Mean errors of `passive_errors` by ``quantity_horizon``, for a log."""
    return {
        f"{name}_{horizon}": error.mean
        for horizon, by_name in errors.items()
        for name, error in by_name.items()
    }


def passive_errors(
    source: Source,
    other: Dynamics,
    ground_truth: Dynamics,
    horizons: list[int],
    num_trajectories: int,
    seed: int,
    device: torch.device | str = "cpu",
    random_actions: bool = False,
    history: int = 0,
) -> dict[int, dict[str, ErrorSummary]]:
    """Open-loop errors at every horizon, from one rollout of the longest.

    Passive where the source's controller makes no torque of a zero action; see
    `action_drive`. Both have seen the ground truth's ``history`` steps before it.
    """
    scene, steps = scene_of(source), max(horizons)
    start = initial_states(source, num_trajectories, seed).to(device)
    how = num_trajectories, history + steps, seed, random_actions
    drive = action_drive(source, *how)
    start, seen, drive = motion_before(ground_truth, start, history, drive)
    both = ground_truth, other
    paths = (open_loop(one, start, steps, drive, history=seen) for one in both)
    errors = position_errors(scene, *paths)
    return {horizon: summarize(scene, errors, horizon) for horizon in horizons}
