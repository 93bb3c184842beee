"""What turns an action into joint torque: everything a learned solver never sees.

A controller is a function of the action and the state; a new one needs no new model.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import mujoco
import numpy as np
import torch
from torch import Tensor

from torchrl_nerd.geometry.constants import constant, take
from torchrl_nerd.geometry.manifold import BALL, HINGE, SLIDE

JOINT, IN_PARENT, TENDON = (
    int(getattr(mujoco.mjtTrn, f"mjTRN_{kind}"))
    for kind in ("JOINT", "JOINTINPARENT", "TENDON")
)
WRAP_JOINT = mujoco.mjtWrap.mjWRAP_JOINT
FIXED, AFFINE = mujoco.mjtGain.mjGAIN_FIXED, mujoco.mjtGain.mjGAIN_AFFINE
NO_BIAS, AFFINE_BIAS = mujoco.mjtBias.mjBIAS_NONE, mujoco.mjtBias.mjBIAS_AFFINE

Row = tuple[float, ...]
UNLIMITED = 1e300  # N or N m: finite, so that the card of a data set can hold it


class Controller(Protocol):
    """``(action (*batch, num_actions), qpos, qvel) -> joint torque``, float64."""

    @property
    def num_actions(self) -> int:
        """Width of the action."""
        ...

    def __call__(self, action: Tensor, qpos: Tensor, qvel: Tensor) -> Tensor:
        """Joint torques ``(*batch, num_actuated)``, N and N m, in the dtype of qpos."""
        ...


@dataclass(frozen=True, eq=False)  # torch 2.11 compiles no other made in a step
class TorqueController:
    """Torque proportional to the action: ``gain * clip(action, -1, 1)``."""

    gain: Row  # N or N m per unit of action, one per actuated dof

    @property
    def num_actions(self) -> int:
        """One per actuated dof."""
        return len(self.gain)

    def __call__(self, action: Tensor, qpos: Tensor, qvel: Tensor) -> Tensor:
        """Joint torques ``(*batch, num_actuated)``."""
        return action.to(qpos.dtype).clamp(-1.0, 1.0) * constant(qpos, self.gain)


@dataclass(frozen=True, eq=False)  # torch 2.11 compiles no other made in a step
class PDController:
    """A spring and damper to a target: ``clip(kp (target - q) - kd v, -limit, limit)``.

    The target is ``scale * clip(action, -1, 1)`` from the pose ``default``, or from the
    present position where there is none.

    Raises:
        ValueError: lengths that differ.
    """

    qpos_addresses: tuple[int, ...]  # of the actuated joints
    dof_addresses: tuple[int, ...]  # of the same joints
    kp: Row  # stiffness, N m/rad or N/m, one per joint
    kd: Row  # damping, N m s/rad or N s/m
    scale: Row  # rad or m per unit of action
    default: Row | None = None  # pose of the actuated joints, rad or m
    limit: Row | None = None  # largest torque; None for none

    def __post_init__(self) -> None:
        for name in ("dof_addresses", "kp", "kd", "scale", "default", "limit"):
            value = getattr(self, name)
            if value is not None and len(value) != self.num_actions:
                raise ValueError(
                    f"expected {self.num_actions} numbers as {name}, got {len(value)}"
                )

    @property
    def num_actions(self) -> int:
        """One per actuated joint."""
        return len(self.qpos_addresses)

    def __call__(self, action: Tensor, qpos: Tensor, qvel: Tensor) -> Tensor:
        """Joint torques ``(*batch, num_actuated)``."""
        target = action.to(qpos.dtype).clamp(-1.0, 1.0) * constant(qpos, self.scale)
        position = take(qpos, self.qpos_addresses)
        default = position if self.default is None else constant(qpos, self.default)
        offset = target + default - position
        velocity = take(qvel, self.dof_addresses)
        torque = constant(qpos, self.kp) * offset - constant(qpos, self.kd) * velocity
        if self.limit is None:
            return torque
        return clip(torque, [-limit for limit in self.limit], self.limit)


@dataclass(frozen=True)
class ActuatorController:
    """The actuators of a MuJoCo model, whose ``ctrl`` is held over the control step.

    An action of -1 to 1 spans an actuator's control range (-1 to 1 where it has none).
    The ground truth gives ``ctrl`` to MuJoCo, which evaluates its own law at every substep.
    The torque here is that of the step's start, without ``actuatorgravcomp``. With the
    lengths l = ``length`` q and speeds v = ``moment`` qvel of actuators on joints and fixed
    tendons,

        force = clip((g0 + g1 l + g2 v) ctrl + b0 + b1 l + b2 v, force range)
        torque = clip(moment^T force, torque range)

    so several actuators on one joint add up. Other actuators (on a site, a body, a
    slider-crank, a spatial tendon, a muscle) have no torque here: they are told by
    ``ctrl`` alone.
    Source: https://mujoco.readthedocs.io/en/stable/computation/#actuation-model
    """

    dof_addresses: tuple[int, ...]  # the D driven dofs
    qpos_addresses: tuple[int, ...]  # of the same joints
    ctrl_low: Row  # control of each of the A actuators at action -1
    ctrl_high: Row  # and at action 1
    length: tuple[Row, ...]  # (A, D): gear, or gear times coefficient of a fixed tendon
    moment: tuple[Row, ...]  # (A, D): the same, and the gears of ball joints
    gain: tuple[Row, ...]  # (A, 3): g
    bias: tuple[Row, ...]  # (A, 3): b
    force_low: Row  # of each actuator
    force_high: Row
    torque_low: Row  # of each dof, N and N m
    torque_high: Row
    is_motor: bool  # no force depends on the state: the torque tells all

    @classmethod
    def from_model(cls, model: mujoco.MjModel) -> "ActuatorController":
        """Read the actuators of a model that `check_supported` let pass."""
        dofs, has_torque = driven_dofs(model), has_closed_form(model)
        joints = model.dof_jntid[dofs]
        moment = _actuator_moments(model)[:, dofs]
        is_scalar = np.isin(model.jnt_type[joints], (HINGE, SLIDE))
        gain, bias = model.actuator_gainprm[:, :3].copy(), model.actuator_biasprm[:, :3]
        gain[model.actuator_gaintype != AFFINE, 1:] = 0.0
        has_bias = model.actuator_biastype == AFFINE_BIAS
        bias = np.where(has_bias[:, None], bias, 0.0)
        is_constant = has_torque & ~gain[:, 1:].any(1) & ~bias.any(1)
        is_torque_limited = model.jnt_actfrclimited[joints] * is_scalar
        control = _ranges(model.actuator_ctrllimited, model.actuator_ctrlrange, 1.0)
        force = model.actuator_forcelimited, model.actuator_forcerange
        torque = is_torque_limited, model.jnt_actfrcrange[joints]
        return cls(
            tuple(dofs),
            tuple(model.jnt_qposadr[joints].tolist()),
            *control,
            _rows(np.where(is_scalar, moment, 0.0)),
            _rows(moment),
            _rows(gain),
            _rows(bias),
            *_ranges(*force, UNLIMITED),
            *_ranges(*torque, UNLIMITED),
            bool(is_constant.all() and not model.jnt_actgravcomp.any()),
        )

    @property
    def num_actions(self) -> int:
        """One per actuator."""
        return len(self.ctrl_low)

    def ctrl(self, action: Tensor) -> Tensor:
        """What MuJoCo's ``data.ctrl`` is at an action, ``(*batch, A)``."""
        low, high = constant(action, (self.ctrl_low, self.ctrl_high))
        return torch.lerp(low, high, 0.5 * (action.clamp(-1.0, 1.0) + 1.0))

    def __call__(self, action: Tensor, qpos: Tensor, qvel: Tensor) -> Tensor:
        """Joint torques ``(*batch, D)``, in the dtype of qpos."""
        return self.torque(self.ctrl(action.to(qpos.dtype)), qpos, qvel)

    def torque(self, ctrl: Tensor, qpos: Tensor, qvel: Tensor) -> Tensor:
        """Joint torques ``(*batch, D)`` at a control ``(*batch, A)`` within its range."""
        shape = (self.num_actions, len(self.dof_addresses))
        length, moment = (
            constant(qpos, x).reshape(shape) for x in (self.length, self.moment)
        )
        gain, bias = (  # three of (A,) each
            constant(qpos, x).reshape(self.num_actions, 3).unbind(-1)
            for x in (self.gain, self.bias)
        )
        stretch = take(qpos, self.qpos_addresses) @ length.mT  # (*batch, A)
        speed = take(qvel, self.dof_addresses) @ moment.mT
        force = (gain[0] + gain[1] * stretch + gain[2] * speed) * ctrl
        force = force + bias[0] + bias[1] * stretch + bias[2] * speed
        force = clip(force, self.force_low, self.force_high)
        return clip(force @ moment, self.torque_low, self.torque_high)


