"""The learned stand-in for the solver; everything round it is shared with the truth."""

from collections.abc import Mapping
from typing import Any, Literal, cast

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor

from torchrl_nerd.compiled import Compiled
from torchrl_nerd.dynamics.base import check_step
from torchrl_nerd.keys import QPOS, QVEL
from torchrl_nerd.modules.nerd import TOKEN, Memory, NeRD, Network
from torchrl_nerd.modules.window import WindowNetwork
from torchrl_nerd.row_threads import RowThreads, parts_of

Inference = Literal["streaming", "window"]


def _of_tensors(guards: list[Any]) -> list[bool]:
    """Which of a compiled step's checks are made: of tensors, and of torch's own state.

    The thousand that ask in every step whether the model is still made of the same parts
    take a tenth of a small one's time.
    """
    return [
        not guard.is_global
        and (guard.guard_type == "TENSOR_MATCH" or "self." not in guard.name)
        for guard in guards
    ]


# A second thread waits in a short loop for longer than it works, and Python takes as long
# to call one; so one thread, called from C++, and rows in parts if that is not enough. For
# a number of rows each: code for any number takes longer, to compile four times as long.
SHORT_LOOPS = {
    "dynamic": False,
    "options": {
        "cpp.threads": 1,
        "cpp_wrapper": True,
        "guard_filter_fn": _of_tensors,
    },
}
LEAST_WORK = (
    2048  # rows times dofs of a part: less takes longer to hand over than it saves
)


class NeRDDynamics:
    """A `NeRD` model with the history of every row.

    The history is private: a ring of keys and values (streaming) or of tokens (window),
    never a key of a tensordict, or every collector would store it.

    Args:
        model: weights, features and statistics.
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
        if inference not in ("streaming", "window"):
            raise ValueError(
                f"expected inference 'streaming' or 'window', got '{inference}'"
            )
        if window < 1:
            raise ValueError(f"expected a window of at least 1 token, got {window}")
        self.scene = model.scene
        self.model = model.eval()
        self.compile = compile
        self.differentiable = differentiable
        network = cast(Network, model.network)
        if inference == "window":
            network = WindowNetwork(model.network, window, model.token_size)
        self.network: Network = network
        self._memory: Memory | None = None
        self._rows = 0
        self._compiled = Compiled(self._predict, **self.compile_options)
        self._in_parts = RowThreads(self._compiled)

    @property
    def compile_options(self) -> Mapping[str, Any]:
        """Of `torch.compile`, for a step."""
        model = self.model
        is_short = model.has_short_loops and model.device.type == "cpu"
        return SHORT_LOOPS if is_short else {}

    def parts(self, rows: int) -> int:
        """In how many parts, each on a thread of its own, a compiled step is made."""
        is_whole = self.differentiable or self._compiled.is_eager
        if is_whole or not self.compile_options:
            return 1
        return parts_of(rows, max(1, LEAST_WORK // self.scene.layout.nv))

    def reset(self, state: TensorDictBase, rows: Tensor | None = None) -> None:
        """Empty the history of ``rows`` and leave the others bitwise as they are."""
        count = state[QPOS].shape[0]
        if rows is None or rows.all() or self._rows != count:
            self._memory, self._rows = self.network.empty_memory(count), count
        elif self._memory is not None and rows.any():
            self._memory.clear(rows.reshape(count).to(self.model.device))

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
        """`step`, and how unfamiliar its input was, see `Coverage.distance`.

        Returns:
            The next state, and the distance ``(num_envs,)`` where it was asked for.
        """
        check_step(self.scene, state, joint_torque, terrain)
        there, here = state[QPOS].device, self.model.device
        qpos, qvel = state[QPOS].to(here), state[QVEL].to(here)
        ground = None if terrain is None else terrain.to(here)
        if self._memory is None or self._rows != len(qpos):
            self._rows = len(qpos)
            self._memory = self.network.empty_memory(self._rows)
        given = qpos, qvel, joint_torque.to(qpos), ground, self._memory, is_scored
        with torch.set_grad_enabled(self.differentiable):
            next_qpos, next_qvel, distance = self._run(given)
        after = TensorDict(
            {QPOS: next_qpos.to(there), QVEL: next_qvel.to(there)},
            batch_size=state.batch_size,
            device=state.device,
        )
        return after, None if distance is None else distance.to(there)

    def _run(self, given: tuple) -> tuple[Tensor, Tensor, Tensor | None]:
        """`_predict`, as it is or compiled, of all rows at once or in parts."""
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
        torque: Tensor,
        terrain: Tensor | None,
        memory: Memory,
        is_scored: bool,
    ) -> tuple[Tensor, Tensor, Tensor | None]:
        """Next ``qpos`` and ``qvel``, the input's distance; advances ``memory``."""
        model = self.model
        raw = model.tokens(qpos, qvel, torque, terrain)
        features = model.normalize.normalize(TOKEN, raw)
        token = model.assemble(features, qpos, qvel, torque, terrain)
        after = model.decode(qpos, qvel, self.network.step(token, memory))
        if model.flight is not None:
            gap = model.tokens.gap(raw)
            after = model.flight((qpos, qvel), torque, terrain, gap, after)
        distance = model.coverage.distance(features) if is_scored else None
        return after[0], after[1], distance
