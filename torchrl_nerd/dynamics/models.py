"""Dynamics that torch computes: learned, hybrid and analytic models as `Dynamics`."""

import copy
from typing import Any, Literal, get_args

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor

from torchrl_nerd.analytic import AnalyticStep
from torchrl_nerd.compiled import Compiled, RowThreads, parts_of, unaffected
from torchrl_nerd.dynamics.base import Dynamics, check_step
from torchrl_nerd.geometry.manifold import normalize_pos
from torchrl_nerd.keys import PARAMETERS, QPOS, QVEL
from torchrl_nerd.modules.history import History, WindowNetwork
from torchrl_nerd.modules.nerd import NeRD
from torchrl_nerd.scenes.commands import drive_of
from torchrl_nerd.scenes.controllers import clip, ctrl_range
from torchrl_nerd.scenes.variation import ranges_of

Inference = Literal["streaming", "window"]

OOD_SCORE = "ood_score"

Prediction = tuple[Tensor, Tensor, Tensor | None]
"""Next ``qpos`` and ``qvel``, and the out-of-distribution score of the input."""

Model = NeRD | AnalyticStep
"""Learned, hybrid (a `NeRD`) or analytic; ``kind`` says which."""


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
# Envs of a part, times dofs and what is kept of an env's past: handing over less takes
# longer than it saves.
MIN_WORK, NUMBERS_PER_DOF = 1536, 4096


