"""MuJoCo's soft ends of hinges and slides, in torch.

A joint beyond its end is asked to come back, with an acceleration like a spring's and a
damper's. The harder an end (its impedance), the nearer it gets to that, and no end ever
pulls. What one joint's end pushes with moves the others, and so all are found together, by
Jacobi's iteration with the bound that lets it converge for any robot.
Sources: https://mujoco.readthedocs.io/en/stable/modeling.html#solver-parameters;
Baker et al., "Multigrid smoothers for ultraparallel computing", 2011 (l1-Jacobi).
"""

from math import ceil

import mujoco
import numpy as np
import torch
from torch import Tensor, nn

from torchrl_nerd.geometry.constants import keep_constants
from torchrl_nerd.geometry.joint_axes import JointAxes

SWEEPS = 3  # each part of a step starts from the forces of the last one
FAST = 1.0 / 3.0  # of its speed an end may take from a joint in one part
TINY = mujoco.mjMINVAL
SOFTEST, HARDEST = mujoco.mjMINIMP, mujoco.mjMAXIMP


class JointStops(nn.Module):
    """How a robot of hinges and slides moves on, its limits pushing; rows last.

    | attribute | meaning |
    |---|---|
    | ``joints`` | which joints of ``axes`` have limits |

    Args:
        model: compiled, of a robot without a free base.
        axes: its joints.
        substep: s, of MuJoCo.
    """

    ends: Tensor
    impedance: Tensor
    power: Tensor
    law: Tensor

    def __init__(self, model: mujoco.MjModel, axes: JointAxes, substep: float) -> None:
        super().__init__()
        self.substep = substep
        self.joints = np.flatnonzero(model.jnt_limited[axes.joints]).tolist()
        ids = [axes.joints[joint] for joint in self.joints]
        low, high = model.jnt_range[ids].T
        margin = model.jnt_margin[ids]
        solimp = model.jnt_solimp[ids]
        springs = _springs(model, model.jnt_solref[ids], solimp[:, 1], self.substep)
        self.quickest = float(springs[1].max())
        law = *springs, model.dof_invweight0[model.jnt_dofadr[ids]]
        impedance, power = _impedance(solimp)
        # a number where joints agree: a square takes no time, a power most of the step's
        self.even_power = float(power[0]) if (power == power[0]).all() else None
        keep_constants(
            self,
            ends=np.stack((low + margin, high - margin))[..., None],
            impedance=impedance[..., None],
            power=power[:, None],
            law=np.stack(law)[..., None],
        )

    def parts(self, period: float) -> int:
        """Into how many parts to cut that time, s: no more than MuJoCo does."""
        return min(ceil(period * self.quickest / FAST), round(period / self.substep))

    def forward(
        self,
        qpos: Tensor,
        qvel: Tensor,
        acceleration: Tensor,
        inverse: Tensor,
        period: float | Tensor,
        parts: int,
        lag: float | Tensor,
    ) -> tuple[Tensor, Tensor]:
        """``qpos`` and ``qvel``, ``(J, N)``, after a time.

        Args:
            qpos: ``(J, N)``, rad or m.
            qvel: ``(J, N)``, rad/s or m/s.
            acceleration: without the limits, ``(J, N)``, held.
            inverse: of the mass matrix, ``(J, J, N)``, held.
            period: that time, s.
            parts: how many, equal, in each of which the limits push anew.
            lag: s by which positions run ahead of the mean of old and new velocities, a
                substep of semi-implicit Euler.
        """
        length, force = period / max(parts, 1), torch.zeros_like(qpos[self.joints])
        own = inverse[self.joints][:, self.joints]
        for _ in range(parts):
            place, speed = qpos[self.joints], qvel[self.joints]
            force, side = self._push(
                place, speed, acceleration[self.joints], own, force
            )
            gain = acceleration + (inverse[:, self.joints] * (side * force)).sum(1)
            qpos = qpos + length * (qvel + 0.5 * (length + lag) * gain)
            qvel = qvel + length * gain
        return qpos, qvel

    def _push(
        self, place: Tensor, speed: Tensor, free: Tensor, own: Tensor, force: Tensor
    ) -> tuple[Tensor, Tensor]:
        """Forces ``(L, N)`` of the limits, from the last ones, and which way each is."""
        low, high = self.ends
        below, above = low - place, place - high
        side = torch.where(below > above, 1.0, -1.0)
        depth = torch.maximum(below, above)
        is_beyond = depth > 0.0
        hardness = self._hardness(depth)
        stiffness, damping, weight = self.law
        asked = stiffness * hardness * depth - side * (damping * speed + free)
        soft = (1.0 / hardness - 1.0) * weight
        bound = (own.abs() * is_beyond).sum(1) + soft
        for _ in range(SWEEPS):
            force = torch.where(is_beyond, force, 0.0)
            got = side * (own * (side * force)).sum(1) + soft * force
            force = (force + (asked - got) / bound).clamp_min(0.0)
        return torch.where(is_beyond, force, 0.0), side

    def _hardness(self, depth: Tensor) -> Tensor:
        """MuJoCo's impedance, 0 to 1, that far beyond an end."""
        least, rise, width, middle, early, late = self.impedance
        x = (depth / width).clamp(0.0, 1.0)
        power = self.power if self.even_power is None else self.even_power
        bent = torch.where(
            x < middle, early * x**power, 1.0 - late * (1.0 - x) ** power
        )
        return least + rise * bent


def _impedance(solimp: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Least, rise, width, middle and two scales, ``(6, L)``, and the power, ``(L,)``."""
    least, most, width, middle, power = solimp.T
    least, most, middle = (x.clip(SOFTEST, HARDEST) for x in (least, most, middle))
    is_even = width <= TINY
    mean = 0.5 * (least + most)
    least, most = (np.where(is_even, mean, x) for x in (least, most))
    power = power.clip(1.0)
    scales = middle ** (1.0 - power), (1.0 - middle) ** (1.0 - power)
    return np.stack((least, most - least, width.clip(TINY), middle, *scales)), power


def _springs(
    model: mujoco.MjModel, solref: np.ndarray, most: np.ndarray, substep: float
) -> tuple[np.ndarray, np.ndarray]:
    """Stiffness, 1/s^2, and damping, 1/s, of what limits ask for, in either format."""
    (first, second), most = solref.T, most.clip(SOFTEST, HARDEST)
    is_direct = first <= 0.0
    shortest = 2.0 * substep
    if model.opt.disableflags & mujoco.mjtDisableBit.mjDSBL_REFSAFE:
        shortest = TINY
    time, ratio = np.maximum(first, shortest), np.maximum(second, TINY)
    stiffness = np.where(is_direct, -first / most**2, (most * time * ratio) ** -2)
    return stiffness, np.where(is_direct, -second / most, 2.0 / (most * time))
