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
from torch import Tensor, nn

from torchrl_nerd.geometry.base import keep_constants
from torchrl_nerd.geometry.rotations import (
    matrix_from_quat,
    quat_conjugate,
    quat_matrix,
    quat_multiply,
    quat_normalize,
    rotate,
)
from torchrl_nerd.geometry.surfaces import (
    PLANE_PARAMETERS,
    SHAPES,
    height_field_distance,
    into_frame,
    plane_distance,
    plane_in_frame,
)
from torchrl_nerd.scenes.contact_points import geom_label

PLANE = int(mujoco.mjtGeom.mjGEOM_PLANE)
HEIGHT_FIELD = int(mujoco.mjtGeom.mjGEOM_HFIELD)
POSE_PARAMETERS = 7


@dataclass(frozen=True, eq=False)
class Surface:
    """One shape of the ground, in its mocap body's frame, or in the world if fixed."""

    kind: int  # MuJoCo's geom type
    size: np.ndarray  # (3,), m, MuJoCo's; of a height field half x, half y and height
    position: np.ndarray  # (3,), m
    rotation: np.ndarray  # (3, 3)
    mocap: int  # MuJoCo's number of the mocap body that carries it, -1 if fixed
    heights: np.ndarray | None  # of a height field (rows, columns), m

    @property
    def plane(self) -> np.ndarray:
        """Unit normal and offset (m) ``(4,)`` of a plane, in the frame of its pose."""
        normal = self.rotation[:, 2]
        return np.append(normal, normal @ self.position)


@dataclass(frozen=True, eq=False)
class Terrain:
    """One or more surfaces; for every contact point the nearest one counts.

    Every contact point sees all of them, whatever the filters of its shape say.

    ``mocap_default (mocap bodies, 7)``: poses as the file has them.
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
                normal = quat_matrix(pose[3:]) @ plane.plane[:3]
                pose = np.append(normal, plane.plane[3] + normal @ pose[:3])
            parts.append(pose)
        return np.concatenate(parts)

    @property
    def fixed_plane(self) -> np.ndarray | None:
        """Unit normal and offset (m) ``(4,)`` where one fixed plane is all there is."""
        first = self.surfaces[0]
        is_lone = len(self.surfaces) == 1 and first.mocap < 0 and first.kind == PLANE
        return first.plane if is_lone else None

    def plane_of(self, mocap: int) -> Surface | None:
        """The plane that is all of a mocap body's ground, or None."""
        on_body = [s for s in self.surfaces if s.mocap == mocap]
        return on_body[0] if len(on_body) == 1 and on_body[0].kind == PLANE else None

    def mocap_pose(self, terrain: Tensor) -> Tensor:
        """Mocap poses ``(*batch, 7 * mocap bodies)`` that put the ground there.

        From ``terrain (*batch, size)``, in the order of MuJoCo's state vector: all
        positions, then all quaternions. A plane is turned the shortest way from z to its
        normal; mocap bodies that carry no ground stay where the file has them. Raises what
        `check` raises.
        """
        self.check(terrain, (*terrain.shape[:-1], self.size))
        default = torch.as_tensor(self.mocap_default).to(terrain)
        poses = list(default.expand(*terrain.shape[:-1], -1, -1).unbind(-2))
        for mocap, part in self.parameters.items():
            plane, given = self.plane_of(mocap), terrain[..., part]
            poses[mocap] = given if plane is None else _plane_pose(given, plane)
        parts = [pose[..., k] for k in (slice(3), slice(3, 7)) for pose in poses]
        return torch.cat((terrain[..., :0], *parts), -1)

    def check(self, terrain: Tensor, shape: tuple[int, ...]) -> None:
        """Raise ValueError where a row's parameters are of another shape or not finite.

        On an accelerator the numbers are not read, since that would synchronise it; nor in
        compiled code, which cannot raise on them.
        """
        got = tuple(terrain.shape)
        if got != shape:
            raise ValueError(f"expected terrain of shape {shape}, got {got}")
        is_read = terrain.device.type == "cpu" and not torch.compiler.is_compiling()
        if is_read and not terrain.isfinite().all():
            row = int((~terrain.isfinite()).any(-1).reshape(-1).nonzero()[0])
            raise ValueError(
                f"expected finite terrain, got NaN or infinity in env {row}"
            )


