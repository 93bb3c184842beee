"""MuJoCo's soft joint-limit constraints of hinges and slides, in torch.

The constraint asks a joint beyond its limit for a reference acceleration, that of a spring
and damper. Its impedance says how much of it the joint gets, and its force never pulls.
The forces of all limits are coupled by the inverse mass matrix; Jacobi's iteration with
the l1 bound on the diagonal, which converges for any robot, finds them.
Sources: https://mujoco.readthedocs.io/en/stable/modeling.html#solver-parameters;
Baker et al., "Multigrid smoothers for ultraparallel computing", 2011 (l1-Jacobi).
"""

from math import ceil

import mujoco
import numpy as np
import torch
from torch import Tensor, nn

from torchrl_nerd.geometry.base import JointAxes, keep_constants
from torchrl_nerd.geometry.constants import take

NUM_SWEEPS = 3  # of the iteration; it starts from the forces of the solve before
MAX_DAMPED = 1.0 / 3.0  # of its speed: what a limit may take from a joint per solve
TINY = mujoco.mjMINVAL
MIN_IMPEDANCE, MAX_IMPEDANCE = mujoco.mjMINIMP, mujoco.mjMAXIMP


class JointLimits(nn.Module):
    """Integrates hinges and slides under joint-limit constraints; batch last.

    For robots without a free base.
    """

    limits: Tensor  # (2, L, 1): low and high, m or rad
    impedance: Tensor  # (6, L, 1), see `_impedance_parameters`
    power: Tensor  # (L, 1)
    law: Tensor  # (3, L, 1): stiffness, damping, weight

    def __init__(self, model: mujoco.MjModel, axes: JointAxes) -> None:
        super().__init__()
        self.substep = float(model.opt.timestep)
        # which joints of ``axes`` have limits
        self.joints = np.flatnonzero(model.jnt_limited[axes.joints]).tolist()
        ids = [axes.joints[joint] for joint in self.joints]
        low, high = model.jnt_range[ids].T
        margin = model.jnt_margin[ids]
        solimp = model.jnt_solimp[ids]
        springs = _springs(model, model.jnt_solref[ids], solimp[:, 1], self.substep)
        # 1/s: dampers, and springs that swing faster than they are damped
        most = solimp[:, 1].clip(MIN_IMPEDANCE, MAX_IMPEDANCE)
        self.max_rate = float(max(springs[1].max(), (most * springs[0] ** 0.5).max()))
        law = *springs, model.dof_invweight0[model.jnt_dofadr[ids]]
        impedance, power = _impedance_parameters(solimp)
        # a number where joints agree: a square takes no time, a power most of the step's
        self.even_power = float(power[0]) if (power == power[0]).all() else None
        keep_constants(
            self,
            limits=np.stack((low + margin, high - margin))[..., None],
            impedance=impedance[..., None],
            power=power[:, None],
            law=np.stack(law)[..., None],
        )

    def num_solves(self, period: float) -> int:
        """How often to solve for the forces in ``period`` s: at most as often as MuJoCo."""
        wanted = ceil(period * self.max_rate / MAX_DAMPED)
        return min(wanted, round(period / self.substep))

    def forward(
        self,
        qpos: Tensor,
        qvel: Tensor,
        acceleration: Tensor,
        inverse: Tensor,
        period: float,
        num_solves: int,
        lag: float,
    ) -> tuple[Tensor, Tensor]:
        """``qpos`` and ``qvel``, ``(J, N)``, after ``period`` s.

        Held are ``acceleration (J, N)`` without the limits and ``inverse (J, J, N)`` of the
        mass matrix. The forces are solved anew in ``num_solves`` equal parts of the period.
        ``lag``, s: substep of semi-implicit Euler; positions move by the new velocity.
        """
        num_solves = max(num_solves, 1)
        step = period / num_solves
        force = torch.zeros_like(qpos[: len(self.joints)])
        coupling = take(take(inverse, self.joints, 0), self.joints, 1)
        for _ in range(num_solves):
            position, velocity = (take(x, self.joints, 0) for x in (qpos, qvel))
            smooth = take(acceleration, self.joints, 0)
            force, side = self._solve(position, velocity, smooth, coupling, force)
            columns = take(inverse, self.joints, 1)
            qacc = acceleration + (columns * (side * force)).sum(1)
            qpos = qpos + step * (qvel + 0.5 * (step + lag) * qacc)
            qvel = qvel + step * qacc
        return qpos, qvel

    def _solve(
        self,
        position: Tensor,
        velocity: Tensor,
        qacc_smooth: Tensor,
        coupling: Tensor,
        force: Tensor,
    ) -> tuple[Tensor, Tensor]:
        """Forces ``(L, N)`` of the limits, starting from the last ones, and their signs."""
        low, high = self.limits
        below, above = low - position, position - high
        side = torch.where(below > above, 1.0, -1.0)
        depth = torch.maximum(below, above)
        is_beyond = depth > 0.0
        impedance = self._impedance(depth)
        stiffness, damping, weight = self.law
        reference = stiffness * impedance * depth
        reference = reference - side * (damping * velocity + qacc_smooth)
        softness = (1.0 / impedance - 1.0) * weight
        bound = (coupling.abs() * is_beyond).sum(1) + softness
        for _ in range(NUM_SWEEPS):
            force = torch.where(is_beyond, force, 0.0)
            qacc = side * (coupling * (side * force)).sum(1) + softness * force
            force = (force + (reference - qacc) / bound).clamp_min(0.0)
        return torch.where(is_beyond, force, 0.0), side

    def _impedance(self, depth: Tensor) -> Tensor:
        """MuJoCo's impedance d(r), 0 to 1, at that depth beyond a limit."""
        least, rise, width, middle, early, late = self.impedance
        x = (depth / width).clamp(0.0, 1.0)
        power = self.power if self.even_power is None else self.even_power
        end = 1.0 - late * (1.0 - x) ** power
        return least + rise * torch.where(x < middle, early * x**power, end)


def _impedance_parameters(solimp: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Least, rise, width, middle and two scales, ``(6, L)``, and the power, ``(L,)``."""
    least, most, width, middle, power = solimp.T
    bounds = MIN_IMPEDANCE, MAX_IMPEDANCE
    least, most, middle = (x.clip(*bounds) for x in (least, most, middle))
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
    (first, second), most = solref.T, most.clip(MIN_IMPEDANCE, MAX_IMPEDANCE)
    is_direct = first <= 0.0
    shortest = 2.0 * substep
    if model.opt.disableflags & mujoco.mjtDisableBit.mjDSBL_REFSAFE:
        shortest = TINY
    time, ratio = np.maximum(first, shortest), np.maximum(second, TINY)
    stiffness = np.where(is_direct, -first / most**2, (most * time * ratio) ** -2)
    return stiffness, np.where(is_direct, -second / most, 2.0 / (most * time))
