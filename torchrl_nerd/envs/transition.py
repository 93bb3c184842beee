"""What an action makes of a state: controller, physics, faults, reward, end, observation.

Functions of tensors with one memory, the history that the dynamics keeps, so that the whole
of a control step can be compiled into one piece.
"""

from collections.abc import Callable, Iterable
from functools import reduce
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor

from torchrl_nerd.compiled import Compiled, uncompiled
from torchrl_nerd.dynamics import Dynamics, GuardedDynamics
from torchrl_nerd.dynamics.base import warm_up
from torchrl_nerd.envs.faults import find_faults, finite_gradient
from torchrl_nerd.keys import (
    ACTION,
    CTRL,
    FAULT,
    OBSERVATION,
    PARAMETERS,
    QPOS,
    QVEL,
    SENSORDATA,
    TERRAIN,
    TRUST,
)
from torchrl_nerd.scenes.commands import actuate, num_ctrl
from torchrl_nerd.scenes.controllers import ActuatorController
from torchrl_nerd.scenes.variation import expect_told, ranges_of
from torchrl_nerd.tasks import Task

Tensors = dict[str, Tensor]
MOVING = QPOS, QVEL, PARAMETERS  # what a control step sees of a state
FLAGS = ("done", "terminated", "truncated")


def drive_sizes(task: Task) -> dict[str, int]:
    """Width of ``joint_torque`` and, where a task drives servos, of ``ctrl``."""
    sizes, controls = {"joint_torque": len(task.scene.actuated)}, num_ctrl(task.scene)
    is_own = isinstance(task.controller, ActuatorController)
    return sizes | {"ctrl": controls} if is_own and controls else sizes


