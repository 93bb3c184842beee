"""The actuators of a MuJoCo model as a controller: action to joint torque by their own law.

Source: https://mujoco.readthedocs.io/en/stable/computation/#actuation-model
"""

from dataclasses import dataclass

import mujoco
import numpy as np
import torch
from torch import Generator, Tensor

from torchrl_nerd.geometry.manifold import HINGE, SLIDE

Row = tuple[float, ...]
UNLIMITED = 1e300  # N or N m: finite, so that the card of a data set can hold it
AFFINE_GAIN, AFFINE_BIAS = mujoco.mjtGain.mjGAIN_AFFINE, mujoco.mjtBias.mjBIAS_AFFINE


@dataclass(frozen=True)
class ActuatorController:
    """Motors, position and velocity servos, with their gears and limits.

    An action of -1 to 1 spans an actuator's control range (-1 to 1 where it has none).
    With the lengths l = ``length`` q and speeds v = ``moment`` qvel of the actuators,

        force = clip((g0 + g1 l + g2 v) ctrl + b0 + b1 l + b2 v, force range)
        torque = clip(moment^T force, torque range)

    so several actuators on one joint add up. The torque is computed once and then held
    over the control step; MuJoCo computes a servo's again at every substep. For motors
    this is the same.

    | field | meaning |
    |---|---|
    | ``dof_addresses`` | the D driven dofs |
    | ``qpos_addresses`` | of the same joints, ``(D,)`` |
    | ``ctrl_low``, ``ctrl_high`` | control of each of the A actuators at action -1 and 1 |
    | ``length`` | ``(A, D)``: gear, or gear times coefficient of a fixed tendon |
    | ``moment`` | ``(A, D)``: the same, and the gears of ball joints |
    | ``gain``, ``bias`` | ``(A, 3)``: g and b |
    | ``force_low``, ``force_high`` | limits of each actuator's force |
    | ``torque_low``, ``torque_high`` | limits of each dof's torque, N and N m |
    """

    dof_addresses: tuple[int, ...]
    qpos_addresses: tuple[int, ...]
    ctrl_low: Row
    ctrl_high: Row
    length: tuple[Row, ...]
    moment: tuple[Row, ...]
    gain: tuple[Row, ...]
    bias: tuple[Row, ...]
    force_low: Row
    force_high: Row
    torque_low: Row
    torque_high: Row

    @classmethod
    def from_model(cls, model: mujoco.MjModel) -> "ActuatorController":
        """Read the actuators of a model that `check_supported` let pass."""
        dofs = driven_dofs(model)
        joints = model.dof_jntid[dofs]
        moment = actuator_moments(model)[:, dofs]
        is_scalar = np.isin(model.jnt_type[joints], (HINGE, SLIDE))
        gain, bias = model.actuator_gainprm[:, :3].copy(), model.actuator_biasprm[:, :3]
        gain[model.actuator_gaintype != AFFINE_GAIN, 1:] = 0.0
        bias = np.where((model.actuator_biastype == AFFINE_BIAS)[:, None], bias, 0.0)
        ctrl = _ranges(model.actuator_ctrllimited, model.actuator_ctrlrange, 1.0)
        force = _ranges(
            model.actuator_forcelimited, model.actuator_forcerange, UNLIMITED
        )
        is_limited = model.jnt_actfrclimited[joints] * is_scalar
        torque = _ranges(is_limited, model.jnt_actfrcrange[joints], UNLIMITED)
        return cls(
            tuple(dofs),
            tuple(int(q) for q in model.jnt_qposadr[joints]),
            *ctrl,
            _rows(np.where(is_scalar, moment, 0.0)),
            _rows(moment),
            _rows(gain),
            _rows(bias),
            *force,
            *torque,
        )

    @property
    def num_actions(self) -> int:
        """One per actuator."""
        return len(self.ctrl_low)

    @property
    def is_motor(self) -> bool:
        """True where no force depends on the state."""
        follows_state = (
            gain[1:] + bias for gain, bias in zip(self.gain, self.bias, strict=True)
        )
        return not any(map(any, follows_state))

    def ctrl(self, action: Tensor) -> Tensor:
        """What MuJoCo's ``data.ctrl`` would be at an action, ``(*batch, A)``."""
        low, high = action.new_tensor((self.ctrl_low, self.ctrl_high))
        return torch.lerp(low, high, 0.5 * (action.clamp(-1.0, 1.0) + 1.0))

    def __call__(self, action: Tensor, qpos: Tensor, qvel: Tensor) -> Tensor:
        """Joint torques ``(*batch, D)``, in the dtype of qpos."""
        shape = (self.num_actions, len(self.dof_addresses))
        length, moment = (
            qpos.new_tensor(x).reshape(shape) for x in (self.length, self.moment)
        )
        gain, bias = (
            qpos.new_tensor(x).reshape(self.num_actions, 3).unbind(-1)
            for x in (self.gain, self.bias)
        )
        ctrl = self.ctrl(action.to(qpos.dtype))
        stretch = qpos[..., self.qpos_addresses] @ length.mT
        speed = qvel[..., self.dof_addresses] @ moment.mT
        force = (gain[0] + gain[1] * stretch + gain[2] * speed) * ctrl
        force = force + bias[0] + bias[1] * stretch + bias[2] * speed
        force = _clip(force, self.force_low, self.force_high)
        return _clip(force @ moment, self.torque_low, self.torque_high)


@dataclass(frozen=True)
class RandomActions:
    """Drives training trajectories of servos: a new uniform action every control step.

    Uniform torques as large as a stiff servo's would throw the robot about as no servo
    does.
    """

    controller: ActuatorController

    def __call__(
        self, qpos: Tensor, qvel: Tensor, scale: Tensor, generator: Generator
    ) -> Tensor:
        """Joint torques ``(rows, D)``, times each row's scale ``(rows, 1)``."""
        size = (len(qpos), self.controller.num_actions)
        u = torch.rand(size, dtype=torch.float64, generator=generator)
        return scale * self.controller(2.0 * u - 1.0, qpos, qvel)


def actuator_moments(model: mujoco.MjModel) -> np.ndarray:
    """Generalised force per unit of actuator force ``(A, nv)``, at ``qpos0``.

    Constant for joints and fixed tendons.
    """
    data, dense = mujoco.MjData(model), np.zeros((model.nu, model.nv))
    mujoco.mj_fwdPosition(model, data)
    if model.nu:
        mujoco.mju_sparse2dense(
            dense,
            data.actuator_moment,
            data.moment_rownnz,
            data.moment_rowadr,
            data.moment_colind,
        )
    return dense


def driven_dofs(model: mujoco.MjModel) -> list[int]:
    """Distinct dofs that actuators act on, in the order of the actuators."""
    _, dofs = np.nonzero(actuator_moments(model))
    return list(dict.fromkeys(int(dof) for dof in dofs))


def _ranges(is_limited: np.ndarray, ranges: np.ndarray, free: float) -> tuple[Row, Row]:
    """Lower and upper limits, ``-free`` and ``free`` where there are none."""
    limited = np.asarray(is_limited, bool)[:, None]
    low, high = np.where(limited, ranges.reshape(-1, 2), (-free, free)).T
    return tuple(low.tolist()), tuple(high.tolist())


def _rows(matrix: np.ndarray) -> tuple[Row, ...]:
    return tuple(map(tuple, matrix.tolist()))


def _clip(x: Tensor, low: Row, high: Row) -> Tensor:
    return torch.minimum(torch.maximum(x, x.new_tensor(low)), x.new_tensor(high))
