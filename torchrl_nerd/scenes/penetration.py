"""Where a robot touches itself and the ground, and how deep, by MuJoCo's own collision."""

from collections.abc import Iterator

import mujoco
import numpy as np
import torch
from torch import Tensor


def deepest_contacts(model: mujoco.MjModel, qpos: Tensor) -> Tensor:
    """Depth of the deepest contact that MuJoCo finds in each state, m, ``(n,)``.

    0 where nothing touches. Contacts with mocap bodies, which ``qpos (n, nq)`` does not
    place, do not count.
    """
    is_mocap = model.body_mocapid[model.body_weldid[model.geom_bodyid]] >= 0
    depths = [
        -dist[~is_mocap[geoms].any(-1)].min(initial=0.0)
        for geoms, dist in _contacts(model, qpos)
    ]
    return torch.tensor(depths, dtype=torch.float64).to(qpos)


def touching_bodies(
    model: mujoco.MjModel, qpos: Tensor
) -> Iterator[set[tuple[int, int]]]:
    """Which bodies touch each other in each state ``(n, nq)``, by ids, low first."""
    for geoms, dist in _contacts(model, qpos):
        bodies = np.sort(model.geom_bodyid[geoms[dist <= 0.0]])
        yield {(int(low), int(high)) for low, high in bodies}


def _contacts(
    model: mujoco.MjModel, qpos: Tensor
) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """Geoms ``(n, 2)`` and signed distances ``(n,)``, m, of the contacts in each state."""
    data = mujoco.MjData(model)
    for place in qpos.numpy(force=True):
        data.qpos[:] = place
        mujoco.mj_kinematics(model, data)
        mujoco.mj_collision(model, data)
        yield data.contact.geom, data.contact.dist
