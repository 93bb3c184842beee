"""The ground: surfaces whose parameters may differ from row to row."""

from dataclasses import dataclass

import mujoco
import numpy as np
import torch
from torch import Tensor

from torchrl_nerd.geometry.surfaces import (
    PLANE_PARAMETERS,
    plane_distance,
    plane_in_frame,
)


@dataclass(frozen=True)
class Terrain:
    """One infinite plane.

    | field | meaning |
    |---|---|
    | ``default`` | ``(4,)``: unit normal and offset (m) in the world, as the file has it |
    | ``mocap`` | id of the mocap body that carries the plane, -1 for a fixed plane |
    """

    default: np.ndarray
    mocap: int

    size = PLANE_PARAMETERS

    @property
    def is_per_row(self) -> bool:
        """True where every row may have its own plane."""
        return self.mocap >= 0

    @classmethod
    def from_model(cls, model: mujoco.MjModel, geom: int) -> "Terrain":
        """The plane of one geom.

        Raises:
            ValueError: the geom is no plane.
        """
        if model.geom_type[geom] != mujoco.mjtGeom.mjGEOM_PLANE:
            kind = mujoco.mjtGeom(model.geom_type[geom]).name.removeprefix("mjGEOM_")
            raise ValueError(f"expected a plane as ground, got a {kind.lower()}")
        data = mujoco.MjData(model)
        mujoco.mj_kinematics(model, data)
        normal = data.geom_xmat[geom].reshape(3, 3)[:, 2]
        default = np.append(normal, normal @ data.geom_xpos[geom])
        return cls(default, int(model.body_mocapid[model.geom_bodyid[geom]]))

    def distance(
        self, points_b: Tensor, terrain: Tensor, position: Tensor, rotation: Tensor
    ) -> tuple[Tensor, Tensor]:
        """Signed distance and normal at points given in a frame.

        Args:
            points_b: ``(*batch, P, 3)``, m, in the frame.
            terrain: ``(*batch, 4)``, world.
            position: ``(*batch, 3)``, m, the frame's origin in the world.
            rotation: ``(*batch, 3, 3)``, the frame's axes in the world.

        Returns:
            distance ``(*batch, P)``, m, and unit normal ``(*batch, P, 3)`` in the frame.
        """
        return plane_distance(points_b, plane_in_frame(terrain, position, rotation))

    def mocap_pose(self, terrain: Tensor) -> Tensor:
        """Position and quaternion ``(*batch, 7)`` of the mocap body that is this ground.

        The quaternion is the shortest turn that takes z to the normal.
        """
        normal, offset = terrain[..., :3], terrain[..., 3:]
        x, y, z = normal.unbind(-1)
        # half way between z and the normal; a normal of -z is half a turn about x
        flat = x * x + y * y
        rise = torch.where(
            z < 0.0, flat / (1.0 - z), 1.0 + z
        )  # 1 + z, to the last digit
        half = torch.stack((rise, -y, x, torch.zeros_like(x)), -1)
        down = torch.tensor([0.0, 1.0, 0.0, 0.0]).to(half)
        half = torch.where((flat == 0.0)[..., None] & (z < 0.0)[..., None], down, half)
        half = half / torch.linalg.vector_norm(half, dim=-1, keepdim=True)
        return torch.cat((normal * offset, half), -1)