def ctrl_range(model: mujoco.MjModel) -> tuple[Row, Row]:
    """Smallest and largest control of each actuator; `UNLIMITED` where none is clipped."""
    is_clipped = not model.opt.disableflags & mujoco.mjtDisableBit.mjDSBL_CLAMPCTRL
    is_limited = model.actuator_ctrllimited * is_clipped
    return _ranges(is_limited, model.actuator_ctrlrange, UNLIMITED)


def clipped_ctrl(model: mujoco.MjModel, ctrl: Tensor) -> Tensor:
    """What MuJoCo takes a control ``(*batch, nu)`` for: one within its range."""
    return clip(ctrl, *ctrl_range(model))


def driven_dofs(model: mujoco.MjModel) -> list[int]:
    """Distinct dofs of `has_closed_form` actuators, in the order of the actuators."""
    _, dofs = np.nonzero(_actuator_moments(model))
    return list(dict.fromkeys(dofs.tolist()))


def has_closed_form(model: mujoco.MjModel) -> np.ndarray:
    """Which actuators ``(A,)`` have a torque that an `ActuatorController` computes.

    Fixed or affine laws on hinges, slides and fixed tendons, and on ball joints whose angle
    they do not read.
    """
    gain, bias = model.actuator_gaintype, model.actuator_biastype
    is_known = np.isin(gain, (FIXED, AFFINE)) & np.isin(bias, (NO_BIAS, AFFINE_BIAS))
    reads_angle = (gain == AFFINE) & (model.actuator_gainprm[:, 1] != 0.0)
    reads_angle |= (bias == AFFINE_BIAS) & (model.actuator_biasprm[:, 1] != 0.0)

    def has_constant_moment(i: int) -> bool:
        kind, target = model.actuator_trntype[i], model.actuator_trnid[i, 0]
        if kind == TENDON:
            is_fixed = model.wrap_type[model.tendon_adr[target]] == WRAP_JOINT
            return bool(is_fixed and not model.tendon_actfrclimited[target])
        if kind not in (JOINT, IN_PARENT):
            return False
        is_ball = model.jnt_type[target] == BALL
        is_scalar = model.jnt_type[target] in (HINGE, SLIDE)
        return bool(is_scalar or (is_ball and kind == JOINT and not reads_angle[i]))

    is_constant = [has_constant_moment(i) for i in range(model.nu)]
    return is_known & np.array(is_constant, bool)


