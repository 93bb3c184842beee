"""Images of a robot by `mujoco.Renderer`, with a camera that follows it."""

import copy

import mujoco
import numpy as np
from torch import Tensor

from torchrl_nerd.evaluation.render.opengl import make_renderer
from torchrl_nerd.scenes import Scene

MARGIN = 1.25  # room around a robot that the camera follows


class RobotRenderer:
    """Images of one robot on its terrain.

    The camera has the direction and the distance of MuJoCo's default free camera, which
    ``<visual><global azimuth= elevation=>`` and ``<statistic center= extent=>`` of the MJCF
    file set. It follows the center of mass of a floating base.

    Args:
        scene: the robot.
        width: of the image, pixels.
        height: of the image, pixels.
        terrain: ``(terrain.size,)`` where the terrain varies from env to env.

    Raises:
        ValueError: no OpenGL library works on this machine.
    """

    def __init__(
        self, scene: Scene, width: int, height: int, terrain: Tensor | None = None
    ) -> None:
        self.base, self.model = scene.base, copy.copy(scene.model)
        self.data, self.camera = mujoco.MjData(self.model), mujoco.MjvCamera()
        buffer = self.model.vis.global_
        buffer.offwidth, buffer.offheight = width, height
        mujoco.mjv_defaultFreeCamera(self.model, self.camera)
        if scene.base.is_floating:
            self.camera.distance *= MARGIN
        self.model.vis.quality.shadowsize = 1024  # less work for a CPU
        # in a small scene the ground would cast shadows on itself
        self.model.stat.extent = max(self.model.stat.extent, 1.0)
        ground = scene.terrain
        if terrain is not None and ground is not None and ground.is_per_row:
            pose, size = ground.mocap_pose(terrain).numpy(), 3 * self.model.nmocap
            self.data.mocap_pos.flat = pose[:size]
            self.data.mocap_quat.flat = pose[size:]
        self._renderer = make_renderer(self.model, width, height)

    def render(self, qpos: Tensor) -> np.ndarray:
        """Image ``(height, width, 3)``, uint8, of the robot at ``qpos (nq,)``."""
        self.data.qpos[:] = qpos.numpy()
        mujoco.mj_fwdPosition(self.model, self.data)
        if self.base.is_floating:
            self.camera.lookat[:] = self.data.subtree_com[self.base.body]
        self._renderer.update_scene(self.data, self.camera)
        return self._renderer.render()

    def close(self) -> None:
        """Free the OpenGL context."""
        self._renderer.close()
