"""Open-loop error: a model against MuJoCo from the same start, never corrected.

Protocol of the paper's Fig. 3 and appendix C.2: starts from the task's reset
distribution, the same actions in both (none: passive), errors of every step averaged over
time and trajectories.
"""

from collections.abc import Callable
from dataclasses import dataclass

import mujoco
import torch
from tensordict import TensorDict, TensorDictBase
from torch import Generator, Tensor

from torchrl_nerd.dynamics.base import Dynamics
from torchrl_nerd.geometry.rotations import orientation_error, wrap_angle
from torchrl_nerd.keys import QPOS, QVEL, TERRAIN
from torchrl_nerd.scenes import Scene
from torchrl_nerd.tasks import Task

Drive = Callable[[int, TensorDictBase], Tensor]
"""``(step, state [rows]) -> joint torque (rows, num_actuated)``."""

Source = Task | Scene
"""Whose starts and controller a test has: a task's, or a scene's own sampling ranges."""


def scene_of(source: Source) -> Scene:
    """The robot and its ground."""
    return source if isinstance(source, Scene) else source.scene


@dataclass(frozen=True)
class ErrorSummary:
    """Error of one quantity over a horizon.

    | field | meaning |
    |---|---|
    | ``unit`` | m or rad |
    | ``mean`` | over all steps and trajectories |
    | ``interval`` | half width of the 95% interval of the mean, over trajectories |
    | ``final`` | mean over trajectories at the last step |
    | ``p95`` | 95th percentile over trajectories of their mean over time |
    """

    unit: str
    mean: float
    interval: float
    final: float
    p95: float


def initial_states(source: Source, rows: int, seed: int) -> TensorDict:
    """Starts ``[rows]`` of a task's resets or a scene's ranges, from their own seed."""
    generator = Generator().manual_seed(seed)
    if isinstance(source, Scene):
        return TensorDict(source.sample_initial(rows, generator)[0], batch_size=[rows])
    u = torch.rand(rows, source.num_uniforms, dtype=torch.float64, generator=generator)
    return TensorDict(source.initial_state(u), batch_size=[rows])


def action_drive(
    source: Source, rows: int, steps: int, seed: int, random_actions: bool = False
) -> Drive:
    """The source's controller on actions that do not depend on the state.

    Actions are zero, or uniform in [-1, 1] at every step. The controller sees the state
    that the dynamics it drives has led to.
    """
    generator = Generator().manual_seed(seed)
    shape = (steps, rows, source.controller.num_actions)
    draw = torch.rand(shape, dtype=torch.float64, generator=generator)
    actions = 2.0 * draw - 1.0 if random_actions else torch.zeros_like(draw)

    def drive(step: int, state: TensorDictBase) -> Tensor:
        qpos, qvel = state[QPOS], state[QVEL]
        return source.controller(actions[step].to(qpos.device), qpos, qvel)

    return drive


def open_loop(
    dynamics: Dynamics,
    start: TensorDict,
    steps: int,
    joint_torque: Tensor | Drive | None = None,
) -> Tensor:
    """Positions after each step, ``(rows, steps, nq)``.

    Args:
        dynamics: of any kind.
        start: ``qpos``, ``qvel`` and, where the ground varies, ``terrain``.
        steps: how many.
        joint_torque: ``(rows, steps, num_actuated)``, or a function of step and state;
            None for none (passive motion).
    """
    rows, terrain = start.batch_size[0], start.get(TERRAIN, None)
    state: TensorDictBase = start.select(QPOS, QVEL)
    zero = state.get(QPOS).new_zeros(rows, len(dynamics.scene.actuated))
    dynamics.reset(state)
    positions = []
    for step in range(steps):
        if callable(joint_torque):
            torque = joint_torque(step, state)
        else:
            torque = zero if joint_torque is None else joint_torque[:, step]
        state = dynamics.step(state, torque, terrain)
        positions.append(state[QPOS])
    return torch.stack(positions, 1)


