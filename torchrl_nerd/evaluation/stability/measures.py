"""What is measured of states: momentum, depth, and how far two ways lie apart."""

import mujoco
import numpy as np
import torch
from tensordict import TensorDictBase
from torch import Tensor

from torchrl_nerd.evaluation.rollout_error import position_errors
from torchrl_nerd.keys import QPOS, QVEL
from torchrl_nerd.scenes import Scene


def mechanics(scene: Scene, states: TensorDictBase) -> dict[str, np.ndarray]:
    """What MuJoCo computes of each state ``[n]``, velocities in world axes.

    Returns:
        ``com (n, 3)``, m; ``momentum (n, 3)``, kg m/s; ``spin (n, 3)``, angular momentum
        about the centre of mass, kg m^2/s; ``depth (n,)``, the deepest contact, m. NaN
        where a state is not finite.
    """
    model, data = scene.model, mujoco.MjData(scene.model)
    mass, count = float(model.body_mass.sum()), len(states)
    sizes = {"com": (3,), "momentum": (3,), "spin": (3,), "depth": ()}
    found = {key: np.full((count, *size), np.nan) for key, size in sizes.items()}
    numbers = zip(states[QPOS].numpy(), states[QVEL].numpy(), strict=True)
    for row, (qpos, qvel) in enumerate(numbers):
        if not (np.isfinite(qpos).all() and np.isfinite(qvel).all()):
            continue
        data.qpos[:], data.qvel[:] = qpos, qvel
        mujoco.mj_forward(model, data)
        mujoco.mj_subtreeVel(model, data)
        found["com"][row] = data.subtree_com[0]
        found["momentum"][row] = mass * data.subtree_linvel[0]
        found["spin"][row] = data.subtree_angmom[0]
        found["depth"][row] = max((-c.dist for c in data.contact), default=0.0)
    return found


def apart(scene: Scene, here: Tensor, there: Tensor) -> Tensor:
    """How far two ways lie apart at worst, m or rad.

    Args:
        scene: the robot.
        here: positions ``(rows, steps, nq)``.
        there: likewise.

    Returns:
        ``(rows, steps)``: the largest of all quantities of `position_errors`.
    """
    errors = position_errors(scene, here, there)
    return torch.stack(list(errors.values())).amax(0)


def length(x: Tensor) -> Tensor:
    """Of vectors ``(*batch, D)``, ``(*batch,)``."""
    return torch.linalg.vector_norm(x, dim=-1)


def largest(value: np.ndarray | Tensor) -> float:
    """The largest entry ``(*any)``; infinity if any is no number, or there is none."""
    array = np.asarray(value, dtype=float)
    return (
        float(array.max()) if array.size and np.isfinite(array).all() else float("inf")
    )