class TorchDynamics(Dynamics):
    """Steps a batch of envs with a function of tensors, eager or compiled.

    A subclass gives ``_predict`` and, where it has a history, ``_memory``.
    """

    _memory: Any = None

    def __init__(self, model: Model, compile: bool, differentiable: bool) -> None:
        super().__init__(model.scene)
        self.device, self.kind = model.device, model.kind
        self.compile, self.differentiable = compile, differentiable
        # compiled steps are long code for one thread of the processor
        is_single = model.compile_single_threaded and self.device.type == "cpu"
        self.is_single_threaded = is_single
        self.compile_options: dict[str, Any] = SINGLE_THREADED if is_single else {}
        if self.device.type == "cuda":
            self.compile_options = {"dynamic": False}
        numbers = (x for x in model.buffers() if x.is_floating_point())
        self.state_dtype = next((x.dtype for x in numbers), torch.float64)
        self._compiled = Compiled(self._predict_as_read, **self.compile_options)
        self._in_parts = RowThreads(self._compiled)
        self._row_work = self.scene.layout.nv
        self._ctrl_range = ctrl_range(self.scene.model)

    def parts(self, num_envs: int) -> int:
        """In how many parts, each on a thread of its own, a compiled step is made."""
        is_whole = self.differentiable or self._compiled.is_eager
        if is_whole or not self.is_single_threaded:
            return 1
        return parts_of(num_envs, max(1, MIN_WORK // self._row_work))

    def history(self) -> Any:
        """See `Dynamics.history`."""
        return copy.copy(self._memory)

    @unaffected
    def restore(self, history: Any, is_restored: Tensor) -> None:
        """See `Dynamics.restore`."""
        # a copy: autograd cannot save a mask that was made in inference mode
        envs = is_restored.to(self.device, copy=self.differentiable)
        with torch.set_grad_enabled(self.differentiable):
            if history is not None:
                self._memory.restore(history, envs)
            elif self._memory is not None:
                self._memory.clear(envs)

    @unaffected
    def step(
        self,
        state: TensorDictBase,
        joint_torque: Tensor,
        terrain: Tensor | None = None,
        ctrl: Tensor | None = None,
        is_scored: bool = False,
    ) -> TensorDictBase:
        """See `Dynamics.step`.

        Where it ``is_scored`` and the dynamics is learned, the next state also holds the
        out-of-distribution score of the step's input as ``ood_score (num_envs,)``.

        Raises:
            ValueError: no joint torque; servos without ``ctrl``.
        """
        if joint_torque is None:
            raise ValueError("expected a joint torque, got none")
        check_step(self.scene, state, joint_torque, terrain, ctrl)
        if ctrl is None and self.scene.servos is not None:
            raise ValueError(
                f"scene '{self.scene.name}' has servos, which a model knows by their "
                "ctrl: got none"
            )
        there, here = state[QPOS].device, self.device
        qpos, qvel = (state[key].to(here, self.state_dtype) for key in (QPOS, QVEL))
        ground = None if terrain is None else terrain.to(qpos)
        self._prepare(len(qpos))
        held = None
        if self.scene.servos is not None and ctrl is not None:  # as MuJoCo reads it
            held = clip(ctrl.to(qpos), *self._ctrl_range)
        drive = drive_of(joint_torque.to(qpos), held, self._told(state, qpos))
        is_recorded = self.differentiable and torch.is_grad_enabled()
        if self.differentiable and not is_recorded:  # it is part of an earlier graph
            self._memory = self.history()
        given = qpos, qvel, drive, ground, self._memory, is_scored
        with torch.set_grad_enabled(is_recorded):
            next_qpos, next_qvel, score = self._run(given)
        moved = {QPOS: next_qpos.to(there), QVEL: next_qvel.to(there)}
        after = TensorDict(moved, state.batch_size, device=state.device)
        if PARAMETERS in state.keys():
            after[PARAMETERS] = state[PARAMETERS]
        if score is not None:
            after[OOD_SCORE] = score.to(there)
        return after

    def _told(self, state: TensorDictBase, like: Tensor) -> Tensor | None:
        """What the model is told of a varied scene's parameters."""

    def _prepare(self, num_envs: int) -> None:
        """What a step of so many envs needs beforehand."""

    def _run(self, given: tuple) -> Prediction:
        """`_predict`, eager or compiled, of all envs at once or in parts."""
        if not self.compile:
            return self._predict_as_read(*given)
        parts = 1 if torch.compiler.is_compiling() else self.parts(len(given[0]))
        return self._in_parts(parts, *given) if parts > 1 else self._compiled(*given)

    def _predict_as_read(self, qpos: Tensor, *given: Any) -> Prediction:
        """`_predict` with quaternions as MuJoCo reads them, of length one."""
        return self._predict(normalize_pos(self.scene.layout, qpos), *given)

    def _predict(self, *args: Any, **kwargs: Any) -> Prediction:
        """From qpos, qvel, drive, terrain, memory (advanced) and ``is_scored``."""
        raise NotImplementedError


class NeRDDynamics(TorchDynamics):
    """A `NeRD` model with the history of every env.

    The history is private: a ring of keys and values (streaming) or of tokens (window),
    never a key of a tensordict, or every collector would store it.

    Args:
        model: weights, features and statistics; learned or hybrid.
        inference: ``"streaming"`` computes one token a step; ``"window"`` recomputes the
            last ``window`` tokens, as the paper does.
        window: tokens recomputed in window mode (paper: h = 10).
        compile: run through `torch.compile`; without a compiler, eager with a warning.
        differentiable: record gradients through the step.

    Raises:
        ValueError: an unknown mode of inference, or a window below 1.
    """

    def __init__(
        self,
        model: NeRD,
        inference: Inference = "streaming",
        window: int = 10,
        compile: bool = False,
        differentiable: bool = False,
    ) -> None:
        if inference not in get_args(Inference):
            known = " or ".join(map(repr, get_args(Inference)))
            raise ValueError(f"expected inference {known}, got '{inference}'")
        if window < 1:
            raise ValueError(f"expected a window of at least 1 token, got {window}")
        self.model = model.eval()
        self.told = ranges_of(model.scene_features.variation)
        self.network = model.network
        if inference == "window":
            self.network = WindowNetwork(model.network, window, model.token_size)
        self._num_envs = 0  # in the memory
        super().__init__(model, compile, differentiable)
        if isinstance(memory := self.network.empty_memory(1), History):
            kept = sum(x.numel() for x in memory.tensors())
            self._row_work += kept // NUMBERS_PER_DOF

    @unaffected
    def reset(self, state: TensorDictBase, is_reset: Tensor | None = None) -> None:
        """See `Dynamics.reset`; the history of all other envs stays as it is."""
        count = len(state[QPOS])
        # gradients keep their history, and the past of all envs is forgotten
        if is_reset is None or (self.differentiable and bool(is_reset.all())):
            self._memory = None
        self._prepare(count)
        if is_reset is not None:  # no look at its values: they may be on the device
            self.restore(None, is_reset.reshape(count))

    def _told(self, state: TensorDictBase, like: Tensor) -> Tensor | None:
        features = self.model.scene_features
        if features.variation is None:
            return None
        if PARAMETERS not in state.keys():
            raise ValueError("expected parameters in the state, got none")
        return features.told(state[PARAMETERS].to(like))

    def _prepare(self, num_envs: int) -> None:
        if self._memory is None or self._num_envs != num_envs:
            self._memory = self.network.empty_memory(num_envs)
            self._num_envs = num_envs

    def _predict(
        self,
        qpos: Tensor,
        qvel: Tensor,
        drive: Tensor,
        terrain: Tensor | None,
        memory: Any,
        is_scored: bool,
    ) -> Prediction:
        def network_step(token: Tensor) -> Tensor:
            return self.network.step(token, memory)

        given = (qpos, qvel), drive, terrain, network_step
        next_qpos, next_qvel, features = self.model.step(*given)
        score = self.model.ood_score(features) if is_scored else None
        return next_qpos, next_qvel, score


class AnalyticDynamics(TorchDynamics):
    """An `AnalyticStep` as dynamics; it has no history. Arguments as `NeRDDynamics`'s."""

    def __init__(
        self, step: AnalyticStep, compile: bool = False, differentiable: bool = False
    ) -> None:
        self.analytic_step = step
        super().__init__(step, compile, differentiable)

    def _predict(self, *args: Any, **kwargs: Any) -> Prediction:
        qpos, qvel, joint_torque, terrain, *_ = args
        result = self.analytic_step(qpos, qvel, joint_torque, terrain)
        return result.qpos, result.qvel, None


def dynamics_of(model: Model, **how: Any) -> NeRDDynamics | AnalyticDynamics:
    """The dynamics of a learned, hybrid or analytic model.

    ``how``: arguments of `NeRDDynamics`; an analytic step ignores those of a history.
    """
    if isinstance(model, NeRD):
        return NeRDDynamics(model, **how)
    how = {k: v for k, v in how.items() if k not in ("inference", "window")}
    return AnalyticDynamics(model, **how)
