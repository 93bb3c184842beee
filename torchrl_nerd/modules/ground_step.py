"""A control step of a robot on the ground: two looks at the robot, many at its springs.

MuJoCo looks at everything anew in every substep: mass matrix, bias forces, where points
and axes are. Within a control step all that changes little and smoothly; what does not is
the push of stiff springs and dampers, at contacts and limits, which is a cheap law of depth
and speed. So the robot is looked at twice, at the start and at the mean time of the
substeps, where a first march through half of them ends. Then all substeps are made, as
MuJoCo makes them, with points whose levers and free accelerations change along the line
through both looks, and the mass matrix of the second one.

Where a robot whirls its limbs about within a control step, that is made in parts, each
with looks of its own.

Where two looks are too dear, one has to do, at the mean time of the substeps, to where the
velocity of the start leads, and some substeps at once.

Where Euler's substeps are not exact enough, there is the finer teacher, and three looks: at
the start, a third and two thirds of the control step. The line through the first and the
last one has the same integral as a parabola: Heun's rule of third order. Substeps then push
halfway through, a leapfrog.
Source: E. Hairer, S. P. Norsett, G. Wanner, "Solving ordinary differential equations I",
table II.1.1.
"""

from itertools import pairwise

import mujoco
import torch
from torch import Tensor, nn

from torchrl_nerd.geometry.joint_axes import JointAxes
from torchrl_nerd.geometry.manifold import integrate_pos
from torchrl_nerd.modules.free_step import expect_none, untold_pushes
from torchrl_nerd.modules.look import LookAt
from torchrl_nerd.modules.march import March, Reached, reached
from torchrl_nerd.scenes.scene import Scene

EULER = mujoco.mjtIntegrator.mjINT_EULER


class GroundStep(nn.Module):
    """The next state, near to what MuJoCo's substeps make of it.

    Args:
        scene: a robot of hinges and slides, on a free base or a fixed one, over a ground,
            whose contacts and limits are springs and dampers, see `scenes.penalty_law`.
        looks: one or two; three for the state that the finer teacher leads to, see
            `Scene.reference`.
        stride: how many of MuJoCo's substeps are made as one.
        parts: of a control step, which are made one after the other.

    Raises:
        ValueError: in one sentence, another robot, another number of looks, or substeps
            that cannot be shared out among the parts.
    """

    def __init__(
        self, scene: Scene, looks: int = 2, stride: int = 1, parts: int = 1
    ) -> None:
        super().__init__()
        model = scene.model
        if looks not in (1, 2, 3):
            raise ValueError(f"expected one look, two or three, got {looks}")
        expect_none(scene, untold_pushes(scene))
        is_fine = looks == 3
        if not is_fine and model.opt.integrator != EULER:
            found = mujoco.mjtIntegrator(model.opt.integrator).name
            raise ValueError(
                f"expected substeps of mjINT_EULER, got {found} in scene "
                f"'{scene.name}' (a finer teacher takes three looks: grounded-fine)"
            )
        own = (scene.reference if is_fine else scene).substeps
        substeps = max(1, own // stride)
        if parts < 1 or substeps % parts:
            raise ValueError(
                f"expected parts of equal numbers of substeps, got {parts} of {substeps}"
            )
        self.parts, self.substeps = parts, substeps // parts  # of each part
        self.step_size = scene.control_step / substeps
        at = 0.5 if is_fine else 0.0  # Euler's velocities lead its places
        mean, third = 0.5 * (self.substeps - 1) + at, self.substeps / 3
        looks_at = {1: (mean,), 2: (0.0, mean), 3: (0.0, third, 2.0 * third)}
        self.times = looks_at[looks]  # of the looks, in substeps
        axes = JointAxes.of(model, scene.base)
        self.look = LookAt(scene, axes, 0.0 if is_fine else 2.0 * self.step_size)
        self.layout = scene.layout
        self.march = March(scene, axes, self.look, self.step_size, at)

    def forward(
        self,
        qpos: Tensor,
        qvel: Tensor,
        joint_torque: Tensor,
        terrain: Tensor | None = None,
        dtype: torch.dtype = torch.float64,
    ) -> tuple[Tensor, Tensor, Tensor]:
        """The next state, and by how much the velocities at last looks were wrong.

        Args:
            qpos: ``(*batch, nq)``.
            qvel: ``(*batch, nv)``.
            joint_torque: ``(*batch, num_actuated)``, held over the step.
            terrain: ``(*batch, terrain.size)``; None for the scene's own ground.
            dtype: of the springs; all else is float64.

        Returns:
            The next ``qpos`` and ``qvel``, and the velocities that the substeps have at the
            time of every part's last look less those that it was taken with, ``(*batch,
            parts * nv)``, a floating base's in its own axes there.
        """
        batch, state = qpos.shape[:-1], (qpos, qvel, joint_torque)
        qpos, qvel, joint_torque = (x.flatten(0, -2) for x in state)
        ground = None if terrain is None else terrain.flatten(0, -2)
        wrong = []
        for _ in range(self.parts):
            qpos, qvel, off = self._part(qpos, qvel, joint_torque, ground, dtype)
            wrong.append(off)
        found = qpos, qvel, torch.cat(wrong, -1)
        return tuple(x.unflatten(0, batch) for x in found)  # pyright: ignore

    def _part(
        self,
        qpos: Tensor,
        qvel: Tensor,
        joint_torque: Tensor,
        ground: Tensor | None,
        dtype: torch.dtype,
    ) -> tuple[Tensor, Tensor, Tensor]:
        """What `forward` returns, of one part and rows ``N``."""
        given = joint_torque, ground, dtype
        began, ended = self.times[0], self.times[-1]
        place, guess = qpos, qvel
        ahead = began * self.step_size
        if began:
            place = integrate_pos(self.layout, qpos, ahead * qvel)
        look = self.look(place, guess, *given)
        if began:  # back to the depths of the start
            speed = self.march.turned(qvel.mT, look.rotation.mT).to(dtype)
            rising = (self.look.velocity(look.levers, speed) * look.normal).sum(0)
            look = look._replace(depth=look.depth + ahead * rising)
        start = look
        for since, until in pairwise(self.times):
            marches = self.march(start, look, since, qpos, qvel, until)
            place, guess = self._moved(qpos, reached(marches, until), look.rotation)
            look = self.look(place, guess, *given)
        line = start, look, ended - began
        marches = self.march(*line, qpos, qvel, self.substeps)
        guess = self.march.turned(guess.mT, look.rotation.mT)
        wrong = (reached(marches, ended).speed - guess).mT
        return *self._moved(qpos, marches[-1], look.rotation), wrong

    def _moved(
        self, qpos: Tensor, march: Reached, rotation: Tensor
    ) -> tuple[Tensor, Tensor]:
        """The state ``(N, nq)``, ``(N, nv)`` where substeps have come to."""
        speed, moved = (self.march.turned(x.to(qpos), rotation).mT for x in march)
        return integrate_pos(self.layout, qpos, moved), speed
