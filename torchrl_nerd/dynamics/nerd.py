"""Learned and hybrid dynamics: a `NeRD` with the history of every env."""

from typing import Any, Literal, cast

from tensordict import TensorDictBase
from torch import Tensor

from torchrl_nerd.dynamics.torch_step import TorchDynamics
from torchrl_nerd.keys import QPOS
from torchrl_nerd.modules.nerd import NeRD, Network
from torchrl_nerd.modules.window import WindowNetwork

Inference = Literal["streaming", "window"]


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
        if inference not in ("streaming", "window"):
            raise ValueError(
                f"expected inference 'streaming' or 'window', got '{inference}'"
            )
        if window < 1:
            raise ValueError(f"expected a window of at least 1 token, got {window}")
        self.model = model.eval()
        self.kind = model.kind
        network = cast(Network, model.network)
        if inference == "window":
            network = WindowNetwork(model.network, window, model.token_size)
        self.network: Network = network
        is_single = model.compile_single_threaded
        super().__init__(model.scene, model.device, compile, differentiable, is_single)

    def reset(self, state: TensorDictBase, rows: Tensor | None = None) -> None:
        """Empty the history of ``rows`` and leave the others bitwise as they are."""
        count = state[QPOS].shape[0]
        if rows is None or rows.all() or self._rows != count:
            self._memory, self._rows = self.network.empty_memory(count), count
        elif self._memory is not None and rows.any():
            self._memory.clear(rows.reshape(count).to(self.device))

    def _prepare(self, rows: int) -> None:
        if self._memory is None or self._rows != rows:
            self._rows, self._memory = rows, self.network.empty_memory(rows)

    def _predict(
        self,
        qpos: Tensor,
        qvel: Tensor,
        joint_torque: Tensor,
        terrain: Tensor | None,
        memory: Any,
        is_scored: bool,
    ) -> tuple[Tensor, Tensor, Tensor | None]:
        def network_step(token: Tensor) -> Tensor:
            return self.network.step(token, memory)

        model = self.model
        next_qpos, next_qvel, features = model.step(
            (qpos, qvel), joint_torque, terrain, network_step
        )
        score = model.ood_score(features) if is_scored else None
        return next_qpos, next_qvel, score
