"""The state that a reset is asked to set, checked."""

from collections.abc import Mapping

import torch
from tensordict import TensorDictBase
from torch import Tensor

from torchrl_nerd.geometry.manifold import normalize_pos
from torchrl_nerd.keys import PARAMETERS, QPOS, QVEL, TERRAIN
from torchrl_nerd.scenes.scene import Scene


def given_state(
    scene: Scene,
    tensordict: TensorDictBase | None,
    is_reset: Tensor,
    sizes: Mapping[str, int],
    dtype: torch.dtype = torch.float64,
) -> dict[str, Tensor]:
    """The state that ``reset(td, set_state=True)`` asks for, copies.

    Quaternions and normals of the ground become unit ones.

    Of the keys in ``sizes``, which have these widths, ``qpos`` and ``qvel`` must be there.
    Only the state of envs where ``is_reset (num_envs,)`` must be finite.

    Raises:
        ValueError: a key that is missing, of another shape or not finite; parameters of
            no robot.
    """
    given = {} if tensordict is None else tensordict
    missing = [key for key in (QPOS, QVEL) if key not in given.keys()]
    if missing:
        raise ValueError(f"set_state needs {missing} in the tensordict")
    values = {}
    for key, size in sizes.items():
        value, expected = given.get(key, None), (len(is_reset), size)
        if value is None:
            continue
        if (got := tuple(value.shape)) != expected:
            raise ValueError(f"expected {key} of shape {expected}, got {got}")
        values[key] = value.to(is_reset.device, dtype, copy=True)
        if not values[key][is_reset].isfinite().all():  # in the dtype of the state
            raise ValueError(f"expected finite {key} to set the state to")
    values[QPOS] = normalize_pos(scene.layout, values[QPOS])
    if TERRAIN in values and scene.terrain is not None:
        values[TERRAIN] = scene.terrain.normalize(values[TERRAIN])
        if not values[TERRAIN][is_reset].isfinite().all():
            raise ValueError("expected normals of the ground with a length, got zero")
    if PARAMETERS in values and scene.variation is not None:
        scene.variation.check(values[PARAMETERS][is_reset])
    return values
