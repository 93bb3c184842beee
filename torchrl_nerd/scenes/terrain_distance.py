"""Distance to the ground, with the ground's constants where the computation runs."""

import torch
from torch import Tensor, nn

from torchrl_nerd.geometry.base import keep_constants
from torchrl_nerd.geometry.rotations import matrix_from_quat, quat_normalize
from torchrl_nerd.geometry.surfaces import (
    SHAPES,
    height_field_distance,
    into_frame,
    plane_distance,
    plane_in_frame,
)
from torchrl_nerd.scenes.terrain import HEIGHT_FIELD, PLANE, Surface, Terrain


class TerrainDistance(nn.Module):
    """Signed distance and normal of points to the nearest surface of a terrain.

    Args:
        terrain: the ground.
        reach: m; up to here the distance to a height field is exact, see
            `height_field_distance`. To all other surfaces it always is.
    """

    default: Tensor

    def __init__(self, terrain: Terrain, reach: float) -> None:
        super().__init__()
        self.terrain, self.reach = terrain, reach
        constants: dict[str, object] = {"default": terrain.default}
        for index, surface in enumerate(terrain.surfaces):
            constants[f"position_{index}"] = surface.position
            constants[f"rotation_{index}"] = surface.rotation
            constants[f"size_{index}"] = surface.size
            if surface.kind == PLANE:
                constants[f"plane_{index}"] = surface.plane
            if surface.heights is not None:
                constants[f"heights_{index}"] = surface.heights
        keep_constants(self, **constants)

    def forward(
        self,
        points: Tensor,
        terrain: Tensor | None,
        position: Tensor,
        rotation: Tensor,
    ) -> tuple[Tensor, Tensor]:
        """Distance and normal at points given in a frame.

        Args:
            points: ``(*batch, P, 3)``, m, in the frame.
            terrain: ``(*batch, terrain.size)``, world; None for the file's own ground.
            position: ``(*batch, 3)``, m, the frame's origin in the world.
            rotation: ``(*batch, 3, 3)``, the frame's axes in the world.

        Returns:
            distance ``(*batch, P)``, m, negative inside, and unit normal
            ``(*batch, P, 3)`` in the frame, both of the nearest surface.
        """
        if terrain is None:
            terrain = self.default.expand(*points.shape[:-2], -1)
        first, *others = (
            self._to_surface(index, surface, points, terrain, position, rotation)
            for index, surface in enumerate(self.terrain.surfaces)
        )
        distance, normal = first
        for other_distance, other_normal in others:
            is_nearer = (other_distance < distance)[..., None]
            normal = torch.where(is_nearer, other_normal, normal)
            distance = torch.minimum(other_distance, distance)
        return distance, normal

    def _to_surface(
        self,
        index: int,
        surface: Surface,
        points: Tensor,
        terrain: Tensor,
        position: Tensor,
        rotation: Tensor,
    ) -> tuple[Tensor, Tensor]:
        """Distance and normal to one surface."""
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
            heights = getattr(self, f"heights_{index}")
            distance, normal = height_field_distance(
                local, heights, half_x, half_y, self.reach
            )
        else:
            shape, size = SHAPES[surface.kind], getattr(self, f"size_{index}")
            distance, normal = shape(local, size)
        return distance, normal @ turn
