"""Dynamics that torch computes: devices, compilation, and threads of envs."""

from collections.abc import Mapping
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor

from torchrl_nerd.compiled import Compiled
from torchrl_nerd.dynamics.base import check_step
from torchrl_nerd.keys import QPOS, QVEL
from torchrl_nerd.row_threads import RowThreads, parts_of
from torchrl_nerd.scenes.scene import Scene


def _keep_tensor_guards(guards: list[Any]) -> list[bool]:
    """Which checks a compiled step keeps: those of tensors and of torch's own state.

    The other thousand, whether the model is still made of the same parts, take a tenth of
    a small model's time.
    """
    return [
        not guard.is_global
        and (guard.guard_type == "TENSOR_MATCH" or "self." not in guard.name)
        for guard in guards
    ]


# A step of hundreds of short loops: OpenMP's second thread waits longer than it works. So
# one thread, called from C++ (which spares Python's overhead), and envs in parts on threads
# of their own. Compiled for each number of envs: dynamic shapes are slower and take four
# times as long to compile.
SINGLE_THREADED = {
    "dynamic": False,
    "options": {
        "cpp.threads": 1,
        "cpp_wrapper": True,
        "guard_filter_fn": _keep_tensor_guards,
    },
}
MIN_WORK = (
    2048  # envs times dofs of a part: less takes longer to hand over than it saves
)


class TorchDynamics:
    """Steps a batch of envs with a function of tensors, eager or compiled.

    A subclass gives ``_predict(qpos, qvel, joint_torque, terrain, memory, is_scored)`` and,
    where it has a history, ``_memory``.

    Args:
        scene: the robot.
        device: where it computes; states may live elsewhere.
        compile: run through `torch.compile`; without a compiler, eager with a warning.
        differentiable: record gradients through the step.
        is_single_threaded: compile for one thread, see `SINGLE_THREADED`.
    """

    kind: str
    _memory: Any = None

    def __init__(
        self,
        scene: Scene,
        device: torch.device,
        compile: bool,
        differentiable: bool,
        is_single_threaded: bool,
    ) -> None:
        self.scene, self.device = scene, device
        self.compile, self.differentiable = compile, differentiable
        self.is_single_threaded = is_single_threaded
        self._rows = 0
        self._compiled = Compiled(self._predict, **self.compile_options)
        self._in_parts = RowThreads(self._compiled)

    @property
    def compile_options(self) -> Mapping[str, Any]:
        """Of `torch.compile`, for a step."""
        is_single = self.is_single_threaded and self.device.type == "cpu"
        return SINGLE_THREADED if is_single else {}

    def parts(self, rows: int) -> int:
        """In how many parts, each on a thread of its own, a compiled step is made."""
        is_whole = self.differentiable or self._compiled.is_eager
        if is_whole or not self.compile_options:
            return 1
        return parts_of(rows, max(1, MIN_WORK // self.scene.layout.nv))

    def reset(self, state: TensorDictBase, rows: Tensor | None = None) -> None:
        """See `Dynamics.reset`; there is no history to empty."""

    def step(
        self,
        state: TensorDictBase,
        joint_torque: Tensor,
        terrain: Tensor | None = None,
    ) -> TensorDictBase:
        """See `Dynamics.step`."""
        return self.scored_step(state, joint_torque, terrain, is_scored=False)[0]

    def scored_step(
        self,
        state: TensorDictBase,
        joint_torque: Tensor,
        terrain: Tensor | None = None,
        is_scored: bool = True,
    ) -> tuple[TensorDictBase, Tensor | None]:
        """`step`, and the out-of-distribution score ``(num_envs,)`` of its input.

        The score is None where it was not asked for or the dynamics has none.
        """
        check_step(self.scene, state, joint_torque, terrain)
        there, here = state[QPOS].device, self.device
        qpos, qvel = state[QPOS].to(here), state[QVEL].to(here)
        ground = None if terrain is None else terrain.to(here)
        self._prepare(len(qpos))
        given = qpos, qvel, joint_torque.to(qpos), ground, self._memory, is_scored
        with torch.set_grad_enabled(self.differentiable):
            next_qpos, next_qvel, score = self._run(given)
        after = TensorDict(
            {QPOS: next_qpos.to(there), QVEL: next_qvel.to(there)},
            batch_size=state.batch_size,
            device=state.device,
        )
        return after, None if score is None else score.to(there)

    def _prepare(self, rows: int) -> None:
        """What a step of so many envs needs beforehand."""
        self._rows = rows

    def _run(self, given: tuple) -> tuple[Tensor, Tensor, Tensor | None]:
        """`_predict`, eager or compiled, of all envs at once or in parts."""
        if not self.compile:
            return self._predict(*given)
        if not torch.compiler.is_compiling():
            parts = self.parts(self._rows)
            if parts > 1:
                return self._in_parts(parts, *given)
        return self._compiled(*given)

    def _predict(
        self,
        qpos: Tensor,
        qvel: Tensor,
        joint_torque: Tensor,
        terrain: Tensor | None,
        memory: Any,
        is_scored: bool,
    ) -> tuple[Tensor, Tensor, Tensor | None]:
        """Next ``qpos`` and ``qvel``, the input's score; advances ``memory``."""
        raise NotImplementedError