def _actuator_moments(model: mujoco.MjModel) -> np.ndarray:
    """Generalised force per unit of force ``(A, nv)`` of actuators with a closed form."""
    data, dense = mujoco.MjData(model), np.zeros((model.nu, model.nv))
    mujoco.mj_fwdPosition(model, data)
    if model.nu:
        rows = data.moment_rownnz, data.moment_rowadr, data.moment_colind
        mujoco.mju_sparse2dense(dense, data.actuator_moment, *rows)
    dense[~has_closed_form(model)] = 0.0
    return dense


def _ranges(is_limited: np.ndarray, ranges: np.ndarray, free: float) -> tuple[Row, Row]:
    """Lower and upper limits, ``-free`` and ``free`` where there are none."""
    limited = np.asarray(is_limited, bool)[:, None]
    low, high = np.where(limited, ranges.reshape(-1, 2), (-free, free)).T
    return tuple(low.tolist()), tuple(high.tolist())


def _rows(matrix: np.ndarray) -> tuple[Row, ...]:
    return tuple(map(tuple, matrix.tolist()))


def clip(x: Tensor, low: Sequence[float], high: Sequence[float]) -> Tensor:
    """``x (*batch, n)`` from ``low`` to ``high``, n numbers each."""
    return torch.minimum(torch.maximum(x, constant(x, low)), constant(x, high))
