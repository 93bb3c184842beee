"""System identification: MuJoCo's parameters with the least one-step error on a history.

`identify` fits all motions at once. `identify_by_mujoco` is MuJoCo's own toolbox, one
motion after the other, with the same residuals; ``pip install "mujoco[sysid]"``.
"""

import importlib
from collections.abc import Callable
from io import StringIO
from typing import cast

import numpy as np
import torch
from tensordict import TensorDict
from torch import Tensor

from torchrl_nerd.dynamics import MujocoDynamics
from torchrl_nerd.keys import NEXT_QVEL, PARAMETERS, QPOS, QVEL, TERRAIN
from torchrl_nerd.scenes import Scene
from torchrl_nerd.scenes.commands import command_of, drive
from torchrl_nerd.scenes.variation import Variation

ITERATIONS, STEP = 15, 1e-4  # STEP: of finite differences, of a range's width
FIRST_DAMPING = 1e-3

Residuals = Callable[[Tensor], Tensor]
"""``(k * rows, size)``, places in the ranges -> ``(k * rows, T * nv)``."""


def scale_of(history: TensorDict) -> Tensor:
    """Standard deviation ``(nv,)`` of a step's change of velocity."""
    gain = history[NEXT_QVEL] - history[QVEL]
    return gain.reshape(-1, gain.shape[-1]).std(0).clamp_min(1e-9)


def residuals_of(scene: Scene, history: TensorDict, scale: Tensor) -> Residuals:
    """Errors of ``qvel`` one step after each state ``[rows, T]``, in units of ``scale``."""
    variation, rows = _variation(scene), len(history)
    dynamics = MujocoDynamics(scene, num_threads=1)

    def residuals(u: Tensor) -> Tensor:
        copies = len(u) // rows
        data = cast(TensorDict, torch.cat([history] * copies))  # pyright: ignore
        data[PARAMETERS] = variation.values(u)[:, None].expand(-1, data.shape[1], -1)
        flat = cast(TensorDict, data.flatten(0, 1))
        state = flat.select(QPOS, QVEL, PARAMETERS)
        torque, ctrl = drive(scene, command_of(scene, flat), flat[QPOS], flat[QVEL])
        dynamics.reset(state)  # no warm start from the last guess
        after = dynamics.step(state, torque, flat.get(TERRAIN, None), ctrl)
        error = (after[QVEL] - flat[NEXT_QVEL]) / scale
        return error.reshape(len(u), -1)

    return residuals


def identify(scene: Scene, history: TensorDict) -> Tensor:
    """Parameters ``(rows, size)`` from ``[rows, T]``, from the middle of their ranges.

    Levenberg-Marquardt with finite differences, all motions at once. Parameters stay
    within their ranges.
    """
    variation = _variation(scene)
    residuals = residuals_of(scene, history, scale_of(history))
    rows, size = len(history), variation.size
    u = torch.full((rows, size), 0.5, dtype=torch.float64)
    damping = torch.full((rows, 1, 1), FIRST_DAMPING, dtype=torch.float64)
    eye = torch.eye(size, dtype=torch.float64)
    now = residuals(u)
    for _ in range(ITERATIONS):
        side = torch.where(u > 0.5, -STEP, STEP)
        moved = (u[None] + side[None] * eye[:, None]).flatten(0, 1)
        changed = residuals(moved).unflatten(0, (size, rows))
        slope = ((changed - now) / side.T[..., None]).permute(
            1, 2, 0
        )  # (rows, R, size)
        normal = slope.mT @ slope
        normal = normal + damping * (eye + torch.diag_embed(normal.diagonal(0, 1, 2)))
        step = torch.linalg.solve(normal, slope.mT @ now[..., None])[..., 0]
        tried = (u - step).clamp(0.0, 1.0)
        then = residuals(tried)
        better = then.square().sum(1) < now.square().sum(1)
        u = torch.where(better[:, None], tried, u)
        now = torch.where(better[:, None], then, now)
        factor = torch.where(better, 0.2, 5.0).double()[:, None, None]
        damping = (damping * factor).clamp(1e-9, 1e9)
    return variation.values(u)


def identify_by_mujoco(scene: Scene, history: TensorDict) -> Tensor:
    """The same by ``mujoco.sysid.optimize`` with its defaults, from the same start."""
    sysid, variation = importlib.import_module("mujoco.sysid"), _variation(scene)
    found, scale, size = [], scale_of(history), variation.size
    for row in history.split(1):
        residuals = residuals_of(scene, cast(TensorDict, row), scale)

        def of_places(places: np.ndarray, _: object, residuals=residuals) -> tuple:
            errors = residuals(torch.from_numpy(places.T))  # columns are places
            return [errors.numpy().T], None, None

        start = sysid.Parameter("u", np.full(size, 0.5), np.zeros(size), np.ones(size))
        given = sysid.ParameterDict({"u": start})
        last, _ = sysid.optimize(given, of_places, verbose=False, output=StringIO())
        found.append(torch.from_numpy(last.as_vector()))
    return variation.values(torch.stack(found))


def _variation(scene: Scene) -> Variation:
    assert scene.variation is not None
    return scene.variation
