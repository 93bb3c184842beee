"""What the scene's transforms share: reading inputs, writing outputs, specs, no inverse."""

from collections.abc import Sequence
from typing import cast

import torch
from tensordict import TensorDictBase
from tensordict.utils import NestedKey
from torch import Tensor
from torchrl.data import Composite, TensorSpec, Unbounded
from torchrl.envs import Transform


class FeatureTransform(Transform):
    """Features of the state alone, written beside it wherever a state appears.

    A subclass gives ``sizes`` (key -> width), the ``out_keys`` among them that an env's
    observation holds (all, unless told) and defines ``_features``. At an env's
    reset and step, in a replay buffer and alone the same features come out.
    """

    sizes: dict[NestedKey, int]
    why_no_inverse: str

    def __init__(
        self,
        in_keys: Sequence[NestedKey],
        sizes: dict[NestedKey, int],
        out_keys: Sequence[NestedKey] | None = None,
    ) -> None:
        keys = list(sizes) if out_keys is None else list(out_keys)
        super().__init__(in_keys=list(in_keys), out_keys=keys)
        self.sizes = sizes

    def _features(self, tensordict: TensorDictBase) -> dict[NestedKey, Tensor]:
        raise NotImplementedError

    def _call(self, next_tensordict: TensorDictBase) -> TensorDictBase:
        missing = [key for key in self.in_keys if key not in next_tensordict.keys(True)]
        if missing:
            found = sorted(map(str, next_tensordict.keys(True, True)))
            raise KeyError(
                f"{type(self).__name__} needs {missing}, got a tensordict with {found}"
            )
        for key, value in self._features(next_tensordict).items():
            next_tensordict.set(key, value.to(torch.float32))
        return next_tensordict

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:  # pyright: ignore
        """Write the features beside the state."""
        return self._call(tensordict)

    def _reset(
        self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase
    ) -> TensorDictBase:
        return self._call(tensordict_reset)

    def _inv_call(self, tensordict: TensorDictBase) -> TensorDictBase:
        keys = tensordict.keys(True)
        has_inputs = all(key in keys for key in self.in_keys)
        if self.parent is None and not has_inputs:
            if any(key in keys for key in self.out_keys):
                raise ValueError(
                    f"{type(self).__name__} has no inverse: {self.why_no_inverse}"
                )
        return tensordict

    def transform_observation_spec(self, observation_spec: TensorSpec) -> TensorSpec:
        """Add the features."""
        spec = cast(Composite, observation_spec.clone())
        for key in self.out_keys:
            spec[key] = Unbounded(
                torch.Size((*spec.shape, self.sizes[key])),
                dtype=torch.float32,
                device=spec.device,
            )
        return spec
