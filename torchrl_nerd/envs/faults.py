"""What can go wrong in an env, found env by env, and written to a file.

A fault ends its env as ``terminated`` at its last good state and leaves the others bitwise
as they are. With a folder, the first fault of each kind leaves a dump there: the last
states, torques, actions and the ground of one such env, in its present episode.
"""

from collections import deque
from collections.abc import Mapping
from pathlib import Path
from typing import Any, cast

import torch
from torch import Tensor

from torchrl_nerd.files import writable_folder
from torchrl_nerd.keys import FAULT, QPOS, QVEL
from torchrl_nerd.tensor_files import write_tensors

REASONS = ("none", "action", "diverged", "runaway")
"""Meaning of ``fault``: no fault; an action that is not finite; a next state that is not;
one that is faster than `LARGEST_SPEED` or farther away than `FARTHEST`."""

LARGEST_SPEED = 1e4  # m/s and rad/s
FARTHEST = 1e9  # m and rad
HISTORY = 16  # control steps in a dump


def find_faults(
    action: Tensor, state: Mapping[str, Tensor], moved: Mapping[str, Tensor]
) -> Tensor:
    """The reason of each env's fault, an index of `REASONS`, int64 ``(num_envs, 1)``.

    Of ``action (num_envs, num_actions)``, the ``state`` before the step, since a model may
    slow down what ran away, and the next ``qpos`` and ``qvel`` in ``moved``.
    """
    qpos, qvel = moved[QPOS], moved[QVEL]
    far, fast = (torch.maximum(state[k].abs(), moved[k].abs()) for k in (QPOS, QVEL))
    runs = torch.any(fast > LARGEST_SPEED, -1) | torch.any(far > FARTHEST, -1)
    is_finite = torch.all(qpos.isfinite(), -1) & torch.all(qvel.isfinite(), -1)
    fault = torch.where(is_finite, 3 * runs.long(), 2)  # (num_envs,)
    return torch.where(torch.all(action.isfinite(), -1), fault, 1)[:, None]


class _FiniteGradient(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, x: Tensor) -> Tensor:
        return x.view_as(x)

    @staticmethod
    def backward(ctx: Any, *grads: Tensor) -> Tensor:
        (grad,) = grads  # (num_envs, size)
        return torch.where(grad.isfinite().all(-1, keepdim=True), grad, 0.0)


def finite_gradient(x: Tensor) -> Tensor:
    """``x (num_envs, size)``, whose gradient is zero in envs where it is not finite.

    An env that diverged keeps its last state, so its next state has no gradient. But zero
    times what is not finite is none either, and all envs share a policy's weights.
    """
    return cast(Tensor, _FiniteGradient.apply(x))


class FaultRecorder:
    """Dumps of the first fault of every kind, in safetensors files named by it.

    Args:
        folder: where; made if it is not there.
        about: names of the ``scene`` and of the ``dynamics``, kept in the dump.

    Raises:
        ValueError: the folder cannot be written.
    """

    def __init__(self, folder: Path | str, about: dict[str, str]) -> None:
        self.folder, self.about = writable_folder(Path(folder)), about
        self._steps: deque[dict[str, Tensor]] = deque(maxlen=HISTORY)
        self._written: set[int] = set()

    def record(
        self,
        state: Mapping[str, Tensor],
        action: Tensor,
        after: Mapping[str, Tensor],
        age: Tensor,
    ) -> None:
        """Keep a step, ``(num_envs, size)`` each; dump each kind of fault that is new.

        The ``state`` before it, the ``action`` as it was given, the joint torque and the
        fault in ``after`` it, and how old each episode was, ``age (num_envs,)``.
        """
        torque, fault = after["joint_torque"], after[FAULT]
        step = {**state, "action": action, "joint_torque": torque}
        self._steps.append({k: v.detach().cpu().clone() for k, v in step.items()})
        for kind in fault.unique().tolist():
            if kind and kind not in self._written:
                self._written.add(kind)
                env = int((fault == kind).nonzero()[0, 0])
                self._write(kind, env, 1 + int(age[env]))

    def _write(self, kind: int, env: int, count: int) -> None:
        # at most `HISTORY`, the oldest first, none before the reset: (T, n) each
        steps = list(self._steps)[-count:]
        tensors = {k: torch.stack([s[k][env] for s in steps]) for k in steps[0]}
        about = {**self.about, "reason": REASONS[kind], "env": str(env)}
        path = self.folder / f"fault_{REASONS[kind]}.safetensors"
        write_tensors(path, tensors, about)
