"""What is measured of states: momentum, penetration, distance between trajectories."""

import mujoco
import numpy as np
import torch
from tensordict import TensorDictBase
from torch import Tensor

from torchrl_nerd.keys import QPOS, QVEL
from torchrl_nerd.scenes import Scene


def mechanics(scene: Scene, states: TensorDictBase) -> dict[str, np.ndarray]:
    """What MuJoCo computes of each state ``[n]``, velocities in world axes.

    Returns:
        ``com (n, 3)``, m; ``momentum (n, 3)``, kg m/s; ``angular_momentum (n, 3)`` about
        the centre of mass, kg m^2/s; ``penetration (n,)``, the deepest contact, m. NaN
        where a state is not finite.
    """
    model, data = scene.model, mujoco.MjData(scene.model)
    mass, count = float(model.body_mass.sum()), len(states)
    sizes = {"com": (3,), "momentum": (3,), "angular_momentum": (3,), "penetration": ()}
    found = {key: np.full((count, *size), np.nan) for key, size in sizes.items()}
    pairs = zip(states[QPOS].numpy(), states[QVEL].numpy(), strict=True)
    for i, (qpos, qvel) in enumerate(pairs):
        if not (np.isfinite(qpos).all() and np.isfinite(qvel).all()):
            continue
        data.qpos[:], data.qvel[:] = qpos, qvel
        mujoco.mj_forward(model, data)
        mujoco.mj_subtreeVel(model, data)
        found["com"][i] = data.subtree_com[0]
        found["momentum"][i] = mass * data.subtree_linvel[0]
        found["angular_momentum"][i] = data.subtree_angmom[0]
        found["penetration"][i] = max((-c.dist for c in data.contact), default=0.0)
    return found


def relative_difference(x: Tensor, other: Tensor) -> float:
    """Largest ``|x - other| / (1 + max |x|)`` of trajectories ``(n, steps, D)``."""
    size = 1.0 + x.abs().amax((1, 2), keepdim=True)
    return largest(((other - x) / size).abs())


def largest(value: np.ndarray | Tensor) -> float:
    """The largest entry; infinity if any is not finite, or there is none."""
    array = np.asarray(value, dtype=float)
    is_valid = array.size and np.isfinite(array).all()
    return float(array.max()) if is_valid else float("inf")


def norm(x: Tensor) -> Tensor:
    """Length of vectors ``(*batch, D)``."""
    return torch.linalg.vector_norm(x, dim=-1)
