"""How deep a robot stands in itself or in the ground, by MuJoCo's own collision."""

import mujoco
import numpy as np
import torch
from torch import Tensor


def deepest_contacts(model: mujoco.MjModel, qpos: Tensor) -> Tensor:
    """Depth of the deepest contact that MuJoCo finds in each state, m, ``(rows,)``.

    0 where nothing touches. Contacts with mocap bodies, which ``qpos (rows, nq)`` does not
    place, do not count.
    """
    data, depths = mujoco.MjData(model), np.zeros(len(qpos))
    is_mocap = model.body_mocapid[model.body_weldid[model.geom_bodyid]] >= 0
    for row, place in enumerate(qpos.numpy(force=True)):
        data.qpos[:] = place
        mujoco.mj_kinematics(model, data)
        mujoco.mj_collision(model, data)
        counts = ~is_mocap[data.contact.geom].any(-1)
        depths[row] = -data.contact.dist[counts].min(initial=0.0)
    return torch.from_numpy(depths).to(qpos)
