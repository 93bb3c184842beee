"""The robot's state in its own frame, invariant under translation and yaw.

NeRD section 3.3. Dynamics do not depend on horizontal position and heading, so they are
not features; nor is any other coordinate that `Scene.symmetries` found to be ignored.
"""

import torch
from tensordict import TensorDictBase
from tensordict.utils import NestedKey
from torch import Tensor

from torchrl_nerd.configs import NO_PREDICTIONS, FeatureConfig
from torchrl_nerd.geometry.constants import constant, take
from torchrl_nerd.geometry.manifold import BALL, FREE
from torchrl_nerd.geometry.other_trees import OtherTrees
from torchrl_nerd.geometry.rotations import matrix_from_quat, rotate_inverse
from torchrl_nerd.keys import (
    CTRL,
    JOINT_TORQUE,
    QPOS,
    QVEL,
    ROBOT_CTRL,
    ROBOT_STATE,
    ROBOT_TORQUE,
)
from torchrl_nerd.scenes.commands import num_ctrl
from torchrl_nerd.scenes.penalty_law import limit_forces, limit_stiffness
from torchrl_nerd.scenes.scene import Scene
from torchrl_nerd.scenes.support import unit_gravity
from torchrl_nerd.scenes.symmetries import periodic_hinges
from torchrl_nerd.transforms.base import FeatureTransform

LIMIT_STEPS = 1.5  # control steps at top speed from which on a limit is a feature
CLOSEST = 1e-9  # m and rad: least distance of that, of joints that begin at rest
FADE = 0.25  # share of the margin over which a gated velocity fades in
NUM_TIMES = 5  # intervals of a step at whose ends limit torques are predicted


class RobotCentric(FeatureTransform):
    """Base velocity and gravity in B_t, joint features, joint torques, servos' controls.

    | out key | what | width |
    |---|---|---|
    | ``robot_state`` | floating base: linear, angular velocity, unit gravity in B_t | 9 |
    | | hinge that whole turns leave alike: sin, cos | 2 |
    | | other hinge, slide: position, unless the dynamics ignore it | 1 |
    | | ball: first two columns of its rotation matrix | 6 |
    | | other free body: position, two columns of its rotation matrix, linear and angular
      velocity, all relative to B_t | 15 |
    | | other tree that stands in the world, beside a floating base: where, as B_t sees it:
      position, two columns of its rotation matrix | 9 |
    | | limited joint: gaps to both limits, minus the margin, at most 0 | 2 |
    | | velocity of every dof; one that the free dynamics ignore only near a limit | 1 |
    | | limited joint, with ``predicted_force``: mean torque of the limit's spring and
      damper over the step at constant velocity | 1 |
    | ``robot_torque`` | ``("next", "joint_torque")``, where there is one | actuated dofs |
    | ``robot_ctrl`` | of servos: ``("next", "ctrl")``, where there is one | actuators |

    Examples:
        >>> transform = RobotCentric(load_scene("cartpole"))
        >>> zero = torch.zeros(3, 2).double()
        >>> transform(TensorDict(qpos=zero, qvel=zero))["robot_state"].shape
        torch.Size([3, 6])
    """

    why_no_inverse = "position and heading are not among its features"

    def __init__(self, scene: Scene, features: FeatureConfig = NO_PREDICTIONS) -> None:
        joints = _JointFeatures(scene, features)
        trees = OtherTrees(scene.model, scene.base) if scene.base.others else None
        free = [] if trees is None else [at is not None for at in trees.addresses]
        # what stands in the world does not move from a fixed base
        seen = [i for i, moves in enumerate(free) if moves or scene.base.is_floating]
        state_size = joints.size + 9 * scene.base.is_floating
        state_size += 9 * len(seen) + 6 * sum(free)
        sizes: dict[NestedKey, int] = {ROBOT_STATE: state_size}
        if scene.actuated:
            sizes[ROBOT_TORQUE] = len(scene.actuated)
        if num_ctrl(scene):
            sizes[ROBOT_CTRL] = num_ctrl(scene)
        super().__init__(scene, [QPOS, QVEL], sizes, out_keys=[ROBOT_STATE])
        self.base, self.trees = scene.base, trees
        self.seen, self.free = seen, [i for i, moves in enumerate(free) if moves]
        self.joints = joints
        self.down = tuple(unit_gravity(scene.model).tolist())

    def state_features(self, qpos: Tensor, qvel: Tensor) -> Tensor:
        """``robot_state`` in the dtype of the inputs, ``(*batch, D)``."""
        parts = self.joints(qpos, qvel)
        if self.base.is_floating:
            q, v = self.base.qpos_address, self.base.dof_address
            quat, angular = qpos[..., q + 3 : q + 7], qvel[..., v + 3 : v + 6]
            linear = rotate_inverse(quat, qvel[..., v : v + 3])
            gravity = rotate_inverse(quat, constant(qvel, self.down))
            parts = [linear, angular, gravity, *parts]
        if self.trees is not None:
            parts += self._other_trees(self.trees, qpos, qvel)
        return torch.cat(parts, -1)

    def _other_trees(
        self, trees: OtherTrees, qpos: Tensor, qvel: Tensor
    ) -> list[Tensor]:
        """Poses of other trees ``(*batch, 3)``, and velocities of free bodies, in B_t."""
        batch = qpos.shape[:-1]
        columns = (x.reshape(batch.numel(), x.shape[-1]).T for x in (qpos, qvel))
        position, rotation, spin, linear = trees(*columns)
        vectors = [position[:, i] for i in self.seen]
        vectors += [rotation[:, axis, i] for i in self.seen for axis in (0, 1)]
        vectors += [x[:, i] for i in self.free for x in (linear, spin)]
        return [x.T.reshape(*batch, 3) for x in vectors]

    def _features(self, tensordict: TensorDictBase) -> dict:
        state = self.state_features(tensordict[QPOS], tensordict[QVEL])
        features = {ROBOT_STATE: state}
        for key, source in ((ROBOT_TORQUE, JOINT_TORQUE), (ROBOT_CTRL, CTRL)):
            value = tensordict.get(source, None)
            if value is not None and key in self.sizes:
                features[key] = value
        return features


