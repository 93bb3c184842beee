"""Physical parameters that differ from robot to robot and that no feature tells.

A parameter is named ``KIND`` or ``KIND:TARGET``. With V its value:

| kind | target | value | what the robot has |
|---|---|---|---|
| ``mass`` | body | factor | mass and inertia times V |
| ``payload`` | body | kg | a point mass V, at the centre of mass |
| ``payload_x``, ``payload_y``, ``payload_z`` | body | m, body frame | or at this place |
| ``com_x``, ``com_y``, ``com_z`` | body | m, body frame | centre of mass moved by V |
| ``damping`` | joint | N s/m, N m s/rad | damping V |
| ``frictionloss`` | joint | N, N m | dry friction V |
| ``armature`` | joint | kg, kg m^2 | armature V |
| ``motor`` | joint | factor | the strength of the motors on it times V |
| ``delay`` | | control steps | every torque V steps later, none before the first |
| ``friction`` | geom | factor | sliding, torsional and rolling friction times V |
| ``stiffness`` | geom | factor | contact stiffness times V, the same damping ratio |
| ``slope`` | ``x``, ``y`` | rad | ground that rises along the axis: gravity turns |

Without a target: all bodies that move, all joints, all geoms. Of two geoms in contact
MuJoCo takes the greater friction, unless one has a higher priority, as the geoms of this
package's robots have. An explicit pair has a friction and a stiffness of its own, which
change with those of either geom. Factors are drawn log-uniform, all other values uniform.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from math import isfinite

import mujoco
import numpy as np
import torch
from torch import Generator, Tensor

from torchrl_nerd.geometry.manifold import HINGE, SLIDE
from torchrl_nerd.scenes.parameter_kinds import KINDS, MOTOR, Fields, Kind
from torchrl_nerd.scenes.support import ON_JOINT

Ranges = Mapping[str, Sequence[float]]
"""Name of each parameter -> lowest and highest value."""


@dataclass(frozen=True)
class Parameter:
    """One parameter of a `Variation`."""

    name: str
    kind: str  # the part of its name before the colon
    low: float
    high: float
    indices: list[int]  # of its target's bodies, dofs or geoms

    @property
    def suffix(self) -> str:
        """Of its name, such as ``:torso``; empty without a target."""
        return self.name.removeprefix(self.kind)

    @property
    def is_factor(self) -> bool:
        """Whether it multiplies what the robot has."""
        return KINDS[self.kind].unit == "factor"


class Variation:
    """Named parameters of a robot and their ranges; see the table of this file.

    ``actuated`` are the robot's actuated dofs, in the order of the joint torques.

    Raises:
        ValueError: in one sentence, a kind or target that is not there, a range that
            cannot be, a payload's place without a payload, or a payload on a body
            whose weight MuJoCo compensates.
    """

    def __init__(
        self, model: mujoco.MjModel, actuated: list[int], ranges: Ranges
    ) -> None:
        if not isinstance(ranges, Mapping):
            raise ValueError(f"expected parameters and their ranges, got {ranges!r}")
        self.model, self.actuated = model, actuated
        self.parameters = [_parameter(model, *item) for item in ranges.items()]
        self._columns = {p.name: i for i, p in enumerate(self.parameters)}
        for parameter in self.parameters:
            name, kind = parameter.name, parameter.kind
            load = "payload" + parameter.suffix
            if kind.startswith("payload_") and load not in ranges:
                raise ValueError(f"expected '{load}' beside '{name}', got none")
            moves = kind.startswith(("com_", "payload_"))
            if moves and model.body_simple[parameter.indices].any():
                raise ValueError(
                    f"expected a body that MuJoCo takes for no simple one for '{name}': "
                    'give it simple="false" in the file'
                )
            if kind == "payload" and model.body_gravcomp[parameter.indices].any():
                raise ValueError(
                    f"expected a body without gravcomp for '{name}', which would carry "
                    "the payload's weight as well"
                )
            if kind == "motor":
                self._expect_motors(parameter)

    def _expect_motors(self, parameter: Parameter) -> None:
        """Refuse joints without a motor of their own, or whose torque is clipped."""
        model, name, dofs = self.model, parameter.name, {*parameter.indices}
        if parameter.suffix and not dofs <= {*self.actuated}:
            raise ValueError(f"expected a joint with a motor, got '{name}'")
        if parameter.suffix and not dofs <= {*self._motor_dofs.tolist()}:
            raise ValueError(
                f"expected a motor on the joint, got a tendon's in '{name}'"
            )
        chosen = dofs if parameter.suffix else {*self.actuated}
        if model.jnt_actfrclimited[model.dof_jntid[[*chosen]]].any():
            raise ValueError(
                f"expected motors of joints without an actuatorfrcrange, got '{name}'"
            )

    @property
    def size(self) -> int:
        """How many parameters there are."""
        return len(self.parameters)

    @property
    def ranges(self) -> dict[str, list[float]]:
        """Lowest and highest value of each, as cards have them."""
        return {p.name: [p.low, p.high] for p in self.parameters}

    @cached_property
    def max_delay(self) -> int:
        """Longest delay of a torque, control steps."""
        return int(sum(p.high for p in self.parameters if p.kind == "delay"))

    def values(self, u: Tensor) -> Tensor:
        """Parameters ``(*batch, size)`` from as many uniform numbers in [0, 1)."""
        values = []
        for p, share in zip(self.parameters, u.unbind(-1), strict=True):
            if p.is_factor:
                values.append(p.low * (p.high / p.low) ** share)
            elif p.kind == "delay":
                values.append((p.low + (p.high - p.low + 1.0) * share).floor())
            else:
                values.append(p.low + (p.high - p.low) * share)
        return torch.stack(values, -1)

    def draw(self, count: int, generator: Generator) -> Tensor:
        """Random parameters ``(count, size)``, float64."""
        shape = count, self.size
        return self.values(torch.rand(shape, dtype=torch.float64, generator=generator))

    def check(self, parameters: Tensor) -> None:
        """Refuse values ``(*batch, size)`` that no robot can have.

        Ranges may be left, but for a delay, whose longest is kept.

        Raises:
            ValueError: naming the first such parameter.
        """
        for p, value in zip(self.parameters, parameters.unbind(-1), strict=True):
            about, is_finite = KINDS[p.kind], value.isfinite()
            wrong = ~(is_finite & (value >= about.least) & (value <= about.most))
            if p.kind == "delay":
                wrong |= (value != value.floor()) | (value > p.high)
            if wrong.any():
                found = float(value[wrong][0])
                raise ValueError(f"expected a possible '{p.name}', got {found:g}")

    def shares(self, parameters: Tensor) -> Tensor:
        """Where parameters ``(*batch, size)`` lie in their ranges: -1 to 1."""
        shares = []
        for p, value in zip(self.parameters, parameters.unbind(-1), strict=True):
            low, high = p.low, p.high
            if p.is_factor:
                low, high, value = np.log(low), np.log(high), value.log()
            shares.append((2.0 * value - low - high) / max(high - low, 1e-9))
        return torch.stack(shares, -1)

    def fields(self, parameters: np.ndarray) -> Fields:
        """The fields of MuJoCo's model that change, ``(num_envs, ...)`` each.

        ``parameters (num_envs, size)``. What acts on joint torques is in `strength` and
        `delay`.
        """
        fields = Fields(self.model, len(parameters))
        for kind, about in KINDS.items():
            # those of all bodies or joints first: one of its own has the last word
            for i, p in sorted(self._of_kind(kind), key=lambda x: ":" in x[1].name):
                value, indices = parameters[:, i : i + 1], p.indices
                if kind == "payload":
                    names = (f"payload_{x}{p.suffix}" for x in "xyz")
                    columns = [self._columns.get(name) for name in names]
                    none = np.full(len(parameters), np.nan)
                    at = [none if j is None else parameters[:, j] for j in columns]
                    value = np.column_stack((value, *at))
                if about.write is not None:
                    about.write(fields, indices, value)
                elif kind == "motor":
                    is_on = np.isin(self._motor_dofs, indices) | (p.name == "motor")
                    MOTOR(fields, np.flatnonzero(is_on).tolist(), value)
        return fields

    def strength(self, parameters: np.ndarray) -> np.ndarray:
        """Factor of every joint torque, ``(num_envs, num_actuated)``."""
        factor = np.ones((len(parameters), len(self.actuated)))
        for i, p in self._of_kind("motor"):
            is_on = np.isin(self.actuated, p.indices) | (p.name == "motor")
            factor[:, is_on] *= parameters[:, i : i + 1]
        return factor

    def delay(self, parameters: np.ndarray) -> np.ndarray:
        """Control steps by which every torque is late, integers ``(num_envs,)``."""
        columns = [i for i, _ in self._of_kind("delay")]
        return parameters[:, columns].sum(1).astype(int)

    def _of_kind(self, kind: str) -> Iterator[tuple[int, Parameter]]:
        return ((i, p) for i, p in enumerate(self.parameters) if p.kind == kind)

    @cached_property
    def _motor_dofs(self) -> np.ndarray:
        """The dof of the joint that each actuator acts on; -1 where it is on no joint."""
        model, is_on = self.model, np.isin(self.model.actuator_trntype, ON_JOINT)
        joint = np.where(is_on, model.actuator_trnid[:, 0], 0)
        return np.where(is_on, model.jnt_dofadr[joint], -1)


def ranges_of(variation: Variation | None) -> dict[str, list[float]] | None:
    """What cards say of a scene's variation: its ranges; None where nothing varies."""
    return None if variation is None else variation.ranges


