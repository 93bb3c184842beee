"""How each kind of parameter changes a MuJoCo model; `Variation` says what they are."""

from collections.abc import Callable
from dataclasses import dataclass

import mujoco
import numpy as np


class Fields(dict[str, np.ndarray]):
    """Fields of a model, a copy per env ``(num_envs, ...)``, made when asked for.

    Those of its options are named as in ``"opt.gravity"``.
    """

    def __init__(self, model: mujoco.MjModel, num_envs: int) -> None:
        super().__init__()
        self.model, self.num_envs = model, num_envs

    def __missing__(self, name: str) -> np.ndarray:
        owner = self.model.opt if name.startswith("opt.") else self.model
        value = np.asarray(getattr(owner, name.removeprefix("opt.")))
        self[name] = np.repeat(value[None], self.num_envs, 0)
        return self[name]


Write = Callable[[Fields, list[int], np.ndarray], None]
"""``(fields, indices of the target, values (num_envs, V))``: changes the fields."""


@dataclass(frozen=True)
class Kind:
    """What a kind of parameter acts on, its unit, and how it changes a model."""

    target: str  # a kind of MuJoCo's objects; "axis", or "" where there is none
    unit: str  # "factor" for a factor
    write: Write | None = None  # None: not by itself
    least: float = -np.inf  # of the values that a robot can have
    most: float = np.inf


def _times(*names: str) -> Write:
    def write(fields: Fields, chosen: list[int], factor: np.ndarray) -> None:
        for name in names:
            value = fields[name]
            value[:, chosen] *= factor.reshape(-1, *(1,) * (value.ndim - 1))

    return write


def _plus(name: str, axis: int) -> Write:
    def write(fields: Fields, chosen: list[int], offset: np.ndarray) -> None:
        fields[name][:, chosen, axis] += offset

    return write


def _to(name: str) -> Write:
    def write(fields: Fields, chosen: list[int], value: np.ndarray) -> None:
        fields[name][:, chosen] = value

    return write


def _stiffer(name: str) -> Write:
    """A ``solref``: minus stiffness and damping, or time constant and damping ratio."""

    def write(fields: Fields, chosen: list[int], factor: np.ndarray) -> None:
        solref, root = fields[name], np.sqrt(factor)
        first, second = solref[:, chosen].transpose(2, 0, 1)  # (num_envs, chosen) each
        is_direct = first < 0.0
        solref[:, chosen, 0] = np.where(is_direct, first * factor, first / root)
        solref[:, chosen, 1] = np.where(is_direct, second * root, second)

    return write


def _contacts(field: str, change: Callable[[str], Write]) -> Write:
    """Change the contacts of geoms: their own, and the explicit pairs that they are in."""

    def write(fields: Fields, geoms: list[int], value: np.ndarray) -> None:
        change(f"geom_{field}")(fields, geoms, value)
        ends = fields.model.pair_geom1, fields.model.pair_geom2
        pairs = np.flatnonzero(np.isin(ends, geoms).any(0)).tolist()
        if pairs:
            change(f"pair_{field}")(fields, pairs, value)

    return write


def _slope(fields: Fields, axes: list[int], angle: np.ndarray) -> None:
    gravity = fields["opt.gravity"]  # (num_envs, 3), down at first
    size = np.linalg.norm(gravity, axis=1, keepdims=True)
    gravity[:, axes] = gravity[:, 2:] * np.tan(angle)
    length = np.linalg.norm(gravity, axis=1, keepdims=True)
    gravity *= size / np.maximum(length, 1e-300)


def _payload(fields: Fields, bodies: list[int], given: np.ndarray) -> None:
    """Point masses ``given[:, 0]`` at places ``given[:, 1:]``, NaN: centre of mass."""
    for body in bodies:
        for env, (load, *place) in enumerate(given):
            mass = fields["body_mass"][env]
            names = "body_ipos", "body_iquat", "body_inertia"
            centre, quat, inertia = (fields[name][env, body] for name in names)
            arm = np.where(np.isnan(place), 0.0, place - centre)
            total = mass[body] + load
            if load and arm.any():
                axes, reduced = np.zeros(9), mass[body] * load / total
                mujoco.mju_quat2Mat(axes, quat)
                axes = axes.reshape(3, 3)
                square = arm @ arm * np.eye(3) - np.outer(arm, arm)
                moments = (axes * inertia) @ axes.T + reduced * square
                inertia[:], axes = np.linalg.eigh(moments)
                axes[:, 2] *= np.linalg.det(axes)  # right-handed
                mujoco.mju_mat2Quat(quat, axes.ravel())
                centre += load / total * arm
            mass[body] = total


MOTOR = _times("actuator_gainprm", "actuator_biasprm", "actuator_forcerange")
"""What makes the strength of actuators times the value."""

STEEPEST = 1.5  # rad: gravity turns by less than a right angle
TINIEST = 5e-324  # a factor is above zero
KINDS = {
    "mass": Kind("body", "factor", _times("body_mass", "body_inertia"), TINIEST),
    "com_x": Kind("body", "m", _plus("body_ipos", 0)),
    "com_y": Kind("body", "m", _plus("body_ipos", 1)),
    "com_z": Kind("body", "m", _plus("body_ipos", 2)),
    "payload": Kind("body", "kg", _payload, 0.0),
    **{f"payload_{axis}": Kind("body", "m") for axis in "xyz"},
    "damping": Kind("joint", "N s/m or N m s/rad", _to("dof_damping"), 0.0),
    "frictionloss": Kind("joint", "N or N m", _to("dof_frictionloss"), 0.0),
    "armature": Kind("joint", "kg or kg m^2", _to("dof_armature"), 0.0),
    "motor": Kind("joint", "factor", least=TINIEST),
    "delay": Kind("", "control steps", least=0.0),
    "friction": Kind("geom", "factor", _contacts("friction", _times), TINIEST),
    "stiffness": Kind("geom", "factor", _contacts("solref", _stiffer), TINIEST),
    "slope": Kind("axis", "rad", _slope, -STEEPEST, STEEPEST),
}
"""By name, in the order in which they change a model."""
