"""Spring-damper (penalty) contacts and joint limits: the law, and MuJoCo's parameters.

The paper's engine pushes back with ``ke * depth + kd * speed`` and friction
``min(kf * slip, mu * normal)``. MuJoCo's soft constraint has force
``(a_ref - a_0) / (A + R)`` with ``R = (1 - d)/d * A`` and ``a_ref = -(k/d) depth - (b/d)
speed``. For a small impedance ``d`` the term ``a_0`` fades and the force becomes
``(k * depth + b * speed) / A``: the spring and damper, if ``k = A ke`` and ``b = A kd``.
``A`` is MuJoCo's constant ``invweight0``. Friction shares the damping, and ``impratio``
multiplies it, so ``impratio = kf / kd``.
Source: https://mujoco.readthedocs.io/en/stable/computation/#constraint-model
"""

from dataclasses import dataclass

import mujoco
import numpy as np
import torch
from torch import Tensor

from torchrl_nerd.scenes.contact_points import terrain_geoms, touching_geoms

IMPEDANCE = 0.001
SOLIMP = np.array([IMPEDANCE, IMPEDANCE, 0.001, 0.5, 2.0])


def normal_force(
    stiffness: Tensor, damping: Tensor, depth: Tensor, speed: Tensor
) -> Tensor:
    """``max(k depth - d speed, 0)``, N, where a point is in the ground, else 0.

    ``depth`` m, ``speed`` m/s along the normal: positive leaves the ground.
    """
    force = (stiffness * depth - damping * speed).clamp_min(0.0)
    return torch.where(depth > 0.0, force, 0.0)


def friction_force(
    slip_damping: Tensor, friction: Tensor, normal: Tensor, slip_speed: Tensor
) -> Tensor:
    """``min(kf v, mu N)``, N, against the direction of slip of speed v, m/s."""
    return torch.minimum(slip_damping * slip_speed, friction * normal)


def limit_forces(
    stiffness: Tensor,
    damping: Tensor,
    low: Tensor,
    high: Tensor,
    position: Tensor,
    velocity: Tensor,
) -> tuple[Tensor, Tensor]:
    """``k (low - q) - d v`` below a range and ``k (high - q) - d v`` above it, else 0.

    Torques of the lower and of the upper limit, N m or N. The damper may outweigh the
    spring; a limit that never pulls is the first of both clamped to at least zero and the
    second to at most zero.
    """
    below = stiffness * (low - position) - damping * velocity
    above = stiffness * (high - position) - damping * velocity
    below = torch.where(position < low, below, 0.0)
    return below, torch.where(position > high, above, 0.0)


def set_penalty_contact(
    model: mujoco.MjModel, *, ke: float, kd: float, kf: float, mu: float
) -> None:
    """Give every shape of a moving body the penalty law against the ground, in place.

    Stiffness ``ke``, N/m; normal damping ``kd`` and tangential damping below the friction
    limit ``kf``, N s/m; Coulomb friction coefficient ``mu``.
    """
    model.opt.impratio = kf / kd
    inverse_mass = model.body_invweight0[model.geom_bodyid, 0]
    geoms = np.flatnonzero(inverse_mass)
    model.geom_solref[geoms] = np.outer(inverse_mass[geoms], (-ke, -kd))
    model.geom_solimp[geoms] = SOLIMP
    model.geom_friction[geoms, 0] = mu
    model.geom_priority[geoms] = 1


def set_penalty_limit(
    model: mujoco.MjModel, *joints: str, ke: float, kd: float
) -> None:
    """Give limited joints a spring and damper that act beyond their ranges.

    As `set_penalty_contact`; ``ke`` in N/m or N m/rad, ``kd`` in N s/m or N m s/rad.
    """
    ids = [model.joint(joint).id for joint in joints]
    inverse_mass = model.dof_invweight0[model.jnt_dofadr[ids]]
    model.jnt_solref[ids] = np.outer(inverse_mass, (-ke, -kd))
    model.jnt_solimp[ids] = SOLIMP


@dataclass(frozen=True)
class PenaltyLaw:
    """Penalty law of each contact, read from a compiled model."""

    stiffness: np.ndarray  # along the normal, N/m
    damping: np.ndarray  # along the normal, N s/m
    slip: np.ndarray  # tangential damping below the friction limit, N s/m
    friction: np.ndarray  # Coulomb coefficient

    @classmethod
    def of_bodies(cls, model: mujoco.MjModel, bodies: list[int]) -> "PenaltyLaw":
        """The law of each body's contacts; a ValueError where it is another one."""
        touching = np.array(touching_geoms(model))
        _expect_law(model, touching[np.isin(model.geom_bodyid[touching], bodies)])
        owner = model.geom_bodyid[touching]
        geoms = [int(touching[owner == body][0]) for body in bodies]
        weight = model.body_invweight0[bodies, 0]
        stiffness, damping = _stiffness(model.geom_solref[geoms], weight, "contacts")
        slip = damping * model.opt.impratio
        return cls(stiffness, damping, slip, model.geom_friction[geoms, 0])


def _expect_law(model: mujoco.MjModel, geoms: np.ndarray) -> None:
    """Raise a ValueError where these shapes' contacts with the ground are no such law."""
    if not len(geoms):
        return
    others = model.geom_priority[terrain_geoms(model)]
    both = np.append(geoms, terrain_geoms(model))
    margin = model.geom_margin[both] + model.geom_gap[both]
    same = np.column_stack((model.geom_solref[geoms], model.geom_friction[geoms, 0]))
    bodies = model.geom_bodyid[geoms]
    first = same[[np.flatnonzero(bodies == body)[0] for body in bodies]]
    odd = {
        "an impedance (solimp) of its own": not _is_soft(model.geom_solimp[geoms]),
        "a margin or gap": margin.any(),
        "a condim other than 3": (model.geom_condim[geoms] != 3).any(),
        "the ground's priority": model.geom_priority[geoms].min() <= others.max(),
        "shapes of one body that differ": (same != first).any(),
    }
    if found := [name for name, is_there in odd.items() if is_there]:
        raise ValueError(
            "expected contacts that are springs and dampers (see set_penalty_contact), got "
            f"some with {', '.join(found)}"
        )


def _is_soft(solimp: np.ndarray) -> bool:
    """Whether impedances are small and constant, so that MuJoCo's forces are the law's."""
    least, most = solimp[:, 0], solimp[:, 1]
    return bool((most <= 10.0 * IMPEDANCE).all() and np.allclose(least, most))


def limit_stiffness(
    model: mujoco.MjModel, joints: list[int]
) -> tuple[np.ndarray, np.ndarray]:
    """Stiffness and damping of limits that follow the law; others are a ValueError."""
    if model.jnt_margin[joints].any() or not _is_soft(model.jnt_solimp[joints]):
        raise ValueError(
            "expected limits that are springs and dampers (see set_penalty_limit), got "
            "some with a margin or an impedance (solimp) of their own"
        )
    weight = model.dof_invweight0[model.jnt_dofadr[joints]]
    return _stiffness(model.jnt_solref[joints], weight, "limits")


def _stiffness(
    solref: np.ndarray, weight: np.ndarray, what: str
) -> tuple[np.ndarray, np.ndarray]:
    """Stiffness and damping of MuJoCo's direct format."""
    if not (solref < 0.0).all():
        raise ValueError(
            f"expected {what} that are springs and dampers (solref below 0), got "
            f"{solref.min(0).tolist()}"
        )
    return tuple((-solref / weight[:, None]).T)
