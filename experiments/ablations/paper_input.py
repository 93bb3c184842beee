"""The input of the paper's networks for any scene, whole: to compare with, never to use.

NeRD section 3.2 and 3.3, with the reference code's order: state in B_t, normals, closest
points and distances of every contact point, torques of every joint axis, gravity. B_t is
the frame of the first moving body, for a fixed base too, where it turns with its joint.
Contact-free robots with a fixed base get the state and the torques alone.
"""

import torch
from torch import Tensor, nn

from torchrl_nerd.geometry.kinematics import PointKinematics
from torchrl_nerd.geometry.manifold import BALL, FREE
from torchrl_nerd.scenes import Scene
from torchrl_nerd.scenes.contact_points import (
    MARGIN_PER_RADIUS,
    MIN_MARGIN,
    shape_points,
)
from torchrl_nerd.scenes.support import unit_gravity

PUBLISHED = {
    "cartpole": 6,
    "double_pendulum": 37,
    "cube": 72,
    "franka": 21,
    "ant": 215,
    "anymal": 150,
}
"""Widths of the released networks' inputs; the cube's by the same rule, unreleased."""

BASE_POSE, JOINT_POSITION = "base pose in B_t", "joint positions"
BASE_VELOCITY, JOINT_VELOCITY = "base velocity in B_t", "joint velocities"
NORMALS, CLOSEST, DISTANCES = "contact normals", "closest points", "contact distances"
TORQUES, GRAVITY_B = "torques of all joint axes", "gravity in B_t"


class PaperInput(nn.Module):
    """The paper's full input by piece.

    With N contact points, none merged:

    | piece | what | width |
    |---|---|---|
    | base pose in B_t | floating base: p' = 0, q' = identity (wxyz) | 7 |
    | joint positions | as they are: m, rad; a ball's quaternion | 1, 4 |
    | base velocity in B_t | floating base: angular, linear of its origin | 6 |
    | joint velocities | m/s, rad/s | 1, 3 |
    | contact normals | n in B_t; this and the next two zero where d >= xi | 3 N |
    | closest points | p1 in B_t, m | 3 N |
    | contact distances | d of the point itself, radius not taken off, m | N |
    | torques of all joint axes | zero for passive ones, N and N m | 1, 3 |
    | gravity in B_t | unit vector; not for contact-free robots on a fixed base | 3 |

    Args:
        scene: the robot.
    """

    margins: Tensor

    def __init__(self, scene: Scene) -> None:
        super().__init__()
        self.scene, model = scene, scene.model
        self.joint_qpos: list[int] = []
        self.joint_dofs: list[int] = []
        for joint in range(model.njnt):
            kind = int(model.jnt_type[joint])
            if kind != FREE:
                q, v = int(model.jnt_qposadr[joint]), int(model.jnt_dofadr[joint])
                self.joint_qpos += range(q, q + (4 if kind == BALL else 1))
                self.joint_dofs += range(v, v + (3 if kind == BALL else 1))
        self.driven = [self.joint_dofs.index(v) for v in scene.actuated]
        bodies, positions, radii, *_ = shape_points(model)
        margins = torch.as_tensor(MARGIN_PER_RADIUS * radii).clamp_min(MIN_MARGIN)
        self.register_buffer("margins", margins, persistent=False)
        self.count = len(bodies) if scene.terrain is not None else 0
        self.frame = BaseFrame(scene)
        down = torch.from_numpy(unit_gravity(scene.model))
        self.register_buffer("down", down, persistent=False)
        if self.count:
            self.kinematics = PointKinematics(model, scene.base, bodies, positions)

    @property
    def sizes(self) -> dict[str, int]:
        """Width of every piece that the scene has, in order."""
        base = self.scene.base.is_floating
        widths = {
            **{BASE_POSE: 7 * base, JOINT_POSITION: len(self.joint_qpos)},
            **{BASE_VELOCITY: 6 * base, JOINT_VELOCITY: len(self.joint_dofs)},
            **{NORMALS: 3 * self.count, CLOSEST: 3 * self.count},
            **{DISTANCES: self.count, TORQUES: len(self.joint_dofs)},
            GRAVITY_B: 3 * (base or self.count > 0),
        }
        return {name: width for name, width in widths.items() if width}

    @property
    def size(self) -> int:
        """Width of the whole."""
        return sum(self.sizes.values())

    def pieces(
        self, qpos: Tensor, qvel: Tensor, joint_torque: Tensor, terrain: Tensor | None
    ) -> dict[str, Tensor]:
        """Every piece ``(*batch, width)`` in the dtype of the state."""
        base, batch = self.scene.base, qpos.shape[:-1]
        found = {JOINT_POSITION: qpos[..., self.joint_qpos]}
        found[JOINT_VELOCITY] = qvel[..., self.joint_dofs]
        torque = qpos.new_zeros(*batch, len(self.joint_dofs))
        torque[..., self.driven] = joint_torque
        found[TORQUES] = torque
        if GRAVITY_B not in self.sizes:
            return found
        position, rotation = self.scene.base_pose(qpos)
        turn, offset = self.frame(qpos)
        found[GRAVITY_B] = (rotation @ turn).mT @ self.down.to(qpos)
        if base.is_floating:
            v = base.dof_address
            identity = qpos.new_tensor([0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0])
            found[BASE_POSE] = identity.expand(*batch, 7)
            linear = (rotation.mT @ qvel[..., v : v + 3, None])[..., 0]
            found[BASE_VELOCITY] = torch.cat((qvel[..., v + 3 : v + 6], linear), -1)
        if self.count:
            points, _ = self.kinematics(qpos, qvel)
            place = position, rotation
            distance, normal = see_ground(self.scene, points, terrain, *place)
            found |= contact_pieces(
                points, distance, normal, self.margins, turn, offset
            )
        return {name: found[name] for name in self.sizes}

    def forward(
        self, qpos: Tensor, qvel: Tensor, joint_torque: Tensor, terrain: Tensor | None
    ) -> Tensor:
        """The whole input ``(*batch, size)``."""
        return torch.cat([*self.pieces(qpos, qvel, joint_torque, terrain).values()], -1)


