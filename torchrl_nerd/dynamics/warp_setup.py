"""What MuJoCo Warp needs before the first step: itself, a model, and enough memory."""

import sys
from importlib.util import find_spec
from typing import Any

import mujoco

from torchrl_nerd.dynamics.mujoco import torque_model
from torchrl_nerd.scenes.scene import Scene

CONTACTS_PER_PAIR = 8  # of two geoms, two boxes at most; MuJoCo Warp has no more
CONTACTS_PER_HEIGHT_FIELD = 50  # of it and another geom, MuJoCo's mjMAXCONPAIR


def is_warp_installed() -> bool:
    """Whether the package mujoco-warp can be imported."""
    return find_spec("mujoco_warp") is not None


def import_warp() -> tuple[Any, Any]:
    """The modules ``warp`` and ``mujoco_warp``, without their greeting.

    Raises:
        ModuleNotFoundError: they are not installed; names the extra.
    """
    if not is_warp_installed():
        raise ModuleNotFoundError(
            "dynamics 'mujoco_warp' needs the package mujoco-warp, which is not "
            "installed: pip install 'torchrl-nerd[warp]'"
        )
    is_first = "warp" not in sys.modules
    import warp

    if is_first:  # whoever imported it before has chosen what it says
        warp.config.log_level = warp.LOG_ERROR
    import mujoco_warp

    warp.init()

    return warp, mujoco_warp


def warp_model(scene: Scene) -> mujoco.MjModel:
    """The scene's model driven by joint torques alone, in flags that Warp knows.

    It never resets an env by itself, so there is nothing to switch off.
    """
    model = torque_model(scene)
    model.opt.disableflags &= ~int(mujoco.mjtDisableBit.mjDSBL_AUTORESET)
    return model


def largest_constraints(model: mujoco.MjModel, max_contacts: int) -> int:
    """How many scalar constraints an env can have with so many contacts."""
    condim = int(max(model.geom_condim, default=1))
    is_pyramid = model.opt.cone == mujoco.mjtCone.mjCONE_PYRAMIDAL
    each = max(1, 2 * (condim - 1)) if is_pyramid else condim
    # a limit holds a joint at both ends at worst; friction loss acts on every dof
    others = 2 * (model.njnt + model.ntendon) + model.nv + model.ntendon
    return each * max_contacts + others


def largest_contacts(model: mujoco.MjModel, pairs: int) -> int:
    """How many contacts an env can have where so many pairs of geoms may touch."""
    return pairs * (CONTACTS_PER_HEIGHT_FIELD if model.nhfield else CONTACTS_PER_PAIR)