class TerrainDistance(nn.Module):
    """Signed distance and normal of points to the nearest surface of a terrain.

    Exact up to ``reach`` m for a height field, see `height_field_distance`, and everywhere
    for all other surfaces.
    """

    default: Tensor

    def __init__(self, terrain: Terrain, reach: float) -> None:
        super().__init__()
        self.terrain, self.reach = terrain, reach
        keep_constants(self, default=terrain.default)
        for index, surface in enumerate(terrain.surfaces):
            for name in ("position", "rotation", "size", "plane", "heights"):
                value = getattr(surface, name)
                if value is not None:
                    keep_constants(self, **{f"{name}_{index}": value})

    def forward(
        self, points: Tensor, terrain: Tensor | None, position: Tensor, rotation: Tensor
    ) -> tuple[Tensor, Tensor]:
        """Distance and normal of the nearest surface, at points given in a frame.

        Args:
            points: ``(*batch, P, 3)``, m, in the frame.
            terrain: ``(*batch, terrain.size)``, world; None for the file's own ground.
            position: ``(*batch, 3)``, m, the frame's origin in the world.
            rotation: ``(*batch, 3, 3)``, the frame's axes in the world.

        Returns:
            ``(*batch, P)``, m, negative inside; ``(*batch, P, 3)``, unit, in the frame.
        """
        if terrain is None:
            terrain = self.default.expand(*points.shape[:-2], -1)
        (distance, normal), *others = (
            self._to_surface(index, points, terrain, position, rotation)
            for index in range(len(self.terrain.surfaces))
        )
        for other_distance, other_normal in others:
            is_nearer = (other_distance < distance)[..., None]
            normal = torch.where(is_nearer, other_normal, normal)
            distance = torch.minimum(other_distance, distance)
        return distance, normal

    def _to_surface(
        self,
        index: int,
        points: Tensor,
        terrain: Tensor,
        position: Tensor,
        rotation: Tensor,
    ) -> tuple[Tensor, Tensor]:
        """Distance and normal to one surface."""
        surface = self.terrain.surfaces[index]
        origin = getattr(self, f"position_{index}")
        axes = getattr(self, f"rotation_{index}")
        if surface.mocap >= 0:
            row = terrain[..., self.terrain.parameters[surface.mocap]]
            if self.terrain.plane_of(surface.mocap) is surface:
                return plane_distance(points, plane_in_frame(row, position, rotation))
            body = matrix_from_quat(quat_normalize(row[..., 3:]))
            origin, axes = row[..., :3] + body @ origin, body @ axes
        elif surface.kind == PLANE:
            plane = getattr(self, f"plane_{index}").expand(*points.shape[:-2], -1)
            return plane_distance(points, plane_in_frame(plane, position, rotation))
        local, turn = into_frame(points, position, rotation, origin, axes)
        if surface.kind == PLANE:
            distance, normal = local[..., 2], torch.zeros_like(local)
            normal[..., 2] = 1.0
        elif surface.kind == HEIGHT_FIELD:
            half_x, half_y = (float(half) for half in surface.size[:2])
            field = getattr(self, f"heights_{index}"), half_x, half_y, self.reach
            distance, normal = height_field_distance(local, *field)
        else:
            size = getattr(self, f"size_{index}")
            distance, normal = SHAPES[surface.kind](local, size)
        return distance, normal @ turn


def _read_surface(model: mujoco.MjModel, data: mujoco.MjData, geom: int) -> Surface:
    kind, size = int(model.geom_type[geom]), model.geom_size[geom].copy()
    if kind not in (PLANE, HEIGHT_FIELD, *SHAPES):
        name, what = geom_label(model, geom)
        raise ValueError(
            f"{name} of the ground is a {what}; expected a plane, box, sphere, capsule "
            "or height field"
        )
    heights = None
    if kind == HEIGHT_FIELD:
        field = int(model.geom_dataid[geom])
        shape = int(model.hfield_nrow[field]), int(model.hfield_ncol[field])
        start, size = int(model.hfield_adr[field]), model.hfield_size[field, :3].copy()
        levels = model.hfield_data[start : start + math.prod(shape)].astype(float)
        heights = size[2] * levels.reshape(shape)
    position = data.geom_xpos[geom].copy()
    rotation = data.geom_xmat[geom].reshape(3, 3).copy()
    body = int(model.body_weldid[model.geom_bodyid[geom]])
    mocap = int(model.body_mocapid[body])
    if mocap >= 0:  # as the body sees it
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
