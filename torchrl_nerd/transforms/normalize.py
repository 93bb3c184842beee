"""Zero mean and unit variance, with statistics that merge across processes.

NeRD section 3.4. Statistics are float64 and exact (Chan, Golub and LeVeque, "Algorithms
for computing the sample variance", 1983), so that huge offsets cost no digits.
"""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import reduce
from typing import Any, cast

import torch
from tensordict import TensorDictBase
from tensordict.utils import NestedKey
from torch import Tensor
from torchrl.data import Bounded, Composite, TensorSpec

from torchrl_nerd.transforms.base import StateTransform

FLOOR, ROUNDING = 1e-6, 1e-12
"""Smallest standard deviation, and what is added for each unit of |mean|: a constant
stays a constant, and whatever varies beside a huge offset counts."""


@dataclass(frozen=True)
class Stats:
    """Count, mean and sum of squared deviations of one vector quantity."""

    count: int
    mean: Tensor  # (D,)
    m2: Tensor  # (D,): sum of (x - mean)^2

    @classmethod
    def of(cls, samples: Tensor) -> "Stats":
        """Statistics of ``(*batch, D)`` samples over all leading dimensions.

        Raises ValueError for samples of fewer dimensions.
        """
        if samples.ndim < 2:
            raise ValueError(f"expected samples (*batch, D), got {[*samples.shape]}")
        x = samples.detach().double().flatten(0, -2)  # (n, D)
        mean = x.mean(0)
        return cls(len(x), mean, ((x - mean) ** 2).sum(0))

    @classmethod
    def unit(cls, size: int) -> "Stats":
        """Statistics that leave ``(*, size)`` as it is."""
        return cls(1, torch.zeros(size).double(), torch.ones(size).double())

    def merge(self, other: "Stats") -> "Stats":
        """Statistics of both sets of samples together; either may be empty.

        Raises ValueError for samples of another width.
        """
        if not (self.count and other.count):
            return self if self.count else other
        if self.mean.shape != other.mean.shape:
            sizes = len(self.mean), len(other.mean)
            raise ValueError(f"expected statistics of one width, got {sizes}")
        count = self.count + other.count
        shift = other.mean - self.mean
        share = other.count / count
        m2 = self.m2 + other.m2 + shift**2 * (self.count * share)
        return Stats(count, self.mean + shift * share, m2)

    @staticmethod
    def merge_all(parts: Iterable["Stats"]) -> "Stats":
        """Statistics of the samples of one or more parts together."""
        return reduce(Stats.merge, parts)

    @property
    def std(self) -> Tensor:
        """Population standard deviation ``(D,)``, floored."""
        floor = FLOOR + ROUNDING * self.mean.abs()
        return torch.maximum((self.m2 / max(self.count, 1)).sqrt(), floor)