class BaseFrame(nn.Module):
    """The paper's B_t seen from ours: the same for a floating base.

    Args:
        scene: the robot.
    """

    def __init__(self, scene: Scene) -> None:
        super().__init__()
        self.is_same = scene.base.is_floating
        if not self.is_same:
            corners = torch.cat((torch.zeros(1, 3), torch.eye(3))).double().numpy()
            bodies = [scene.base.body] * 4
            self.corners = PointKinematics(scene.model, scene.base, bodies, corners)
            self.num_dofs = scene.layout.nv

    def forward(self, qpos: Tensor) -> tuple[Tensor, Tensor]:
        """Rotation ``(*batch, 3, 3)`` and origin ``(*batch, 3)``, m, of it in ours."""
        batch = qpos.shape[:-1]
        if self.is_same:
            return torch.eye(3).to(qpos).expand(*batch, 3, 3), qpos.new_zeros(*batch, 3)
        corners, _ = self.corners(qpos, qpos.new_zeros(0, self.num_dofs))
        origin = corners[..., 0, :]
        return (corners[..., 1:, :] - origin[..., None, :]).mT, origin


def see_ground(
    scene: Scene,
    points: Tensor,
    terrain: Tensor | None,
    position: Tensor,
    rotation: Tensor,
) -> tuple[Tensor, Tensor]:
    """Distance (m) and normal of points in a frame; ``terrain`` None: as in the file."""
    ground = scene.terrain_distance.to(points.device)
    return ground(points, terrain, position, rotation)


def contact_pieces(
    points: Tensor,
    distance: Tensor,
    normal: Tensor,
    margins: Tensor,
    turn: Tensor,
    offset: Tensor,
) -> dict[str, Tensor]:
    """What the paper feeds of contact points, from our frame into the paper's.

    Args:
        points: ``(*batch, N, 3)``, m, in our B_t; ``normal`` the same.
        distance: ``(*batch, N)``, m.
        normal: of the ground, unit length.
        margins: ``(N,)``, m; at and beyond it all entries are zero.
        turn: ``(*batch, 3, 3)``, the paper's axes in ours.
        offset: ``(*batch, 3)``, m, the paper's origin in ours.
    """
    is_near = (distance < margins).to(points)
    closest = points - distance[..., None] * normal - offset[..., None, :]
    return {
        NORMALS: ((normal @ turn) * is_near[..., None]).flatten(-2),
        CLOSEST: ((closest @ turn) * is_near[..., None]).flatten(-2),
        DISTANCES: distance * is_near,
    }
