"""A scene, a task and a dynamics joined into a batched TorchRL env."""

from pathlib import Path
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.data import Bounded, Categorical, Composite, TensorSpec, Unbounded
from torchrl.envs import EnvBase

from torchrl_nerd.dynamics import Dynamics, GuardedDynamics
from torchrl_nerd.envs.faults import REASONS, FaultRecorder, find_faults
from torchrl_nerd.envs.streams import row_uniforms
from torchrl_nerd.keys import (
    ACTION,
    FAULT,
    OBSERVATION,
    QPOS,
    QVEL,
    SENSORDATA,
    TERRAIN,
    TRUST,
)
from torchrl_nerd.tasks import Task

MAX_SEED = 2**63


class SceneEnv(EnvBase):
    """What learned and true dynamics have in common: everything but the solver.

    Per row: ``qpos``, ``qvel`` (float64), ``observation`` (float32), the task's
    parameters such as ``terrain``, and ``joint_torque``, what the controller applied over
    the control step that led here (zero after a reset); where a task holds an action over
    several control steps, over the last of them. Random numbers are each row's own, so a
    row's episodes do not depend on how many rows there are. ``reset(td, set_state=True)``
    starts from the ``qpos``, ``qvel`` and parameters in ``td``.

    A row whose action or next state is not finite, or that runs away, keeps its last state
    and ends as ``terminated``; no other row notices. ``fault`` says why, see
    `envs.faults`. With `GuardedDynamics` ``trust`` says how far a step may be believed.

    Args:
        task: reset distribution, observation, reward, end.
        dynamics: what steps the state.
        num_envs: rows.
        seed: of the resets.
        device: where states, observations and rewards live.
        fault_folder: where faults leave dumps for `nerd replay`; none are written without.

    Raises:
        ValueError: no rows, a dynamics of another scene, or a folder that cannot be
            written.
    """

    _supports_set_state = True
    _episode: Tensor
    _age: Tensor

    def __init__(
        self,
        task: Task,
        dynamics: Dynamics,
        num_envs: int = 1,
        seed: int = 0,
        device: torch.device | str = "cpu",
        fault_folder: Path | None = None,
    ) -> None:
        if num_envs < 1:
            raise ValueError(f"expected num_envs of at least 1, got {num_envs}")
        if dynamics.scene.hash != task.scene.hash:
            raise ValueError(
                f"the task is for scene '{task.scene.name}', the dynamics for "
                f"'{dynamics.scene.name}'"
            )
        super().__init__(device=device, batch_size=torch.Size([num_envs]))
        self.scene, self.task, self.dynamics = task.scene, task, dynamics
        is_guarded = isinstance(dynamics, GuardedDynamics)
        self.guard = dynamics.guard if is_guarded else None
        self._least_trust = dynamics.least_trust if is_guarded else 0.0
        self.recorder: FaultRecorder | None = None
        if fault_folder is not None:
            name = type(dynamics).__name__
            self.recorder = FaultRecorder(fault_folder, self.scene.name, name)
        self._make_specs()
        zeros = torch.zeros(num_envs, dtype=torch.long, device=self.device)
        self.register_buffer("_episode", zeros)
        self.register_buffer("_age", zeros.clone())
        for key, size in self._state_sizes.items():
            value = torch.zeros(num_envs, size, dtype=torch.float64, device=self.device)
            self.register_buffer(f"_state_{key}", value)
        self._set_seed(seed)

    @property
    def _state_sizes(self) -> dict[str, int]:
        model = self.scene.model
        return {QPOS: model.nq, QVEL: model.nv, **self.task.parameters}

    def _make_specs(self) -> None:
        rows, device = self.batch_size, self.device
        sizes = {**self._state_sizes, "joint_torque": len(self.scene.actuated)}
        state: dict[str, TensorSpec] = {
            key: Unbounded(
                torch.Size((*rows, size)), dtype=torch.float64, device=device
            )
            for key, size in sizes.items()
        }
        column = torch.Size((*rows, 1))
        if self.guard:
            state[TRUST] = Bounded(0.0, 1.0, column, dtype=torch.float32, device=device)
        state[FAULT] = Categorical(
            len(REASONS), shape=column, dtype=torch.int64, device=device
        )
        width = self.task.observation_size
        state[OBSERVATION] = Unbounded(
            torch.Size((*rows, width)), dtype=torch.float32, device=device
        )
        self.observation_spec = Composite(state, shape=rows, device=device)
        num_actions = self.task.controller.num_actions
        self.action_spec = Bounded(
            -1.0,
            1.0,
            torch.Size((*rows, num_actions)),
            dtype=torch.float32,
            device=device,
        )
        self.reward_spec = Unbounded(column, dtype=torch.float32, device=device)
        flags = {
            name: Categorical(2, shape=column, dtype=torch.bool, device=device)
            for name in ("done", "terminated", "truncated")
        }
        self.full_done_spec = Composite(flags, shape=rows, device=device)

    def _set_seed(self, seed: int | None) -> None:
        """Begin each row's stream anew."""
        if seed is None or not 0 <= seed < MAX_SEED:
            raise ValueError(f"expected a seed from 0 to {MAX_SEED - 1}, got {seed}")
        self.seed = seed
        self._episode.zero_()

    def load_state_dict(self, state_dict: Any, *args: Any, **kwargs: Any) -> Any:
        """Restore states and episode counts; the history of every row starts empty."""
        result = super().load_state_dict(state_dict, *args, **kwargs)
        self.dynamics.reset(self._state())
        return result

    @property
    def state(self) -> TensorDict:
        """Current ``qpos``, ``qvel`` and task parameters; a copy."""
        return self._state().clone()

    def _state(self) -> TensorDict:
        values = {key: getattr(self, f"_state_{key}") for key in self._state_sizes}
        return TensorDict._new_unsafe(
            values, batch_size=self.batch_size, device=self.device
        )

    def _set(self, values: dict[str, Tensor]) -> None:
        for key, value in values.items():
            setattr(self, f"_state_{key}", value)

    def _reset(
        self,
        tensordict: TensorDictBase | None = None,
        set_state: bool = False,
        **kwargs: object,
    ) -> TensorDict:
        rows = None if tensordict is None else tensordict.get("_reset", None)
        every = torch.ones(self.batch_size, dtype=torch.bool, device=self.device)
        rows = every if rows is None else rows.reshape(self.batch_size)
        u = row_uniforms(self.seed, self._episode, self.task.num_uniforms)
        fresh = self.task.initial_state(u)
        if set_state:
            fresh |= self._given_state(tensordict, rows)
        old = self._state()
        if rows.all():  # nothing of the past is left: no gradients of it either
            old = old.detach()
        self._set({k: torch.where(rows[:, None], fresh[k], old[k]) for k in fresh})
        self._episode = self._episode + rows
        self._age = self._age.masked_fill(rows, 0)
        state = self._state()
        self.dynamics.reset(state, rows)
        torque = state.get(QPOS).new_zeros(*self.batch_size, len(self.scene.actuated))
        trust = torch.ones(*self.batch_size, 1, device=self.device)
        return self._output(state, torque, torch.zeros_like(trust).long(), trust)

    def _given_state(
        self, tensordict: TensorDictBase | None, rows: Tensor
    ) -> dict[str, Tensor]:
        """The state that ``reset(td, set_state=True)`` asks for."""
        given = {} if tensordict is None else tensordict
        missing = [key for key in (QPOS, QVEL) if key not in given.keys()]
        if missing:
            raise ValueError(f"set_state needs {missing} in the tensordict")
        values = {}
        for key, size in self._state_sizes.items():
            value = given.get(key, None)
            if value is None:
                continue
            if value.shape != (*self.batch_size, size):
                expected = (*self.batch_size, size)
                raise ValueError(
                    f"expected {key} of shape {expected}, got {tuple(value.shape)}"
                )
            if not value[rows].isfinite().all():
                raise ValueError(f"expected finite {key} to set the state to")
            values[key] = value.to(torch.float64, copy=True)
        return values

    def _step(self, tensordict: TensorDictBase) -> TensorDict:
        action = tensordict[ACTION]
        if action.shape != self.action_spec.shape:
            raise ValueError(
                f"expected an action of shape {tuple(self.action_spec.shape)}, "
                f"got {tuple(action.shape)}"
            )
        state = self._state()
        given = torch.where(torch.all(action.isfinite(), -1, keepdim=True), action, 0.0)
        moved, torque = self._control_step(state, given, state)
        trust = moved.get(TRUST, None)
        for _ in range(self.task.steps_per_action - 1):
            moved, torque = self._control_step(moved, given, state)
            trust = None if trust is None else torch.minimum(trust, moved[TRUST])
        fault = find_faults(action, moved)
        if self.recorder is not None:
            self.recorder.record(state, action, torque, fault)
        next_values = {
            key: torch.where(fault == 0, moved[key], state[key]) for key in (QPOS, QVEL)
        }
        self._set(next_values)
        self._age = self._age + 1
        next_state = self._state().set(ACTION, given)
        if SENSORDATA in moved.keys():
            next_state[SENSORDATA] = torch.where(fault == 0, moved[SENSORDATA], 0.0)
        reward = self.task.reward(state, given, next_state)
        terminated = self.task.terminated(next_state)[:, None] | (fault > 0)
        truncated = (self._age >= self.task.horizon)[:, None]
        if self.guard == "truncate" and trust is not None:
            truncated = truncated | (trust < self._least_trust)
        return self._output(next_state, torque, fault, trust).update(
            {
                "reward": reward[:, None].to(torch.float32),
                "done": terminated | truncated,
                "terminated": terminated,
                "truncated": truncated,
            }
        )

    def _control_step(
        self, moving: TensorDictBase, action: Tensor, row: TensorDict
    ) -> tuple[TensorDictBase, Tensor]:
        """The state one control step later, and the torque that took it there."""
        torque = self.task.controller(action, moving[QPOS], moving[QVEL])
        return self.dynamics.step(moving, torque, row.get(TERRAIN, None)), torque

    def _output(
        self, state: TensorDict, torque: Tensor, fault: Tensor, trust: Tensor | None
    ) -> TensorDict:
        """A tensordict that shares no memory with the env."""
        values = {key: state[key].clone() for key in self._state_sizes}
        values[FAULT] = fault
        if self.guard and trust is not None:
            values[TRUST] = trust
        values[OBSERVATION] = self.task.observation(state).to(torch.float32)
        values["joint_torque"] = torque
        return TensorDict._new_unsafe(
            values, batch_size=self.batch_size, device=self.device
        )
