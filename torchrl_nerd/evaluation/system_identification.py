"""MuJoCo fitted to recorded tosses: what a learned model has to beat."""

import copy
from dataclasses import replace

import mujoco
import numpy as np
from scipy.optimize import minimize
from torch import Tensor

from torchrl_nerd.data.cube_tosses import Tosses
from torchrl_nerd.dynamics import MujocoDynamics
from torchrl_nerd.evaluation.toss_error import toss_errors
from torchrl_nerd.scenes import Scene
from torchrl_nerd.scenes.penalty import set_penalty_contact

# published: parameters of the ContactNets repository; stiffness and damping are not among
# them, and are the springs of the scene's board
PUBLISHED = {
    "gravity": 9.81,  # m/s^2
    "size": 0.0524,  # m, half width
    "inertia": 0.00081,  # kg m^2
    "friction": 0.18,
    "stiffness": 1e4,  # N/m
    "damping": 50.0,  # N s/m
    "slip": 50.0,  # N s/m
    "ground": 0.0,  # m, its height
}
# `python benchmarks/fit_mujoco.py` on the training tosses
FITTED = {
    "gravity": 9.610,
    "size": 0.05092,
    "inertia": 0.001027,
    "friction": 0.1852,
    "stiffness": 7282.0,
    "damping": 55.48,
    "slip": 12.99,
    "ground": 0.000847,
}
WIDTHS = np.array([0.01, 0.01, 0.1, 0.1, 0.4, 0.4, 0.4, 0.5])  # of the first simplex
GROUND = 0.002  # m that count as 1; of the others the logarithms are sought
POSITION, ORIENTATION = 0.01, 0.2  # m and rad that weigh alike
SUBSTEPS = 10


def cube_with(scene: Scene, parameters: dict[str, float]) -> Scene:
    """The scene's cube in MuJoCo with other physical parameters (those of `PUBLISHED`)."""
    model = copy.copy(scene.model)
    model.opt.timestep = scene.control_step / SUBSTEPS
    model.opt.gravity[2] = -parameters["gravity"]
    body = int(model.jnt_bodyid[0])
    geom = int(np.flatnonzero(model.geom_bodyid == body)[0])
    model.geom_pos[model.geom_bodyid == 0, 2] = parameters["ground"]
    model.geom_size[geom] = parameters["size"]
    model.geom_aabb[geom, 3:] = parameters["size"]
    model.geom_rbound[geom] = 3**0.5 * parameters["size"]
    model.body_inertia[body] = parameters["inertia"]
    mujoco.mj_setConst(model, mujoco.MjData(model))
    forces = (parameters["stiffness"], parameters["damping"], parameters["slip"])
    ke, kd, kf = forces
    set_penalty_contact(model, ke=ke, kd=kd, kf=kf, mu=parameters["friction"])
    return replace(scene, model=model, substeps=SUBSTEPS)


def fit_mujoco(
    scene: Scene,
    tosses: Tosses,
    starts: Tensor,
    start: dict[str, float] | None = None,
    evaluations: int = 100,
) -> dict[str, float]:
    """Parameters with the least error, by Nelder and Mead's simplex.

    Args:
        scene: the cube.
        tosses: recorded.
        starts: rows of the first states of training sub-trajectories.
        start: parameters to begin with; the published ones by default.
        evaluations: of all sub-trajectories.
    """
    names, first = list(PUBLISHED), start or PUBLISHED
    origin = np.log([first[name] for name in names[:-1]])
    origin = np.append(origin, first["ground"] / GROUND)

    def parameters(x: np.ndarray) -> dict[str, float]:
        values = np.append(np.exp(x[:-1]), GROUND * x[-1])
        return dict(zip(names, values.tolist(), strict=True))

    def score(x: np.ndarray) -> float:
        fitted = cube_with(scene, parameters(x))
        distance, angle = toss_errors(MujocoDynamics(fitted), tosses, starts)
        error = float(distance.mean()) / POSITION + float(angle.mean()) / ORIENTATION
        return error if np.isfinite(error) else 1e3

    simplex = np.vstack([origin, origin + np.diag(WIDTHS)])
    options = {"maxfev": evaluations, "initial_simplex": simplex, "adaptive": True}
    best = minimize(score, origin, method="Nelder-Mead", options=options)
    return parameters(best.x)