class _JointFeatures:
    """Addresses of the joints by the kind of feature they give."""

    def __init__(self, scene: Scene, features: FeatureConfig) -> None:
        self.step_size = scene.control_step  # s
        self.angles: list[int] = []  # qpos of hinges that a whole turn leaves alike
        self.positions: list[int] = []  # qpos that enter as they are
        self.balls: list[int] = []  # qpos of ball joints' quaternions
        self.velocities: list[int] = []  # dofs that enter as they are
        self.limited: list[int] = []  # qpos of limited joints
        self.limits: list[tuple[float, float, float]] = []  # low, high, margin of each
        self.gated: list[tuple[int, int]] = []  # index into limited, dof: near a limit
        self.predicted: list[int] = []  # dofs whose limit torque is predicted
        self.springs: list[tuple[float, float]] = []  # stiffness, damping of each
        model, ignored = scene.model, scene.symmetries
        periodic = set(periodic_hinges(model, scene.servos is not None))
        speed = torch.tensor((scene.sampling.qvel_low, scene.sampling.qvel_high))
        speed = speed.abs().amax(0)
        for joint in range(model.njnt):
            kind, is_limited = model.jnt_type[joint], bool(model.jnt_limited[joint])
            q, v = int(model.jnt_qposadr[joint]), int(model.jnt_dofadr[joint])
            if kind == FREE:
                continue
            if kind == BALL:
                self.balls.append(q)
                self.velocities.extend((v, v + 1, v + 2))
                continue
            if q not in ignored.positions:
                (self.angles if q in periodic else self.positions).append(q)
            if v not in ignored.velocities:
                self.velocities.append(v)
            if is_limited:
                if v in ignored.velocities:
                    self.gated.append((len(self.limited), v))
                low, high = model.jnt_range[joint].tolist()
                # from the end: the ranges may leave out a floating base, which is first
                fastest = float(speed[v - model.nv])
                margin = max(LIMIT_STEPS * scene.control_step * fastest, CLOSEST)
                if features.predicted_force:
                    stiffness, damping = limit_stiffness(model, [joint])
                    self.predicted.append(v)
                    self.springs.append((stiffness.item(), damping.item()))
                self.limited.append(q)
                self.limits.append((low, high, margin))

    @property
    def size(self) -> int:
        configuration = 2 * len(self.angles) + len(self.positions) + 6 * len(self.balls)
        limits = 2 * len(self.limited) + len(self.gated) + len(self.predicted)
        return configuration + len(self.velocities) + limits

    def __call__(self, qpos: Tensor, qvel: Tensor) -> list[Tensor]:
        angles = take(qpos, self.angles)
        parts = [angles.sin(), angles.cos(), take(qpos, self.positions)]
        for q in self.balls:
            columns = matrix_from_quat(qpos[..., q : q + 4])[..., :2]  # (*batch, 3, 2)
            parts.append(columns.flatten(-2))
        parts.append(take(qvel, self.velocities))
        if self.limited:
            low, high, margin = constant(qpos, self.limits).unbind(-1)
            position = take(qpos, self.limited)
            below = (position - low - margin).clamp_max(0.0)
            above = (high - position - margin).clamp_max(0.0)
            parts += [below, above]
            if self.gated:
                points, dofs = map(list, zip(*self.gated, strict=True))
                depth = -torch.minimum(below, above) / (FADE * margin)
                parts.append(take(qvel, dofs) * take(depth, points).clamp(0.0, 1.0))
        if self.predicted:
            parts.append(self._limit_torque(take(qpos, self.limited), qvel))
        return parts

    def _limit_torque(self, position: Tensor, qvel: Tensor) -> Tensor:
        """Mean predicted torque of the limits' springs and dampers over the step, N m."""
        low, high, _ = constant(position, self.limits)[..., None].unbind(-2)  # (J, 1)
        stiffness, damping = constant(position, self.springs)[..., None].unbind(-2)
        speed = take(qvel, self.predicted)[..., None]  # (*batch, J, 1)
        how = {"dtype": qvel.dtype, "device": qvel.device}
        times = torch.linspace(0.0, self.step_size, NUM_TIMES + 1, **how)
        there = position[..., None] + speed * times
        below, above = limit_forces(stiffness, damping, low, high, there, speed)
        return (below + above).mean(-1)
