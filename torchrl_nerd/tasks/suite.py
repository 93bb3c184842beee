"""Tasks of the dm_control suite in any dynamics: the suite's own code, envs of tensors."""

import copy
from collections.abc import Callable
from functools import cached_property
from math import ceil

import mujoco
import numpy as np
import torch
from mujoco import MjData, MjModel
from torch import Tensor

from torchrl_nerd.compiled import uncompiled
from torchrl_nerd.keys import ACTION, QPOS, QVEL, SENSORDATA, TARGET
from torchrl_nerd.locks import fork_safe_lock
from torchrl_nerd.scenes import Scene, import_scene
from torchrl_nerd.scenes.importer import load_suite, suite_name
from torchrl_nerd.tasks.suite_formulas import FORMULAS, Formula
from torchrl_nerd.tasks.task import State, Task, own_actuators

SEEDS = 2**32  # of NumPy's RandomState, which the suite draws from
FORCES = mujoco.mjtStage.mjSTAGE_ACC  # sensors of this stage need the contact forces
PARTS = (  # of mj_forward: positions, velocities and the sensors of both
    mujoco.mj_kinematics,
    mujoco.mj_comPos,
    mujoco.mj_comVel,
    mujoco.mj_subtreeVel,  # or its sensors would read what the env before left
    mujoco.mj_sensorPos,
    mujoco.mj_sensorVel,
)


class SuiteTask(Task):
    """Reward, observation, resets and time limit of ``dm_control/DOMAIN-TASK``.

    They are the suite's: as functions of tensors for the domains in `FORMULAS`, else by
    its own code, env by env, as all resets are. The observation is the suite's, flattened
    in its order; an action of -1 to 1 spans the control range. A task that reads contact
    forces (hopper's feet) is shown those of the ground truth's last substep, as in the
    suite. Learned dynamics know none: there MuJoCo computes them at the state and the
    action that led to it.

    With ``dm_control/DOMAIN-TASK/4`` an action is held over four of the suite's control
    steps. They are one control step here, which a model predicts at once, and only the
    state after the last is judged.

    Raises:
        ValueError: in one sentence, no such task or something not supported.
    """

    num_uniforms = 1

    def __init__(self, name: str) -> None:
        self.name = name
        model = self.scene.model  # refuses what is not supported
        suite = SuiteReward(name)
        self.horizon = suite.horizon
        self.observation_size = suite.observation_size
        width = 3 * len(suite.targets)
        self.parameters = {TARGET: width} if width else {}
        self._sizes = (model.nq, model.nv, width)
        self._forces, self._targets = suite.forces, suite.targets
        self._start = _RowMemo(suite.start, sum(self._sizes))
        self._judge = _RowMemo(suite.judge, 2 + suite.observation_size)
        self._names = suite.domain, suite.task

    def build_scene(self) -> Scene:
        """The suite's robot and its ground."""
        return import_scene(self.name)

    @cached_property
    def _formula(self) -> Formula | None:
        """Of its domain, where there is one."""
        domain, task = self._names
        return FORMULAS[domain](self.scene, task) if domain in FORMULAS else None

    def initial_state(self, u: Tensor) -> dict[str, Tensor]:
        """By the suite's ``initialize_episode``, seeded with u."""
        qpos, qvel, target = self._start(u).split(self._sizes, -1)
        targets = {TARGET: target} if self.parameters else {}
        return {QPOS: qpos, QVEL: qvel, **targets}

    def observation(self, state: State) -> Tensor:
        """The suite's, flattened in its order."""
        formula, knows_forces = self._formula, SENSORDATA in state.keys()
        if formula is None or (formula.reads_forces and not knows_forces):
            return self._judged(state)[..., 2:]
        return formula.observation(state[QPOS], state[QVEL], self._extra(state))

    def reward(self, state: State, action: Tensor, next_state: State) -> Tensor:
        """The suite's, of the state that the step led to and the action."""
        if self._formula is None:
            return self._judged(dict(next_state.items()) | {ACTION: action})[..., 0]
        qpos, qvel = next_state[QPOS], next_state[QVEL]
        ctrl = own_actuators(self).ctrl(action.to(qpos.dtype))
        return self._formula.reward(qpos, qvel, ctrl, self._extra(next_state))

    def terminated(self, next_state: State) -> Tensor:
        """Where the suite ends an episode before its time."""
        if self._formula is not None:  # it ends none of these
            return super().terminated(next_state)
        return self._judged(next_state)[..., 1] > 0.0

    def show(self, model: MjModel, data: MjData, state: State) -> None:
        """Its targets, where this episode has them."""
        if self.parameters:
            model.geom_pos[self._targets] = state[TARGET].cpu().reshape(-1, 3)

    def _extra(self, state: State) -> Tensor:
        """Targets, or forces felt, where the task has any, ``(*batch, k)``."""
        if self.parameters:
            return state[TARGET]
        felt = state.get(SENSORDATA)
        none = state[QPOS][..., :0]
        return none if felt is None else felt[..., self._forces].to(none.dtype)

    def _judged(self, state: State) -> Tensor:
        """Reward, end and observation of each env; the control is zero after a reset."""
        qpos = state[QPOS]
        ctrl = qpos.new_zeros(*qpos.shape[:-1], self.scene.model.nu)
        if ACTION in state.keys():
            ctrl = own_actuators(self).ctrl(state[ACTION].to(qpos.dtype))
        felt = qpos.new_full((*qpos.shape[:-1], len(self._forces)), torch.nan)
        if SENSORDATA in state.keys():
            felt = state[SENSORDATA][..., self._forces]
        target = [state[key] for key in self.parameters]
        judged = torch.cat((qpos, state[QVEL], *target, ctrl, felt), -1)
        return self._judge(judged)