def expect_told(known: Ranges | None, found: Variation | None) -> None:
    """Raise ValueError where a told model meets parameters that it does not know.

    ``known``: ranges that it is told, whose order counts; None where it is told nothing.
    """
    if known is not None and str(known) != str(got := ranges_of(found)):
        raise ValueError(
            f"expected the parameters {known} that the model is told, got {got}"
        )


def _parameter(model: mujoco.MjModel, name: str, given: Sequence[float]) -> Parameter:
    """A parameter and its target's indices; refuses what cannot be."""
    kind, _, target = str(name).partition(":")
    if kind not in KINDS:
        raise ValueError(f"expected a kind of {', '.join(KINDS)}, got '{name}'")
    about = KINDS[kind]
    try:
        low, high = (float(x) for x in given)
    except (TypeError, ValueError):
        raise ValueError(
            f"expected the lowest and the highest value of '{name}', got {given!r}"
        ) from None
    is_whole = kind != "delay" or (low.is_integer() and high.is_integer())
    is_finite = isfinite(high - low) and (low <= 0.0 or isfinite(high / low))
    if not (about.least <= low <= high <= about.most and is_finite and is_whole):
        raise ValueError(
            f"expected a possible range for '{name}', got {low:g}:{high:g}"
        )
    return Parameter(name, kind, low, high, _indices(model, about, target, name))