class Normalize(StateTransform):
    """``(x - mean) / std`` per element, and its inverse.

    Statistics are frozen buffers. Keys that a tensordict lacks are left alone. The inverse
    acts on ``in_keys_inv`` alone, none by default: a replay buffer calls it on whatever is
    stored, an env on what it is given. `denormalize` is the inverse of one quantity.

    Raises:
        ValueError: a key of ``in_keys_inv`` without statistics, statistics of nothing
            or of numbers that are not finite; when called, whole numbers.

    Examples:
        >>> x = torch.randn(100, 3).double() * 5.0 + 1000.0
        >>> transform = Normalize({"x": Stats.of(x)})
        >>> y = transform(TensorDict(x=x, batch_size=[100]))["x"]
        >>> bool((y.mean().abs() < 1e-6) & ((y.std() - 1.0).abs() < 1e-2))
        True
    """

    enable_inv_on_reset = True  # a state that is set there is given as well

    def __init__(
        self, stats: Mapping[NestedKey, Stats], in_keys_inv: Sequence[NestedKey] = ()
    ) -> None:
        keys, back = list(stats), list(in_keys_inv)
        if unknown := [key for key in back if key not in keys]:
            raise ValueError(
                f"expected in_keys_inv with statistics ({keys}), got {unknown}"
            )
        if empty := [key for key, of_key in stats.items() if not of_key.count]:
            raise ValueError(f"expected statistics of samples, got none of {empty}")
        is_finite = {
            key: s.mean.isfinite() & s.m2.isfinite() for key, s in stats.items()
        }
        if odd := [key for key, finite in is_finite.items() if not finite.all()]:
            raise ValueError(
                f"expected statistics of finite samples, got NaN or infinity in {odd}"
            )
        super().__init__(keys, keys, in_keys_inv=back, out_keys_inv=back)
        self.names = {}
        for key, of_key in stats.items():
            parts = (key,) if isinstance(key, str) else key
            name = "_".join(("key", *parts)).replace(".", "_")  # pyright: ignore
            while name in self.names.values():  # "a_b" beside ("a", "b")
                name = f"{name}_{len(self.names)}"
            self.names[key] = name
            self.register_buffer(f"{name}_mean", of_key.mean.clone())
            self.register_buffer(f"{name}_std", of_key.std.clone())

    def normalize(self, key: NestedKey, x: Tensor) -> Tensor:
        """``(x - mean) / std`` of ``(*batch, D)`` in their dtype, in that of ``x``."""
        mean = self.mean(key)
        return ((x.to(mean.dtype) - mean) / self.std(key)).to(x.dtype)

    def denormalize(self, key: NestedKey, x: Tensor) -> Tensor:
        """``mean + std * x`` of ``(*batch, D)`` in their dtype, in that of ``x``."""
        mean = self.mean(key)
        return (mean + self.std(key) * x.to(mean.dtype)).to(x.dtype)

    def mean(self, key: NestedKey) -> Tensor:
        """Mean ``(D,)``, float64."""
        return self.get_buffer(f"{self.names[key]}_mean")

    def std(self, key: NestedKey) -> Tensor:
        """Standard deviation ``(D,)``, float64."""
        return self.get_buffer(f"{self.names[key]}_std")

    def _call(self, next_tensordict: TensorDictBase) -> TensorDictBase:
        for key in self.in_keys:
            x = next_tensordict.get(key, None)
            if x is not None:
                if not x.is_floating_point():
                    raise ValueError(
                        f"expected {key} of floating-point numbers, got {x.dtype}"
                    )
                next_tensordict.set(key, self.normalize(key, self._fitting(key, x)))
        return next_tensordict

    def transform_observation_spec(self, observation_spec: TensorSpec) -> TensorSpec:
        """Bounds of what is seen, normalised."""
        return self._bounded(observation_spec, self.in_keys)

    def transform_input_spec(self, input_spec: TensorSpec) -> TensorSpec:
        """Bounds of what an env is given, normalised."""
        found = cast(Composite, input_spec.clone())
        for name, part in [*found.items()]:  # actions and states
            found[name] = self._bounded(part, self.in_keys_inv)
        return found

    def _bounded(self, spec: TensorSpec, keys: Sequence[NestedKey]) -> Composite:
        found = cast(Composite, spec.clone())
        for key in (x for x in keys if x in found.keys(True)):
            if isinstance(found[key], Bounded):
                space = cast(Any, found[key].space)
                space.low = self.normalize(key, space.low)
                space.high = self.normalize(key, space.high)
        return found

    def _inv_call(self, tensordict: TensorDictBase) -> TensorDictBase:
        for key in self.in_keys_inv:
            x = tensordict.get(key, None)
            if x is not None:
                tensordict.set(key, self.denormalize(key, self._fitting(key, x)))
        return tensordict

    def _fitting(self, key: NestedKey, x: Tensor) -> Tensor:
        """``x``; a ValueError if it is wider or narrower than the statistics."""
        if x.shape[-1:] != (width := self.mean(key).shape):
            raise ValueError(f"expected {key} of width {width[0]}, got {[*x.shape]}")
        return x