class SuiteReward:
    """Reset distribution, reward, observation and end of one task, env by env.

    The suite's `Task` reads a `Physics`. Here that `Physics` is never stepped: a state is
    written in and only what the suite reads is brought up to date. A task may be shared by
    threads: they take turns.

    Raises:
        ValueError: no such task, one without a time limit, or one that changes more at
            a reset than where its targets are.
    """

    def __init__(self, name: str) -> None:
        self.domain, self.task, hold = suite_name(name)
        env = load_suite(self.domain, self.task)
        self._task, self._physics = env.task, env.physics
        if not np.isfinite(env._step_limit):
            raise ValueError(f"task '{name}' has no time limit: not supported")
        self.horizon = ceil(env._step_limit / hold)
        # geoms that it places at each reset and that touch nothing
        self.targets = np.zeros(0, int)
        self.targets = self._moved_geoms(name)
        self.observation_size = len(self._observe())
        # entries of sensordata that need contact forces
        needs_forces = self._model.sensor_needstage == FORCES
        self.forces = np.flatnonzero(np.repeat(needs_forces, self._model.sensor_dim))

    @property
    def _model(self) -> mujoco.MjModel:
        return self._physics.model.ptr

    def start(self, u: np.ndarray) -> np.ndarray:
        """Start of an episode by the suite's own ``initialize_episode``.

        Its random state is seeded with ``u (1,)`` in [0, 1). Returns qpos, qvel and the
        targets' positions, ``(nq + nv + 3 targets,)``.
        """
        self._task.random.seed(int(u[0] * SEEDS))
        with self._physics.reset_context():
            self._task.initialize_episode(self._physics)
        data, target = self._physics.data.ptr, self._model.geom_pos[self.targets]
        return np.concatenate((data.qpos, data.qvel, target.ravel()))

    def judge(self, state: np.ndarray) -> np.ndarray:
        """Reward, whether the episode ends (0 or 1), and observation of one state.

        ``state``: qpos, qvel, the targets' positions, ctrl and the `forces` felt. These
        are NaN where nobody knows them: MuJoCo then computes them at this state.
        """
        model, data = self._model, self._physics.data.ptr
        sizes = (model.nq, model.nv, 3 * len(self.targets), model.nu)
        data.qpos, data.qvel, target, data.ctrl, felt = np.split(
            state, np.cumsum(sizes)
        )
        model.geom_pos[self.targets] = target.reshape(-1, 3)
        if np.isnan(felt).any():
            data.qacc_warmstart = 0.0  # nothing is left of the env before
            mujoco.mj_forward(model, data)
        else:
            for update in PARTS:
                update(model, data)
            data.sensordata[self.forces] = felt
        reward = self._task.get_reward(self._physics)
        is_end = self._task.get_termination(self._physics) is not None
        return np.concatenate(((reward, is_end), self._observe()))

    def _observe(self) -> np.ndarray:
        observation = self._task.get_observation(self._physics)
        return np.concatenate([np.ravel(part) for part in observation.values()])

    def _moved_geoms(self, name: str) -> np.ndarray:
        """Geoms that are elsewhere at another reset; nothing else may be different."""
        models = []
        for u in (0.25, 0.75):
            self.start(np.array([u]))
            models.append(copy.copy(self._model))
        first, second = models
        moved = np.flatnonzero((first.geom_pos != second.geom_pos).any(-1))
        touches = second.geom_contype[moved] | second.geom_conaffinity[moved]
        has_contacts = not second.opt.disableflags & mujoco.mjtDisableBit.mjDSBL_CONTACT
        second.geom_pos[:], second.light_pos[:] = first.geom_pos, first.light_pos
        is_same = np.array_equal(_bytes(first), _bytes(second))
        if not is_same or (has_contacts and touches.any()):
            raise ValueError(
                f"task '{name}' changes its robot at every reset: not supported"
            )
        return moved


def _bytes(model: mujoco.MjModel) -> np.ndarray:
    """All that a model is made of."""
    buffer = np.empty(mujoco.mj_sizeModel(model), np.uint8)
    mujoco.mj_saveModel(model, None, buffer)
    return buffer


_ONE_AT_A_TIME = fork_safe_lock()


class _RowMemo:
    """A slow function of NumPy rows; answers of the last call are known in the next."""

    def __init__(
        self, function: Callable[[np.ndarray], np.ndarray], width: int
    ) -> None:
        self.function, self.width = function, width  # numbers of an answer
        self._answers: dict[bytes, np.ndarray] = {}

    @uncompiled
    def __call__(self, rows: Tensor) -> Tensor:
        """Answers to ``rows (*batch, k)``, in float64."""
        flat = rows.double().reshape(-1, rows.shape[-1]).cpu().numpy()
        with _ONE_AT_A_TIME:  # one `Physics`, written in and read
            known, self._answers = self._answers, {}
            keys = [row.tobytes() for row in flat]
            for key, row in zip(keys, flat, strict=True):
                if key not in self._answers:
                    found = known[key] if key in known else self.function(row)
                    self._answers[key] = found
            answers = np.array([self._answers[key] for key in keys])
        answers = answers.reshape(len(flat), self.width)  # of no rows too
        found = torch.from_numpy(answers).to(rows.device)
        return found.reshape(*rows.shape[:-1], self.width)