def _indices(model: mujoco.MjModel, kind: Kind, target: str, name: str) -> list[int]:
    """Bodies, dofs or geoms of a target, or of all; of an axis its number."""
    if kind.target == "axis":
        if target not in ("x", "y") or model.opt.gravity[:2].any():
            raise ValueError(
                f"expected slope:x or slope:y on level ground, got '{name}'"
            )
        return ["xy".index(target)]
    if kind.target == "":
        if target:
            raise ValueError(f"expected 'delay' without a target, got '{name}'")
        return []
    has_override = model.opt.enableflags & mujoco.mjtEnableBit.mjENBL_OVERRIDE
    if kind.target == "geom" and has_override:
        raise ValueError(
            f"expected contacts of their own for '{name}', got a model with <flag "
            'override="enable"/>, where all are the same'
        )
    every = {
        "body": model.body_dofnum[model.body_weldid] > 0,
        "joint": np.isin(model.jnt_type, (HINGE, SLIDE)),
        "geom": np.ones(model.ngeom, bool),
    }[kind.target]
    chosen = np.flatnonzero(every)
    if target:
        found = chosen if kind.target == "body" else range(len(every))
        names = {getattr(model, kind.target)(int(i)).name: int(i) for i in found}
        if target not in names:
            known = ", ".join(filter(None, names)) or "none"
            raise ValueError(f"expected a {kind.target} of {known}, got '{name}'")
        chosen = [names[target]]
    if kind.target == "joint":
        chosen = np.flatnonzero(np.isin(model.dof_jntid, chosen))  # its dofs
    return [int(i) for i in chosen]
