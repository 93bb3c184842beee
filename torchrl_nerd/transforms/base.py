"""What the transforms share: where they act, missing keys, specs, no inverse."""

from collections.abc import Iterable, Mapping, Sequence
from typing import cast

import torch
from tensordict import TensorDictBase
from tensordict.nn import dispatch
from tensordict.utils import NestedKey
from torch import Tensor
from torchrl.data import Composite, TensorSpec, Unbounded
from torchrl.envs import Transform

from torchrl_nerd.keys import CTRL, JOINT_TORQUE, QPOS, QVEL, TERRAIN
from torchrl_nerd.scenes.scene import Scene


class StateTransform(Transform):
    """`_call` at an env's reset and step, in a replay buffer, and alone."""

    @dispatch(source="in_keys", dest="out_keys", auto_batch_size=False)
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:  # pyright: ignore
        """Write the outputs beside the inputs."""
        return self._call(tensordict)

    def _reset(
        self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase
    ) -> TensorDictBase:
        return self._call(tensordict_reset)


class FeatureTransform(StateTransform):
    """Features of the state alone, written beside it wherever a state appears.

    A subclass gives ``sizes`` (key -> width), the ``out_keys`` among them that an env's
    observation holds (all, unless told), and defines ``_features``.
    """

    why_no_inverse: str

    def __init__(
        self,
        scene: Scene,
        in_keys: Sequence[NestedKey],
        sizes: dict[NestedKey, int],
        out_keys: Sequence[NestedKey] | None = None,
    ) -> None:
        keys = list(sizes) if out_keys is None else list(out_keys)
        super().__init__(in_keys=list(in_keys), out_keys=keys)
        self.sizes, self.name = sizes, scene.name
        self.widths = {QPOS: scene.model.nq, QVEL: scene.model.nv}

    @dispatch(source="in_keys", dest="out_keys", auto_batch_size=False)
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:  # pyright: ignore
        """Write the features, and under ``next`` those of the state there."""
        after = tensordict.get("next", None)
        lacking = set() if after is None else {*self.in_keys} - {*after.keys(True)}
        if after is not None and lacking <= {TERRAIN}:  # the ground stays: stored once
            given = after.copy().update(tensordict.select(*lacking, strict=False))
            after.update(self._call(given).select(*self.sizes, strict=False))
        return self._call(tensordict)

    def _features(self, tensordict: TensorDictBase) -> dict[NestedKey, Tensor]:
        raise NotImplementedError

    def _call(self, next_tensordict: TensorDictBase) -> TensorDictBase:
        if not self.sizes:  # such as contacts of a scene without a ground
            return next_tensordict
        expect_keys(type(self).__name__, self.in_keys, next_tensordict)
        given = next_tensordict
        for key, width in self.widths.items():
            if given[key].shape[-1] != width:
                raise ValueError(
                    f"{type(self).__name__} of scene '{self.name}' expects {key} of width "
                    f"{width}, got {given[key].shape[-1]}: is it another robot's?"
                )
        own = next((x.dtype for x in self.buffers() if x.is_floating_point()), None)
        if own not in (None, given[self.in_keys[0]].dtype):  # computed in its precision
            given = given.select(*self.in_keys, JOINT_TORQUE, CTRL, strict=False).to(
                own
            )
        for key, value in self._features(given).items():
            next_tensordict.set(key, value.to(torch.float32))
        return next_tensordict

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
        sizes = {key: self.sizes[key] for key in self.out_keys}
        return add_to_spec(observation_spec, sizes, torch.float32)


def expect_keys(
    name: str, needed: Iterable[NestedKey], tensordict: TensorDictBase
) -> None:
    """Raise a KeyError with the keys that are not there."""
    missing = [key for key in needed if key not in tensordict.keys(True)]
    if missing:
        found = sorted(map(str, tensordict.keys(True, True)))
        raise KeyError(f"{name} needs {missing}, got a tensordict with {found}")


def add_to_spec(
    spec: TensorSpec, sizes: Mapping[NestedKey, int], dtype: torch.dtype
) -> TensorSpec:
    """A copy of an observation's spec with unbounded entries of these widths added."""
    found = cast(Composite, spec.clone())
    for key, size in sizes.items():
        shape = torch.Size((*found.shape, size))
        found[key] = Unbounded(shape, dtype=dtype, device=found.device)
    return found
