"""Tasks of the dm_control suite in any dynamics: the suite's own code, envs of tensors."""

from collections.abc import Callable
from math import ceil

import numpy as np
import torch
from torch import Tensor

from torchrl_nerd.compiled import uncompiled
from torchrl_nerd.keys import ACTION, QPOS, QVEL, SENSORDATA, TARGET
from torchrl_nerd.scenes import Scene, import_scene
from torchrl_nerd.scenes.controllers import ActuatorController
from torchrl_nerd.tasks.suite_reward import SuiteReward
from torchrl_nerd.tasks.task import State, Task


class SuiteTask(Task):
    """Reward, observation, resets and time limit of ``dm_control/DOMAIN-TASK``.

    They are the suite's, unchanged, and each env costs its Python. The observation is the
    suite's, flattened in its order; an action of -1 to 1 spans the control range. A task
    that reads contact forces (hopper's feet) is shown those of the ground truth's last
    substep, as in the suite. Learned dynamics know none: there MuJoCo computes them at
    the state and the action that led to it.

    Args:
        name: such as ``"dm_control/cheetah-run"``.
        frame_skip: control steps over which an action is held; only the last of
            them is judged.

    Raises:
        ValueError: in one sentence, no such task or something not supported.

    Examples:
        >>> task = SuiteTask("dm_control/pendulum-swingup")
        >>> task.horizon, task.observation_size
        (1000, 3)
    """

    num_uniforms = 1

    def __init__(self, name: str, frame_skip: int = 1) -> None:
        self.name, self.frame_skip = name, frame_skip
        domain, _, task = name.removeprefix("dm_control/").partition("-")
        model = self.scene.model  # refuses what is not supported
        judge = SuiteReward(domain, task)
        self.horizon = ceil(judge.horizon / frame_skip)
        self.observation_size = judge.observation_size
        width = 3 * len(judge.targets)
        self.parameters = {TARGET: width} if width else {}
        self._sizes = (model.nq, model.nv, width)
        self._forces, self._num_ctrl = judge.forces, model.nu
        self._start, self._judge = _RowMemo(judge.start), _RowMemo(judge)

    def build_scene(self) -> Scene:
        """The suite's robot and its ground."""
        return import_scene(self.name)

    def initial_state(self, u: Tensor) -> dict[str, Tensor]:
        """By the suite's ``initialize_episode``, seeded with u."""
        qpos, qvel, target = _on_rows(self._start, u).split(self._sizes, -1)
        targets = {TARGET: target} if self.parameters else {}
        return {QPOS: qpos, QVEL: qvel, **targets}

    def observation(self, state: State) -> Tensor:
        """The suite's, flattened in its order."""
        return self._judged(state)[..., 2:]

    def reward(self, state: State, action: Tensor, next_state: State) -> Tensor:
        """The suite's, of the state that the step led to and the action."""
        return self._judged(dict(next_state.items()) | {ACTION: action})[..., 0]

    def terminated(self, next_state: State) -> Tensor:
        """Where the suite ends an episode before its time."""
        return self._judged(next_state)[..., 1] > 0.0

    def _judged(self, state: State) -> Tensor:
        """Reward, end and observation of each env; the control is zero after a reset."""
        qpos = state[QPOS]
        ctrl = qpos.new_zeros(*qpos.shape[:-1], self._num_ctrl)
        if ACTION in state.keys():
            controller = self.controller
            assert isinstance(controller, ActuatorController)
            ctrl = controller.ctrl(state[ACTION].to(qpos.dtype))
        felt = qpos.new_full((*qpos.shape[:-1], len(self._forces)), torch.nan)
        if SENSORDATA in state.keys():
            felt = state[SENSORDATA][..., self._forces]
        target = [state[key] for key in self.parameters]
        row = torch.cat((qpos, state[QVEL], *target, ctrl, felt), -1)
        return _on_rows(self._judge, row)


class _RowMemo:
    """A slow function of rows; a row that is the same as last time keeps its answer."""

    def __init__(self, function: Callable[[np.ndarray], np.ndarray]) -> None:
        self.function = function
        self._given, self._answers = np.zeros((0, 0)), np.zeros((0, 0))

    def __call__(self, rows: np.ndarray) -> np.ndarray:
        """Answers to ``rows (n, k)``; of the same n and k as last time, or all anew."""
        is_known = np.zeros(len(rows), bool)
        if rows.shape == self._given.shape:
            is_known = (rows.view(np.int64) == self._given.view(np.int64)).all(-1)
        answers = [
            self._answers[i] if is_known[i] else self.function(row)
            for i, row in enumerate(rows)
        ]
        self._given, self._answers = rows, np.array(answers)
        return self._answers


@uncompiled
def _on_rows(function: _RowMemo, rows: Tensor) -> Tensor:
    """A function of NumPy rows ``(n, k)``, of float64 tensors ``(*batch, k)``."""
    flat = rows.double().flatten(0, -2).cpu().contiguous().numpy().copy()
    answers = torch.from_numpy(function(flat).copy())
    return answers.to(rows.device).unflatten(0, rows.shape[:-1])
