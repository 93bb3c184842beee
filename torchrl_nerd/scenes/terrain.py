"""The ground: planes, boxes, spheres, capsules and height fields, fixed or per row.

Surfaces on mocap bodies stand where each row's parameters say. Those are, mocap body by
mocap body in MuJoCo's order, the body's pose (position in m, quaternion ``wxyz``), or,
where a body is nothing but one plane, the plane's equation: unit normal and offset (m).
All in the world frame.
"""

import math
from dataclasses import dataclass
from functools import cached_property

import mujoco
import numpy as np
import torch
from torch import Tensor

from torchrl_nerd.geometry.rotations import quat_conjugate, quat_multiply, rotate
from torchrl_nerd.geometry.surfaces import PLANE_PARAMETERS, SHAPES

PLANE, HEIGHT_FIELD = (
    int(mujoco.mjtGeom.mjGEOM_PLANE),
    int(mujoco.mjtGeom.mjGEOM_HFIELD),
)
POSE_PARAMETERS = 7


@dataclass(frozen=True, eq=False)
class Surface:
    """One shape of the ground.

    | field | meaning |
    |---|---|
    | ``kind`` | MuJoCo's geom type |
    | ``size`` | ``(3,)``, m, MuJoCo's; of a height field half x, half y and height |
    | ``position`` | ``(3,)``, m, in its mocap body's frame, or in the world if fixed |
    | ``rotation`` | ``(3, 3)``, its axes in the same frame |
    | ``mocap`` | MuJoCo's number of the mocap body that carries it, -1 if fixed |
    | ``heights`` | of a height field ``(rows, columns)``, m; else None |
    """

    kind: int
    size: np.ndarray
    position: np.ndarray
    rotation: np.ndarray
    mocap: int
    heights: np.ndarray | None

    @property
    def plane(self) -> np.ndarray:
        """Unit normal and offset (m) ``(4,)`` of a plane, in the frame of its pose."""
        normal = self.rotation[:, 2]
        return np.append(normal, normal @ self.position)


@dataclass(frozen=True, eq=False)
class Terrain:
    """One or more surfaces; for every contact point the nearest one counts.

    A contact point sees all of them: filters that let a shape of the robot touch only
    some are not looked at.

    | field | meaning |
    |---|---|
    | ``surfaces`` | the shapes |
    | ``mocap_default`` | ``(mocap bodies, 7)``: poses as the file has them |
    """

    surfaces: tuple[Surface, ...]
    mocap_default: np.ndarray

    @classmethod
    def from_model(cls, model: mujoco.MjModel, geoms: list[int]) -> "Terrain":
        """The ground that these geoms make.

        Raises:
            ValueError: a geom is of a shape that no distance is known for.
        """
        data = mujoco.MjData(model)
        mujoco.mj_kinematics(model, data)
        surfaces = tuple(_read_surface(model, data, geom) for geom in geoms)
        return cls(surfaces, np.hstack((data.mocap_pos, data.mocap_quat)))

    @cached_property
    def parameters(self) -> dict[int, slice]:
        """Where each mocap body's numbers are in a row's parameters."""
        slices, start = {}, 0
        for mocap in sorted({s.mocap for s in self.surfaces if s.mocap >= 0}):
            width = PLANE_PARAMETERS if self.plane_of(mocap) else POSE_PARAMETERS
            slices[mocap] = slice(start, start + width)
            start += width
        return slices

    @property
    def size(self) -> int:
        """How many numbers a row has."""
        return sum(part.stop - part.start for part in self.parameters.values())

    @property
    def is_per_row(self) -> bool:
        """True where every row may have its own ground."""
        return bool(self.parameters)

    @property
    def default(self) -> np.ndarray:
        """A row's parameters ``(size,)`` as the file has them."""
        parts = [np.zeros(0)]
        for mocap in self.parameters:
            plane, pose = self.plane_of(mocap), self.mocap_default[mocap]
            if plane is not None:
                normal = rotation_matrix(pose[3:]) @ plane.plane[:3]
                pose = np.append(normal, plane.plane[3] + normal @ pose[:3])
            parts.append(pose)
        return np.concatenate(parts)

    @property
    def fixed_plane(self) -> np.ndarray | None:
        """Unit normal and offset (m) ``(4,)`` where one fixed plane is all there is."""
        lone = self.surfaces[0] if len(self.surfaces) == 1 else None
        if lone is None or lone.mocap >= 0 or lone.kind != PLANE:
            return None
        return lone.plane

    def plane_of(self, mocap: int) -> Surface | None:
        """The plane that is all of a mocap body's ground, or None."""
        on_body = [s for s in self.surfaces if s.mocap == mocap]
        return on_body[0] if len(on_body) == 1 and on_body[0].kind == PLANE else None

    def mocap_pose(self, terrain: Tensor) -> Tensor:
        """Mocap poses ``(*batch, 7 * mocap bodies)`` that put the ground there.

        In the order of MuJoCo's state vector: all positions, then all quaternions. A
        plane is turned the shortest way from z to its normal; mocap bodies that carry no
        ground stay where the file has them.

        Args:
            terrain: ``(*batch, size)``.

        Raises:
            ValueError: another width, or a number that is not finite.
        """
        self.check(terrain, (*terrain.shape[:-1], self.size))
        default = torch.as_tensor(self.mocap_default).to(terrain)
        poses = list(default.expand(*terrain.shape[:-1], -1, -1).unbind(-2))
        for mocap, part in self.parameters.items():
            plane = self.plane_of(mocap)
            given = terrain[..., part]
            poses[mocap] = given if plane is None else _plane_pose(given, plane)
        positions = [pose[..., :3] for pose in poses]
        quats = [pose[..., 3:] for pose in poses]
        return torch.cat((terrain[..., :0], *positions, *quats), -1)

    def check(self, terrain: Tensor, shape: tuple[int, ...]) -> None:
        """Raise ValueError where a row's parameters are of another shape or not finite.

        On an accelerator the numbers are not read, since that would synchronise it; nor in
        compiled code, which cannot raise on them.
        """
        if tuple(terrain.shape) != shape:
            raise ValueError(
                f"expected terrain of shape {shape}, got {tuple(terrain.shape)}"
            )
        is_read = terrain.device.type == "cpu" and not torch.compiler.is_compiling()
        if not is_read or math.isfinite(terrain.sum()):
            return
        rows = (~terrain.isfinite()).any(-1).reshape(-1).nonzero()
        if len(rows):
            raise ValueError(
                f"expected finite terrain, got NaN or infinity in env {int(rows[0])}"
            )


