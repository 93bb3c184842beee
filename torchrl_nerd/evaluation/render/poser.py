"""Puts a robot and its ground where a state says."""

import copy

import mujoco
import numpy as np
from torch import Tensor

from torchrl_nerd.geometry.manifold import HINGE
from torchrl_nerd.scenes import Scene

PLANE, HEIGHT_FIELD, MESH = (
    int(mujoco.mjtGeom.mjGEOM_PLANE),
    int(mujoco.mjtGeom.mjGEOM_HFIELD),
    int(mujoco.mjtGeom.mjGEOM_MESH),
)
PLAIN = (0.2, 0.4, 0.7, 1.0)
STEEP = 0.3  # upward part of the normal of a wall
VISIBLE_GROUPS = 3  # MuJoCo draws geom groups 0 to 2 by default


class Poser:
    """MuJoCo's kinematics of one robot.

    Args:
        scene: the robot.
        terrain: ``(terrain.size,)`` where the ground varies.
    """

    def __init__(self, scene: Scene, terrain: Tensor | None = None) -> None:
        self.scene, self.model = scene, copy.copy(scene.model)
        self.data = mujoco.MjData(self.model)
        ground = scene.terrain
        if terrain is not None and ground is not None and ground.is_per_row:
            pose, size = ground.mocap_pose(terrain).numpy(), 3 * self.model.nmocap
            self.data.mocap_pos.flat, self.data.mocap_quat.flat = (
                pose[:size],
                pose[size:],
            )
        self.planes = self._grounds()

    def pose(self, qpos: Tensor | np.ndarray) -> mujoco.MjData:
        """The data after kinematics at ``qpos (nq,)``; the same object every time."""
        self.data.qpos[:] = np.asarray(qpos)
        mujoco.mj_kinematics(self.model, self.data)
        mujoco.mj_comPos(self.model, self.data)
        mujoco.mj_camlight(self.model, self.data)
        return self.data

    def bones(self) -> np.ndarray:
        """Lines ``(n, 2, 3)`` m from joint to joint and to shapes, as last posed.

        They hold together what a robot of few shapes leaves unconnected.
        """
        model, data = self.model, self.data
        moved = np.flatnonzero(model.body_weldid > 0)
        moved = moved[model.body_weldid[model.body_parentid[moved]] > 0]
        links = [(data.xpos[model.body_parentid[b]], data.xpos[b]) for b in moved]
        bodies = model.geom_bodyid
        links += [(data.xpos[bodies[g]], data.geom_xpos[g]) for g in self.moving]
        return np.array(links).reshape(-1, 2, 3)

    @property
    def shapes(self) -> list[int]:
        """Geoms that are drawn and have an outline: no planes, no height fields."""
        model = self.model
        return [
            geom
            for geom in range(model.ngeom)
            if model.geom_type[geom] not in (PLANE, HEIGHT_FIELD)
            and self.colors[geom, 3] > 0.0
            and model.geom_group[geom] < VISIBLE_GROUPS
        ]

    def _grounds(self) -> list[int]:
        """Planes to draw: walls only where there is nothing else."""
        mujoco.mj_kinematics(self.model, self.data)
        planes = np.flatnonzero(self.model.geom_type == PLANE)
        is_flat = self.data.geom_xmat[planes, 8] > STEEP
        return (planes[is_flat] if is_flat.any() else planes).tolist()

    @property
    def moving(self) -> list[int]:
        """Those of the shapes that joints move."""
        model = self.model
        welded = model.body_weldid[model.geom_bodyid]
        return [
            geom
            for geom in self.shapes
            if model.body_mocapid[welded[geom]] < 0 < welded[geom]
        ]

    @property
    def colors(self) -> np.ndarray:
        """Red, green, blue, opacity of every geom, ``(ngeom, 4)`` in [0, 1]."""
        model = self.model
        colors = model.geom_rgba.copy()
        has_material = model.geom_matid >= 0
        colors[has_material] = model.mat_rgba[model.geom_matid[has_material]]
        colors[(colors == 1.0).all(-1)] = PLAIN  # textured, or never given a colour
        return colors

    def common_axis(self) -> np.ndarray | None:
        """The axis ``(3,)`` that all hinges of a fixed robot turn about, if there is one.

        A planar robot is best seen along it.
        """
        if self.scene.base.is_floating:
            return None
        data = self.pose(self.model.qpos0)
        axes = data.xaxis[self.model.jnt_type == HINGE]
        if len(axes) == 0:
            return None
        return axes[0] if (abs(axes @ axes[0]) > 0.99).all() else None
