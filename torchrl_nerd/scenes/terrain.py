"""The ground: planes, boxes and height fields, and planes that differ from env to env.

A plane on a mocap body stands where each env's parameters say: unit normal, offset (m)
in the world, plane by plane in MuJoCo's order.
"""

import math
from dataclasses import dataclass
from functools import cached_property

import mujoco
import numpy as np
import torch
from torch import Tensor, nn

from torchrl_nerd.geometry import surfaces
from torchrl_nerd.geometry.base import ancestors, keep_constants
from torchrl_nerd.geometry.manifold import UNIT
from torchrl_nerd.geometry.rotations import (
    quat_conjugate,
    quat_matrix,
    quat_multiply,
    rotate,
)
from torchrl_nerd.scenes.contact_points import HEIGHT_FIELD, PLANE

Pair = tuple[Tensor, Tensor]


@dataclass(frozen=True, eq=False)
class Surface:
    """One shape of the ground, in the world, or a plane in its mocap body's frame."""

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
    """

    surfaces: tuple[Surface, ...]
    mocap_default: np.ndarray  # (mocap bodies, 7): poses as the file has them

    @classmethod
    def from_model(cls, model: mujoco.MjModel, geoms: list[int]) -> "Terrain":
        """The ground of `terrain_geoms`.

        Raises:
            ValueError: a mocap body that carries more than one plane.
        """
        data = mujoco.MjData(model)
        mujoco.mj_kinematics(model, data)
        found = tuple(_read_surface(model, data, geom) for geom in geoms)
        owners = model.geom_bodyid[geoms]
        planes = owners[[surface.mocap >= 0 for surface in found]]
        carried = np.any(ancestors(model)[:, planes], 1)  # (bodies,): with a plane
        moves = model.body_dofnum[model.body_weldid] > 0
        if carried[owners].sum() > len({*planes}) or np.any(carried & moves):
            raise ValueError(
                "expected one plane on a mocap body of the ground, got more on it"
            )
        return cls(found, np.hstack((data.mocap_pos, data.mocap_quat)))

    @cached_property
    def planes(self) -> list[Surface]:
        """Those on mocap bodies: an env has `PLANE_PARAMETERS` numbers of each."""
        return [surface for surface in self.surfaces if surface.mocap >= 0]

    @property
    def size(self) -> int:
        """How many numbers an env has."""
        return surfaces.PLANE_PARAMETERS * len(self.planes)

    @property
    def is_per_env(self) -> bool:
        """True where every env may have its own ground."""
        return bool(self.planes)

    @property
    def default(self) -> np.ndarray:
        """An env's parameters ``(size,)`` as the file has them."""
        parts = [np.zeros(0)]
        for surface in self.planes:
            pose, plane = self.mocap_default[surface.mocap], surface.plane
            normal = quat_matrix(pose[3:]) @ plane[:3]
            parts.append(np.append(normal, plane[3] + normal @ pose[:3]))
        return np.concatenate(parts)

    @property
    def fixed_plane(self) -> np.ndarray | None:
        """Unit normal and offset (m) ``(4,)`` where one fixed plane is all there is."""
        first = self.surfaces[0]
        is_lone = len(self.surfaces) == 1 and first.mocap < 0 and first.kind == PLANE
        return first.plane if is_lone else None

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
        for surface, plane in zip(self.planes, self.split(terrain), strict=True):
            poses[surface.mocap] = _plane_pose(plane, surface)
        parts = [pose[..., k] for k in (slice(3), slice(3, 7)) for pose in poses]
        return torch.cat((terrain[..., :0], *parts), -1)

    def split(self, terrain: Tensor) -> tuple[Tensor, ...]:
        """The planes ``(*batch, 4)`` of ``terrain (*batch, size)``."""
        return terrain.split(surfaces.PLANE_PARAMETERS, -1) if self.planes else ()

    def normalize(self, terrain: Tensor) -> Tensor:
        """``terrain (*batch, size)`` with unit normals; offsets (m) stay as they are.

        So does a normal of length one, to rounding; one of length zero becomes NaN.
        """
        planes = terrain.unflatten(-1, (-1, surfaces.PLANE_PARAMETERS))
        normal, offset = planes.split((3, 1), -1)
        length = torch.linalg.vector_norm(normal, dim=-1, keepdim=True)
        rounding = max(UNIT, 4.0 * torch.finfo(normal.dtype).eps)
        normal = torch.where((length - 1.0).abs() > rounding, normal / length, normal)
        return torch.cat((normal, offset), -1).flatten(-2)

    def check(self, terrain: Tensor, shape: tuple[int, ...]) -> None:
        """Raise ValueError where parameters are of another shape or not finite.

        On an accelerator the numbers are not read, since that would synchronise it; nor in
        compiled code, which cannot raise on them.
        """
        got = tuple(terrain.shape)
        if got != shape:
            raise ValueError(f"expected terrain of shape {shape}, got {got}")
        is_read = terrain.device.type == "cpu" and not torch.compiler.is_compiling()
        if is_read and not terrain.isfinite().all():
            env = int((~terrain.isfinite()).any(-1).reshape(-1).nonzero()[0])
            raise ValueError(
                f"expected finite terrain, got NaN or infinity in env {env}"
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

        The frame's origin and axes are ``position (*batch, 3)``, m, and ``rotation
        (*batch, 3, 3)`` in the world; ``points (*batch, P, 3)``, m, are in the frame. Of
        the ``terrain (*batch, terrain.size)`` None is the file's own.

        Returns:
            ``(*batch, P)``, m, negative inside; ``(*batch, P, 3)``, unit, in the frame.
        """
        if terrain is None:
            terrain = self.default.expand(*points.shape[:-2], -1)
        planes, frame = list(self.terrain.split(terrain)), (position, rotation)
        (distance, normal), *others = (
            self._to_surface(index, points, planes, frame)
            for index in range(len(self.terrain.surfaces))
        )
        for other_distance, other_normal in others:
            is_nearer = (other_distance < distance)[..., None]
            normal = torch.where(is_nearer, other_normal, normal)
            distance = torch.minimum(other_distance, distance)
        return distance, normal

    def _to_surface(
        self, index: int, points: Tensor, planes: list[Tensor], frame: Pair
    ) -> Pair:
        """Distance and normal to one surface; takes ``planes`` in their order."""
        surface = self.terrain.surfaces[index]

        def own(name: str) -> Tensor:
            return self.get_buffer(f"{name}_{index}")

        if surface.kind == PLANE:
            plane = planes.pop(0) if surface.mocap >= 0 else own("plane")
            plane = plane.expand(*points.shape[:-2], -1)
            seen = surfaces.plane_in_frame(plane, *frame)
            return surfaces.plane_distance(points, seen)
        there = own("position"), own("rotation")
        local, turn = surfaces.into_frame(points, *frame, *there)
        if surface.kind == HEIGHT_FIELD:
            half_x, half_y = (float(half) for half in surface.size[:2])
            field = own("heights"), half_x, half_y, self.reach
            distance, normal = surfaces.height_field_distance(local, *field)
        else:
            distance, normal = surfaces.box_distance(local, own("size"))
        return distance, normal @ turn


def _read_surface(model: mujoco.MjModel, data: mujoco.MjData, geom: int) -> Surface:
    kind, size = int(model.geom_type[geom]), model.geom_size[geom].copy()
    body = int(model.body_weldid[model.geom_bodyid[geom]])
    mocap = int(model.body_mocapid[body]) if kind == PLANE else -1
    heights = None
    if kind == HEIGHT_FIELD:
        field = int(model.geom_dataid[geom])
        shape = int(model.hfield_nrow[field]), int(model.hfield_ncol[field])
        start, size = int(model.hfield_adr[field]), model.hfield_size[field, :3].copy()
        levels = model.hfield_data[start : start + math.prod(shape)].astype(float)
        heights = size[2] * levels.reshape(shape)
    position = data.geom_xpos[geom].copy()
    rotation = data.geom_xmat[geom].reshape(3, 3).copy()
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
