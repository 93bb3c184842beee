"""What the network predicts: the change of the state over one control step, in B_t.

NeRD section 3.3 predicts s_{t+1} - s_t. Here a position's change is taken against the
trapezoid rule, dt (v_t + v_{t+1}) / 2, so that only a small smooth residual is left, and
rotations live in the tangent space: 2 nv numbers, no quaternion.
"""

from collections.abc import Callable
from typing import cast

import mujoco
import numpy as np
import torch
from tensordict import TensorDictBase
from tensordict.nn import dispatch
from torch import Tensor
from torchrl.data import Composite, TensorSpec
from torchrl.envs import Transform

from torchrl_nerd.geometry.constants import constant
from torchrl_nerd.geometry.manifold import differentiate_pos, integrate_pos
from torchrl_nerd.geometry.rotations import quat_exp, rotate, rotate_inverse
from torchrl_nerd.keys import NEXT_QPOS, NEXT_QVEL, QPOS, QVEL, STATE_DELTA
from torchrl_nerd.scenes.scene import Scene
from torchrl_nerd.transforms.base import add_to_spec, expect_keys

ROUNDING = 1e-6  # of a velocity


class StateDelta(Transform):
    """Velocity change and trapezoid residual of the position, ``(*batch, 2 nv)``.

    With x' the next value of x, h the control step, R_t the rotation of the base and Q
    that of a free or ball joint, whose angular velocity w MuJoCo writes in moving axes:

    | | velocity | position |
    |---|---|---|
    | hinge, slide | v' - v | q' - q - h/2 (v + v') |
    | free, linear | R_t^T (v' - v) | R_t^T (p' - p - h/2 (v + v')) |
    | free and ball, angular | Q^T Q' w' - w | log(Q^T Q') - h/2 (w + Q^T Q' w') |

    In an env it is written under ``next`` and is zero at a reset. Where an action lasts
    several control steps it is the change over all of them, with the same h, and nothing
    that a model of one step can learn from. The inverse integrates:
    from ``qpos``, ``qvel`` and ``state_delta`` it writes the next ``qpos`` and ``qvel``.

    Examples:
        >>> transform = StateDelta(load_scene("cartpole"))
        >>> state = torch.zeros(3, 2).double()
        >>> transform.delta(state, state, state, state + 1.0)[0]
        tensor([ 1.0000,  1.0000, -0.0083, -0.0083], dtype=torch.float64)
    """

    def __init__(self, scene: Scene) -> None:
        super().__init__([QPOS, QVEL, NEXT_QPOS, NEXT_QVEL], [STATE_DELTA])
        self.layout, self.base = scene.layout, scene.base
        self.step_size, base_quat = scene.control_step, np.empty(4)
        mujoco.mju_mat2Quat(base_quat, scene.fixed_base_pose[1].reshape(-1))
        self.fixed_base_quat = tuple(base_quat.tolist())

    @property
    def size(self) -> int:
        """Width of ``state_delta``."""
        return 2 * self.layout.nv

    def error_weights(self, std: Tensor) -> Tensor:
        """Weights ``(2 nv,)`` of errors in standard deviations, so that all are speeds.

        1 of a velocity. A position's error counts as the velocity that makes it in one
        control step h, at most 1: std(position) / (h std(velocity)).
        """
        velocity, position = std.split(self.layout.nv)
        share = position / (self.step_size * velocity)
        return torch.cat((torch.ones_like(share), share.clamp_max(1.0)))

    def delta(
        self, qpos: Tensor, qvel: Tensor, next_qpos: Tensor, next_qvel: Tensor
    ) -> Tensor:
        """The change from one state to the next, ``(*batch, 2 nv)``."""
        moved, after = differentiate_pos(self.layout, qpos, next_qpos), next_qvel
        for _, v in self.layout.rotations:
            turn = quat_exp(moved[..., v : v + 3])
            after = _replace(after, v, rotate(turn, after[..., v : v + 3]))
        residual = moved - 0.5 * self.step_size * (qvel + after)
        change = after - qvel
        parts = (self._turn(qpos, x, rotate_inverse) for x in (change, residual))
        return torch.cat(tuple(parts), -1)

    def integrate(
        self,
        qpos: Tensor,
        qvel: Tensor,
        delta: Tensor,
        limit: Callable[[Tensor, float], Tensor] | None = None,
    ) -> tuple[Tensor, Tensor]:
        """The next ``qpos`` and ``qvel``: exact inverse of `delta`.

        ``limit`` keeps a motion ``(*batch, nv)`` over so many seconds within bounds: the
        next velocities, over one, and how far positions move of what begins within them.
        """
        parts = delta.split(self.layout.nv, -1)
        change, residual = (self._turn(qpos, x, rotate) for x in parts)
        after = qvel + change if limit is None else limit(qvel + change, 1.0)
        moved = 0.5 * self.step_size * (qvel + after) + residual
        if limit is not None:
            # what begins faster goes on as it may; what was slowed to the bound does not
            within = (limit(qvel, 1.0) - qvel).abs() <= ROUNDING * qvel.abs()
            moved = torch.where(within, limit(moved, self.step_size), moved)
        for _, v in self.layout.rotations:
            turn = quat_exp(moved[..., v : v + 3])
            after = _replace(after, v, rotate_inverse(turn, after[..., v : v + 3]))
        return integrate_pos(self.layout, qpos, moved), after

    def _turn(
        self, qpos: Tensor, x: Tensor, turn: Callable[[Tensor, Tensor], Tensor]
    ) -> Tensor:
        """Linear parts of free joints in a tangent vector, in axes of the base."""
        for v in self.layout.translations:
            x = _replace(x, v, turn(self._orientation(qpos), x[..., v : v + 3]))
        return x

    def _orientation(self, qpos: Tensor) -> Tensor:
        """Of the base, ``(*batch, 4)``."""
        if not self.base.is_floating:
            return constant(qpos, self.fixed_base_quat).expand(*qpos.shape[:-1], 4)
        q = self.base.qpos_address + 3
        return qpos[..., q : q + 4]

    @dispatch(source="in_keys", dest="out_keys", auto_batch_size=False)
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:  # pyright: ignore
        """Write the change between the state and the one under ``next``.

        Raises:
            KeyError: naming the keys that are not there.
        """
        expect_keys("StateDelta", self.in_keys, tensordict)
        delta = self.delta(*(tensordict[key] for key in self.in_keys))
        return tensordict.set(STATE_DELTA, delta)

    def _step(
        self, tensordict: TensorDictBase, next_tensordict: TensorDictBase
    ) -> TensorDictBase:
        before, after = tensordict, next_tensordict
        delta = self.delta(before[QPOS], before[QVEL], after[QPOS], after[QVEL])
        return next_tensordict.set(STATE_DELTA, delta)

    def _reset(
        self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase
    ) -> TensorDictBase:
        qvel = tensordict_reset[QVEL]
        zero = torch.zeros_like(torch.cat((qvel, qvel), -1))
        return tensordict_reset.set(STATE_DELTA, zero)

    def _inv_call(self, tensordict: TensorDictBase) -> TensorDictBase:
        keys = tensordict.keys(True)
        if self.parent is None and STATE_DELTA in keys:
            expect_keys("the inverse of StateDelta", (QPOS, QVEL), tensordict)
            if NEXT_QPOS not in keys or NEXT_QVEL not in keys:  # a buffer's has both
                given = (tensordict[key] for key in (QPOS, QVEL, STATE_DELTA))
                next_qpos, next_qvel = self.integrate(*given)
                tensordict.set(NEXT_QPOS, next_qpos).set(NEXT_QVEL, next_qvel)
        return tensordict

    def transform_observation_spec(self, observation_spec: TensorSpec) -> TensorSpec:
        """Add the change of the state."""
        dtype = cast(Composite, observation_spec)[QVEL].dtype
        return add_to_spec(observation_spec, {STATE_DELTA: self.size}, dtype)


def _replace(x: Tensor, start: int, value: Tensor) -> Tensor:
    """``x`` with three entries of its last dimension replaced; out of place."""
    return torch.cat((x[..., :start], value, x[..., start + 3 :]), -1)