class Transition:
    """A task in a dynamics, from one state to the next.

    Raises ValueError for a dynamics of another scene, or told of other parameters, and for
    a controller of other joints than the robot's motors.
    """

    # the dynamics has compiled code of its own, and `step` compiles to what is round it
    is_round = False

    def __init__(self, task: Task, dynamics: Dynamics) -> None:
        if dynamics.scene.hash != task.scene.hash:
            ours, its = (f"'{x.name}' ({x.hash})" for x in (task.scene, dynamics.scene))
            raise ValueError(f"the task is for scene {ours}, the dynamics for {its}")
        own, varied = dynamics.scene.variation, task.scene.variation
        guard = dynamics.guard if isinstance(dynamics, GuardedDynamics) else None
        # MuJoCo reads parameters by their order
        is_exact = dynamics.kind == "ground truth" or guard == "fallback"
        is_other = is_exact and str(ranges_of(own)) != str(ranges_of(varied))
        if varied is not None and (own is None or is_other):
            raise ValueError(
                f"expected dynamics of the varied scene '{task.scene.name}', got some of "
                f"{'one robot' if own is None else 'another variation'}"
            )
        expect_told(dynamics.told, varied)
        motors = task.scene.actuated
        driven = getattr(task.controller, "dof_addresses", motors)
        if tuple(driven) != tuple(motors):
            raise ValueError(
                f"expected a controller of the motors of '{task.scene.name}' in their "
                f"order, dofs {tuple(motors)}, got one of dofs {tuple(driven)}"
            )
        self.task, self.dynamics = task, dynamics
        self.is_truncating = guard == "truncate"
        self.eager()

    def eager(self) -> None:
        """`step` is Python."""
        self._advance, self._judge = self._control_step, self._outcome

    def compile(self, is_whole: bool, **options: Any) -> Callable[..., Tensors]:
        """`step`, compiled with the ``options`` of `Compiled`.

        It is one piece where it ``is_whole`` or one control step long. Else a control step
        is one and what follows the last is another: four in one piece take four minutes.
        ``warmup`` counts actions.
        """
        self.eager()
        if is_whole or self.task.frame_skip == 1:
            return Compiled(self.step, **options)
        warmup = self.task.frame_skip * options["warmup"]
        self._advance = Compiled(self._control_step, **options | {"warmup": warmup})
        self._judge = Compiled(self._outcome, what="what follows a step", **options)
        return self.step

    def step(self, state: Tensors, action: Tensor, age: Tensor) -> Tensors:
        """All that one action leads to; an env at fault keeps its state and ends.

        The ``state`` holds ``qpos``, ``qvel`` and the task's parameters, ``(num_envs,
        size)`` each; ``age (num_envs,)`` counts the actions before this one.

        Returns:
            The next state and what an env hands out beside it: ``joint_torque``, of servos
            ``ctrl``, ``observation``, ``reward``, ``fault``, the flags, and ``trust`` where
            the dynamics has one.
        """
        # an action that is not finite is a fault, found below; the physics gets zeros
        given = torch.where(action.isfinite().all(-1, keepdim=True), action, 0.0)
        seen, acted = state, given
        if torch.is_grad_enabled():  # through an env at fault no gradient goes back
            seen = state | {key: finite_gradient(state[key]) for key in (QPOS, QVEL)}
            acted = finite_gradient(given)
        steps = self._control_steps(self._advance, seen, acted, state.get(TERRAIN))
        moved, drive = steps[-1]
        trusts = [after[TRUST] for after, _ in steps if TRUST in after]
        trust = reduce(torch.minimum, trusts) if trusts else None
        return self._judge(state, action, given, age, moved, drive, trust)

    def _control_steps(
        self,
        advance: Callable[..., tuple[Tensors, Tensors]],
        state: Tensors,
        action: Tensor,
        terrain: Tensor | None,
    ) -> list[tuple[Tensors, Tensors]]:
        """What ``advance`` makes of a state in each control step of an action."""
        moved, found = state, []
        for _ in range(self.task.frame_skip):
            moving = {key: moved[key] for key in MOVING if key in moved}
            moved, drive = advance(moving, action, terrain)
            found.append((moved, drive))
        return found

    def warm_up(self, history: TensorDictBase, num_envs: int) -> None:
        """Show the dynamics a recorded motion, see `dynamics.base.warm_up`.

        Where the motion holds ``action``, the controller makes of it what it made of it
        then: a torque for each control step, or the ``ctrl`` of the robot's own actuators.

        Raises:
            ValueError: neither action nor ``ctrl`` for actuators whose commands are late,
                or an action of another width.
        """
        has_action, varied = ACTION in history.keys(), self.task.scene.variation
        is_told = has_action or history.get(CTRL, None) is not None
        is_late = varied is not None and varied.max_delay > 0
        if is_late and not is_told and self.dynamics.kind == "ground truth":
            if isinstance(self.task.controller, ActuatorController):
                wanted = "'action' in the history of actuators that are late"
                raise ValueError(f"expected {wanted}, got none")
        width = self.task.controller.num_actions
        if has_action and (got := history[ACTION].shape[-1]) != width:
            raise ValueError(
                f"expected 'action' of width {width} in a history, got {got}"
            )
        warm_up(self.dynamics, history, num_envs, self._repeat if has_action else None)

    def _repeat(self, state: TensorDictBase, then: TensorDictBase) -> None:
        """Let the dynamics make the control steps of a recorded action once more."""
        given = then[ACTION], then.get(TERRAIN, None)
        self._control_steps(self._control_step, dict(state.items()), *given)

    def _outcome(
        self,
        state: Tensors,
        action: Tensor,
        given: Tensor,
        age: Tensor,
        moved: Tensors,
        drive: Tensors,
        trust: Tensor | None,
    ) -> Tensors:
        """What `step` returns, from the state before and that after all control steps."""
        fault = find_faults(action, state, moved)  # (num_envs, 1)
        is_good = fault == 0
        kept = {k: torch.where(is_good, moved[k], state[k]) for k in (QPOS, QVEL)}
        after = state | kept
        shown = after | {ACTION: given}
        if SENSORDATA in moved:
            shown[SENSORDATA] = torch.where(is_good, moved[SENSORDATA], 0.0)
        ends = self._per_env("terminated", self.task.terminated(shown), action)
        terminated = ends | ~is_good
        truncated = (age + 1 >= self.task.horizon)[:, None]
        if trust is not None:
            after[TRUST] = trust
            if self.is_truncating:
                truncated = truncated | (trust < 1.0)
        # of a state that was not finite, neither is the torque that answers it
        drive = {k: torch.where(x.isfinite(), x, 0.0) for k, x in drive.items()}
        earned = self.task.reward(state, given, shown)
        reward = self._per_env("reward", earned, action)
        return after | {
            **{key: drive[key] for key in drive_sizes(self.task)},
            FAULT: fault,
            OBSERVATION: self._observation(shown),
            "reward": reward.to(torch.float32, copy=True),  # a task may give a view
            "done": terminated | truncated,
            "terminated": terminated,
            "truncated": truncated,
        }

    def _per_env(self, name: str, value: Tensor, action: Tensor) -> Tensor:
        """What a task says of each env, ``(num_envs,)``, as ``(num_envs, 1)``."""
        return self._of_shape(name, value, action.shape[:1])[:, None]

    def _observation(self, state: Tensors) -> Tensor:
        """What the policy sees, ``(num_envs, observation_size)``, float32."""
        found = self.task.observation(state).to(torch.float32)
        size = len(state[QPOS]), self.task.observation_size
        return self._of_shape("observation", found, size)

    def _of_shape(self, name: str, value: Tensor, expected: Iterable[int]) -> Tensor:
        """What a task gave, if it has this shape."""
        if tuple(value.shape) != tuple(expected):
            raise ValueError(
                f"expected {name} of shape {tuple(expected)} from "
                f"{type(self.task).__name__}, got {tuple(value.shape)}"
            )
        return value

    def _control_step(
        self, state: Tensors, action: Tensor, terrain: Tensor | None
    ) -> tuple[Tensors, Tensors]:
        """The state one control step later, and what drove it: torque and ``ctrl``."""
        torque, ctrl = actuate(self.task.controller, action, state[QPOS], state[QVEL])
        move = self._move_apart if self.is_round else self._move
        moved, drive = move(state, torque, terrain, ctrl), {"joint_torque": torque}
        return moved, drive if ctrl is None else {**drive, "ctrl": ctrl}

    def _move(self, state: Tensors, *given: Any) -> Tensors:
        """A step of the dynamics, in the state's precision."""
        qpos = state[QPOS]
        before = TensorDict(state, qpos.shape[:1], device=qpos.device)
        moved = dict(self.dynamics.step(before, *given).items())
        return moved | {key: moved[key].to(qpos.dtype) for key in (QPOS, QVEL)}

    @uncompiled
    def _move_apart(self, state: Tensors, *given: Any) -> Tensors:
        return self._move(state, *given)

    def restart(
        self, state: Tensors, is_reset: Tensor, drawn: Tensor, given: Tensors
    ) -> Tensors:
        """New episodes where ``is_reset (num_envs,)``; other envs stay bitwise.

        What of a start is not ``given`` is left to chance: ``drawn (num_envs, numbers)``,
        uniform in [0, 1), for all envs, so that shapes stay the same. They are an argument,
        since the compiler would write the hash that they come from into each of their uses.

        Returns:
            As `step`, without reward: zero torque and control, no fault, full trust, not
            done.
        """
        fresh = self._start(state, drawn) if state.keys() - given.keys() else {}
        if (variation := self.task.scene.variation) is not None:
            fresh[PARAMETERS] = variation.values(drawn[:, self.task.num_uniforms :])
        fresh = fresh | given
        column = is_reset[:, None]
        start = {
            key: torch.where(column, fresh[key].to(now.dtype), now)
            for key, now in state.items()
        }
        sizes, zero = drive_sizes(self.task), start[QPOS].new_zeros
        return start | {
            **{key: zero(len(is_reset), size) for key, size in sizes.items()},
            FAULT: torch.zeros_like(column, dtype=torch.long),
            TRUST: torch.ones_like(column, dtype=torch.float32),
            OBSERVATION: self._observation(start),
            **{flag: torch.zeros_like(column) for flag in FLAGS},  # (num_envs, 1) each
        }

    def _start(self, state: Tensors, drawn: Tensor) -> Tensors:
        """What the task begins with, where a ``state`` has such widths."""
        fresh = dict(self.task.initial_state(drawn[:, : self.task.num_uniforms]))
        for key in (x for x in state if x != PARAMETERS):
            if key not in fresh:
                raise ValueError(
                    f"expected {key} from initial_state of {type(self.task).__name__}, "
                    f"got {sorted(fresh)}"
                )
            self._of_shape(f"initial {key}", fresh[key], state[key].shape)
        return fresh
