"""The interface of analytic steps, and the forces that they do not model."""

from abc import ABC, abstractmethod
from dataclasses import asdict
from typing import Any, ClassVar, NamedTuple, cast

import mujoco
import torch
from torch import Tensor, nn

from torchrl_nerd.configs import StepConfig
from torchrl_nerd.geometry.rigid_body import other_forces
from torchrl_nerd.scenes.contact_points import (
    ground_geoms,
    own_contacts,
    terrain_geoms,
    touching_geoms,
)
from torchrl_nerd.scenes.scene import Scene
from torchrl_nerd.scenes.shapes import EXACT, geom_kind


class StepResult(NamedTuple):
    """The state one control step later, and an estimate of the step's own error."""

    qpos: Tensor  # (*batch, nq)
    qvel: Tensor  # (*batch, nv)
    velocity_defect: Tensor  # (*batch, K): embedded error estimate, rad/s and m/s


ENABLE = mujoco.mjtEnableBit


class AnalyticStep(nn.Module, ABC):
    """A control step from the equation of motion: no weights, no history.

    ``config`` says which step it is, as a checkpoint's card stores it; ``num_defects`` is
    K, width of ``velocity_defect``: dof after dof, repeated.
    """

    kind: ClassVar[str] = "analytic"
    compile_single_threaded: bool = True

    def __init__(self, scene: Scene, config: StepConfig, num_defects: int) -> None:
        super().__init__()
        self.scene, self.config, self.num_defects = scene, config, num_defects

    def with_terrain(self, scene: Scene) -> "AnalyticStep":
        """The same step for the same robot over another ground."""
        scene = scene.reference if self.scene.reference_ratio > 1 else scene
        make = cast(Any, type(self))  # takes the fields of its configuration
        step = make(scene, **asdict(self.config)).to(self.device)
        step.load_state_dict(self.state_dict())  # fitted parameters, where it has any
        return step

    @property
    def device(self) -> torch.device:
        """Where it computes."""
        return next((x.device for x in self.buffers()), torch.device("cpu"))

    def forward(
        self,
        qpos: Tensor,
        qvel: Tensor,
        joint_torque: Tensor | None = None,
        terrain: Tensor | None = None,
    ) -> StepResult:
        """The state after one control step.

        Args:
            qpos: ``(*batch, nq)``, float64.
            qvel: ``(*batch, nv)``.
            joint_torque: ``(*batch, num_actuated)``, N m and N, held over the step; None
                for none.
            terrain: ``(*batch, terrain.size)``; None for the scene's own ground.
        """
        batch = qpos.shape[:-1]
        given = (
            None if x is None else x.reshape(batch.numel(), x.shape[-1])
            for x in (qpos, qvel, joint_torque, terrain)
        )
        found = self._step(*given)  # pyright: ignore
        return StepResult(*(x.reshape(*batch, x.shape[-1]) for x in found))

    @abstractmethod
    def _step(
        self, qpos: Tensor, qvel: Tensor, torque: Tensor | None, ground: Tensor | None
    ) -> StepResult:
        """`forward` of ``N`` robots, ``qpos (N, nq)``."""


def check_supported(scene: Scene) -> None:
    """Raise a ValueError that names all forces which no analytic step models."""
    model = scene.model
    kinds = {geom_kind(model, geom) for geom in touching_geoms(model)}
    flags = model.opt.enableflags
    obstacles = {*ground_geoms(model)} - {*terrain_geoms(model)}
    forces = other_forces(model) | {
        "self-contact": own_contacts(model),
        "contact pairs with a law of their own": model.npair,
        "contacts that the file overrides": flags & ENABLE.mjENBL_OVERRIDE,
        "an exact inertia of constraints": flags & ENABLE.mjENBL_DIAGEXACT,
        "a solver without slip": model.opt.noslip_iterations,
        "shapes that adhere": model.geom_adhesion.any(),
        "cylinders, ellipsoids or meshes on the ground": not kinds <= {*EXACT},
        "servos of MuJoCo": scene.servos is not None,
        "obstacles but planes, boxes and height fields": obstacles,
    }
    found = ", ".join(name for name, is_there in forces.items() if is_there)
    if found:
        raise ValueError(
            "expected, for an analytic step, a robot moved by motors, gravity, springs, "
            f"damping, limits and contact with the ground alone, got scene '{scene.name}' "
            f"with {found}"
        )