def rotation_matrix(quat: np.ndarray) -> np.ndarray:
    """Rotation ``(3, 3)`` of a quaternion of any length."""
    unit, matrix = np.array(quat, float), np.empty(9)
    mujoco.mju_normalize4(unit)
    mujoco.mju_quat2Mat(matrix, unit)
    return matrix.reshape(3, 3)


def mocap_of(model: mujoco.MjModel, geom: int) -> int:
    """Number of the mocap body that a geom is fixed to, -1 for none."""
    return int(model.body_mocapid[model.body_weldid[model.geom_bodyid[geom]]])


def _read_surface(model: mujoco.MjModel, data: mujoco.MjData, geom: int) -> Surface:
    kind, size = int(model.geom_type[geom]), model.geom_size[geom].copy()
    if kind not in (PLANE, HEIGHT_FIELD, *SHAPES):
        name = mujoco.mjtGeom(kind).name.removeprefix("mjGEOM_").lower()
        raise ValueError(
            f"geom '{model.geom(geom).name or geom}' of the ground is a {name}; "
            f"expected a plane, box, sphere, capsule or height field"
        )
    heights = None
    if kind == HEIGHT_FIELD:
        field = int(model.geom_dataid[geom])
        rows, columns = int(model.hfield_nrow[field]), int(model.hfield_ncol[field])
        start, size = int(model.hfield_adr[field]), model.hfield_size[field, :3].copy()
        levels = model.hfield_data[start : start + rows * columns].astype(float)
        heights = size[2] * levels.reshape(rows, columns)
    position = data.geom_xpos[geom].copy()
    rotation = data.geom_xmat[geom].reshape(3, 3).copy()
    mocap = mocap_of(model, geom)
    if mocap >= 0:  # as the body sees it
        body = int(model.body_weldid[model.geom_bodyid[geom]])
        turn = data.xmat[body].reshape(3, 3)
        position = turn.T @ (position - data.xpos[body])
        rotation = turn.T @ rotation
    return Surface(kind, size, position, rotation, mocap, heights)


def _plane_pose(plane: Tensor, surface: Surface) -> Tensor:
    """Pose ``(*batch, 7)`` of the body that carries the plane."""
    normal, offset = plane[..., :3], plane[..., 3:]
    x, y, z = normal.unbind(-1)
    # half way between z and the normal; a normal of -z is half a turn about x
    flat = x * x + y * y
    rise = torch.where(z < 0.0, flat / (1.0 - z), 1.0 + z)  # 1 + z, to the last digit
    half = torch.stack((rise, -y, x, torch.zeros_like(x)), -1)
    down = torch.tensor([0.0, 1.0, 0.0, 0.0]).to(half)
    half = torch.where((flat == 0.0)[..., None] & (z < 0.0)[..., None], down, half)
    half = half / torch.linalg.vector_norm(half, dim=-1, keepdim=True)
    within = np.empty(4)
    mujoco.mju_mat2Quat(within, surface.rotation.reshape(-1))
    position = torch.as_tensor(surface.position).to(plane)
    turn = quat_multiply(half, quat_conjugate(torch.as_tensor(within).to(plane)))
    return torch.cat((normal * offset - rotate(turn, position), turn), -1)
