"""The robot in a second state, grey and half transparent, in a scene of MuJoCo's."""

import mujoco
import numpy as np
from torch import Tensor

from torchrl_nerd.evaluation.render.poser import Poser
from torchrl_nerd.evaluation.render.style import GHOST

SIZE = 0.98  # so that it hides inside where both states agree


def add_ghost(poser: Poser, qpos: Tensor | np.ndarray, scene: mujoco.MjvScene) -> None:
    """Add the robot at ``qpos (nq,)`` to what is drawn; its ground is not added."""
    first, data = scene.ngeom, poser.pose(qpos)
    option, pert = mujoco.MjvOption(), mujoco.MjvPerturb()
    moving = mujoco.mjtCatBit.mjCAT_DYNAMIC.value
    mujoco.mjv_addGeoms(poser.model, data, option, pert, moving, scene)
    robot = set(poser.moving)
    for geom in scene.geoms[first : scene.ngeom]:
        geom.rgba[:] = GHOST if geom.objid in robot else 0.0
        geom.matid = -1
        geom.size[:] *= SIZE