def position_errors(
    scene: Scene, ground_truth: Tensor, learned: Tensor
) -> dict[str, Tensor]:
    """Error of every quantity at every step, ``(rows, steps)``.

    A floating base gives ``base_position`` (m), ``base_orientation`` (rad) and the mean
    over ``joints`` (rad); a fixed base gives one entry per joint, by name.
    """
    model, errors = scene.model, {}
    if scene.base.is_floating:
        q = scene.base.qpos_address
        offset = ground_truth[..., q : q + 3] - learned[..., q : q + 3]
        errors["base_position"] = torch.linalg.vector_norm(offset, dim=-1)
        quats = (x[..., q + 3 : q + 7] for x in (ground_truth, learned))
        errors["base_orientation"] = orientation_error(*quats)
    joints = {}
    for joint in range(model.njnt):
        q, kind = int(model.jnt_qposadr[joint]), int(model.jnt_type[joint])
        if kind == mujoco.mjtJoint.mjJNT_FREE:
            continue
        if kind == mujoco.mjtJoint.mjJNT_BALL:
            quats = (x[..., q : q + 4] for x in (ground_truth, learned))
            joints[model.joint(joint).name] = orientation_error(*quats)
            continue
        error = ground_truth[..., q] - learned[..., q]
        if kind == mujoco.mjtJoint.mjJNT_HINGE:
            error = wrap_angle(error)
        joints[model.joint(joint).name] = error.abs()
    if scene.base.is_floating:
        if joints:
            errors["joints"] = torch.stack(list(joints.values())).mean(0)
        return errors
    return joints


def open_loop_errors(
    ground_truth: Dynamics,
    learned: Dynamics,
    start: TensorDict,
    steps: int,
    joint_torque: Tensor | Drive | None = None,
) -> dict[str, Tensor]:
    """`position_errors` of two rollouts from the same start, ``(rows, steps)`` by quantity.

    Args:
        ground_truth: MuJoCo.
        learned: other dynamics of the same robot.
        start: see `open_loop`, as ``steps`` and ``joint_torque``.
        steps: control steps.
        joint_torque: N or N m.
    """
    paths = [open_loop(d, start, steps, joint_torque) for d in (ground_truth, learned)]
    return position_errors(ground_truth.scene, *paths)


def unit_of(scene: Scene, quantity: str) -> str:
    """M or rad."""
    if quantity == "base_position":
        return "m"
    if quantity in ("base_orientation", "joints"):
        return "rad"
    is_slide = scene.model.joint(quantity).type[0] == mujoco.mjtJoint.mjJNT_SLIDE
    return "m" if is_slide else "rad"


def summarize(scene: Scene, errors: dict[str, Tensor]) -> dict[str, ErrorSummary]:
    """Summary of each quantity of `position_errors`, ``(rows, steps)``, m or rad.

    Errors that are not finite stay visible.
    """
    summaries = {}
    for name, error in errors.items():
        per_row = error.mean(1)
        summaries[name] = ErrorSummary(
            unit=unit_of(scene, name),
            mean=float(per_row.mean()),
            interval=float(1.96 * per_row.std() / len(per_row) ** 0.5),
            final=float(error[:, -1].mean()),
            p95=float(per_row.quantile(0.95)),
        )
    return summaries


def passive_errors(
    source: Source,
    learned: Dynamics,
    ground_truth: Dynamics,
    horizons: list[int],
    rows: int,
    seed: int,
    device: torch.device | str = "cpu",
    random_actions: bool = False,
    tick: Callable[[], object] = lambda: None,
) -> dict[int, dict[str, ErrorSummary]]:
    """Open-loop errors at every horizon, from one rollout of the longest.

    Passive where the source's controller makes no torque of a zero action; see
    `action_drive`. ``tick`` is called before every step of either dynamics.
    """
    start, scene = initial_states(source, rows, seed).to(device), scene_of(source)
    steps = max(horizons)
    drive = action_drive(source, rows, steps, seed, random_actions)

    def ticking_drive(step: int, state: TensorDictBase) -> Tensor:
        tick()
        return drive(step, state)

    errors = open_loop_errors(ground_truth, learned, start, steps, ticking_drive)
    return {
        horizon: summarize(scene, {k: e[:, :horizon] for k, e in errors.items()})
        for horizon in horizons
    }
