"""The measured cube in MuJoCo with other physical parameters."""

from dataclasses import replace

import mujoco
import numpy as np

from torchrl_nerd.dynamics import MujocoDynamics
from torchrl_nerd.robots.cube.scene import cube_path
from torchrl_nerd.scenes import Scene
from torchrl_nerd.scenes.penalty_law import set_penalty_contact
from torchrl_nerd.training.physics_fit import CENTRE

# Published: parameters of the ContactNets repository. It has no stiffness or damping: those
# of the scene's board.
PUBLISHED = {
    "gravity": 9.81,  # m/s^2
    "size": 0.0524,  # m, half width
    "inertia": 0.00081,  # kg m^2
    "friction": 0.18,
    "stiffness": 1e4,  # N/m
    "damping": 50.0,  # N s/m
    "slip": 50.0,  # N s/m
    "ground": 0.0,  # m, its height
    "centre_x": 0.0,  # m, of mass, in body axes
    "centre_y": 0.0,
    "centre_z": 0.0,
}
# On the training tosses, by Nelder and Mead's simplex over 150 windows: a lower error on
# the validation tosses than what fit_mujoco.py finds.
FITTED = {
    **PUBLISHED,
    "gravity": 9.610,
    "size": 0.05092,
    "inertia": 0.001027,
    "friction": 0.1852,
    "stiffness": 7282.0,
    "damping": 55.48,
    "slip": 12.99,
    "ground": 0.000847,
}
# fit_mujoco.py --centre
FITTED_CENTRE = {
    "gravity": 9.647,
    "size": 0.05088,
    "inertia": 0.001121,
    "friction": 0.1829,
    "stiffness": 1.182e04,
    "damping": 71.82,
    "slip": 16.7,
    "ground": 0.0008945,
    "centre_x": -0.0006122,
    "centre_y": -0.0001605,
    "centre_z": 0.006667,
}
SUBSTEPS = 10


def cube_with(scene: Scene, parameters: dict[str, float]) -> Scene:
    """The scene's cube in MuJoCo with other physical parameters (those of `PUBLISHED`)."""
    spec = mujoco.MjSpec.from_file(str(cube_path(scene.name)))
    spec.body("cube").simple = False  # its centre of mass may be anywhere
    model = spec.compile()
    model.opt.timestep = scene.control_step / SUBSTEPS
    model.opt.gravity[2] = -parameters["gravity"]
    body = int(model.jnt_bodyid[0])
    geom = int(np.flatnonzero(model.geom_bodyid == body)[0])
    model.geom_pos[model.geom_bodyid == 0, 2] = parameters["ground"]
    model.geom_size[geom] = parameters["size"]
    model.geom_aabb[geom, 3:] = parameters["size"]
    model.geom_rbound[geom] = 3**0.5 * parameters["size"]
    model.body_inertia[body] = parameters["inertia"]
    model.body_ipos[body] = [parameters[name] for name in CENTRE]
    mujoco.mj_setConst(model, mujoco.MjData(model))
    names = {"ke": "stiffness", "kd": "damping", "kf": "slip", "mu": "friction"}
    law = {key: parameters[name] for key, name in names.items()}
    set_penalty_contact(model, **law)
    return replace(scene, model=model, substeps=SUBSTEPS)


def mujoco_baselines(scene: Scene) -> dict[str, MujocoDynamics]:
    """MuJoCo with published parameters, and with those fitted to training tosses."""
    baselines = {
        "MuJoCo, published": PUBLISHED,
        "MuJoCo, fitted": FITTED,
        "MuJoCo, fitted with centre": FITTED_CENTRE,
    }
    return {k: MujocoDynamics(cube_with(scene, v)) for k, v in baselines.items()}
