"""Learned dynamics that know where they were trained, and what to do elsewhere."""

from typing import Any, Literal, get_args

import torch
from tensordict import TensorDictBase
from torch import Tensor

from torchrl_nerd.dynamics.base import Dynamics
from torchrl_nerd.dynamics.models import OOD_SCORE, NeRDDynamics
from torchrl_nerd.dynamics.mujoco import MujocoDynamics
from torchrl_nerd.keys import PARAMETERS, QPOS, QVEL, TRUST

Guard = Literal["flag", "truncate", "raise", "fallback"]
"""What to do with an env that is not trusted: say so under ``trust``; also end its episode
as ``truncated``; refuse to go on; or let MuJoCo step it."""


class UntrustedError(RuntimeError):
    """An input too far from what the model was trained on."""


class GuardedDynamics(Dynamics):
    """A `NeRDDynamics` whose every step says how far its input may be trusted.

    ``trust`` is 1 where the input is as familiar as 99% of the training data, and else
    the inverse of `OODScore`: 0.5 is twice as far out. An env that is not finite has trust
    0. Envs below trust 1 are untrusted. In ``"fallback"`` MuJoCo steps them until they have
    been trusted for ``patience`` steps in a row: a swing that is too fast at its bottom is
    familiar at its top. The network sees the states of MuJoCo, so that it takes over again
    with their history.

    Args:
        learned: what steps the trusted envs.
        guard: what to do with the others.

    Raises:
        ValueError: an unknown guard, a model that does not know what it was trained on, or
            a fallback where torques may be late.
    """

    patience = 24  # control steps

    def __init__(self, learned: NeRDDynamics, guard: Guard = "flag") -> None:
        if guard not in (known := get_args(Guard)):
            raise ValueError(f"expected a guard of {', '.join(known)}, got '{guard}'")
        if not learned.model.training_range.is_fitted:
            raise ValueError(
                "expected a model that knows what it was trained on, got weights of an "
                "older version: train or fine-tune it again"
            )
        varied = learned.scene.variation
        if guard == "fallback" and varied is not None and varied.max_delay:
            raise ValueError(
                "expected torques without delay for the guard 'fallback', whose MuJoCo "
                f"starts anew at every step, got up to {varied.max_delay} steps"
            )
        super().__init__(learned.scene)
        self.kind, self.told = learned.kind, learned.told
        self.learned, self.guard = learned, guard
        self._calm = torch.zeros(0, dtype=torch.long)  # trusted steps in a row
        self.ground_truth = MujocoDynamics(self.scene) if guard == "fallback" else None

    def reset(self, state: TensorDictBase, is_reset: Tensor | None = None) -> None:
        """See `Dynamics.reset`."""
        self.learned.reset(state, is_reset)
        if is_reset is None:
            self._calm = self._calm[:0]
        elif len(self._calm) == is_reset.numel():
            self._calm = self._calm.masked_fill(is_reset.reshape(-1), self.patience)

    def history(self) -> tuple[Tensor, Any]:
        """See `Dynamics.history`."""
        return self._calm, self.learned.history()

    def restore(self, history: tuple[Tensor, Any], is_restored: Tensor) -> None:
        """See `Dynamics.restore`."""
        calm, past = history
        self.learned.restore(past, is_restored)
        if len(self._calm) == len(is_restored):
            known = calm if len(calm) == len(is_restored) else self.patience
            self._calm = torch.where(is_restored, known, self._calm)

    def step(
        self,
        state: TensorDictBase,
        joint_torque: Tensor,
        terrain: Tensor | None = None,
        ctrl: Tensor | None = None,
    ) -> TensorDictBase:
        """See `Dynamics.step`; the next state also holds ``trust (num_envs, 1)``.

        Raises:
            UntrustedError: with the guard ``"raise"``, naming the envs.
        """
        given = state, joint_torque, terrain, ctrl
        after = self.learned.step(*given, is_scored=True)
        distance = after.pop(OOD_SCORE)
        trust = (1.0 / distance.detach().clamp(min=1.0)).nan_to_num(0.0)
        is_untrusted = trust < 1.0
        if self.guard == "raise" and is_untrusted.any():
            raise UntrustedError(
                "expected inputs like those of training, got "
                f"{int(is_untrusted.sum())} of {len(trust)} envs beyond them, "
                f"first env {int(is_untrusted.nonzero()[0])}, "
                f"least trust {float(trust.min()):.2g}"
            )
        if self.ground_truth is None:
            return after.set(TRUST, trust[:, None].to(torch.float32))
        envs = self._not_yet_calm(is_untrusted)
        if envs.any():
            ground, told = (None if x is None else x[envs] for x in (terrain, ctrl))
            some = state.select(QPOS, QVEL, PARAMETERS, strict=False)[envs]
            self.ground_truth.reset(some)  # no warm start of other envs
            exact = self.ground_truth.step(some, joint_torque[envs], ground, told)
            for key in (QPOS, QVEL):
                after[key] = after[key].index_put((envs,), exact[key].to(after[key]))
        return after.set(TRUST, trust[:, None].to(torch.float32))

    def _not_yet_calm(self, untrusted: Tensor) -> Tensor:
        """Envs ``(num_envs,)`` that are untrusted or were so lately; counts this step."""
        if len(self._calm) != len(untrusted):
            self._calm = torch.full_like(untrusted, self.patience, dtype=torch.long)
        is_late = self._calm < self.patience
        calm = (self._calm + 1).clamp_max(self.patience)
        self._calm = calm.masked_fill(untrusted, 0)
        return untrusted | is_late
