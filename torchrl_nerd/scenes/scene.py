"""A scene: one robot, its ground, its controller, and MuJoCo's substeps."""

import copy
from dataclasses import dataclass, replace
from functools import cached_property, partial
from pathlib import Path
from typing import Any, Literal

import mujoco
import numpy as np
import torch
from torch import Generator, Tensor, nn

from torchrl_nerd.geometry.base import Base, BasePose, keep_constants, root_pose
from torchrl_nerd.geometry.constants import placed
from torchrl_nerd.geometry.kinematics import PointKinematics
from torchrl_nerd.geometry.manifold import JointLayout
from torchrl_nerd.scenes import importer
from torchrl_nerd.scenes.contact_points import (
    MAX_POINTS,
    ContactPoints,
    contact_points,
    terrain_geoms,
)
from torchrl_nerd.scenes.controllers import ActuatorController, Controller, driven_dofs
from torchrl_nerd.scenes.fingerprint import fingerprint, robot_fingerprint
from torchrl_nerd.scenes.penetration import deepest_contacts
from torchrl_nerd.scenes.ranges import default_sampling
from torchrl_nerd.scenes.sampling import Sampling, draw_initial
from torchrl_nerd.scenes.support import check_supported
from torchrl_nerd.scenes.symmetries import Symmetries, find_symmetries
from torchrl_nerd.scenes.terrain import Terrain, TerrainDistance
from torchrl_nerd.scenes.variation import Ranges, Variation
from torchrl_nerd.settings import expect_count

RK4 = int(mujoco.mjtIntegrator.mjINT_RK4)
REFERENCE_RATIO = 4  # substeps of the reference solver in one of the scene's own


@dataclass(frozen=True, eq=False)
class Scene:
    """Everything that all dynamics share about a robot and its surroundings.

    Raises:
        ValueError: the model has something no NeRD can be built for (named), a range of
            the ``sampling`` has another length, or its ends are in the wrong order.
    """

    name: str  # in the registry
    model: mujoco.MjModel  # compiled; ``opt.timestep`` is one substep
    substeps: int  # MuJoCo steps per control step
    controller: Controller  # turns actions into joint torques
    sampling: Sampling  # ranges of training states and torques
    reference_ratio: int = 1  # substeps in one of the scene's own, see `reference`
    max_contact_points: int = MAX_POINTS  # about how many the robot may have
    variation: Variation | None = None  # what differs from robot to robot, see `vary`

    def __post_init__(self) -> None:
        most = self.max_contact_points
        expect_count(1, substeps=self.substeps, max_contact_points=most)
        check_supported(self.name, self.model)
        self.sampling.expect_sizes(self.layout, len(self.actuated))

    @classmethod
    def from_mjcf(
        cls,
        path: str | Path,
        control_step: float | None = None,
        name: str | None = None,
        terrain: Literal["plane"] | None = None,
        max_contact_points: int = MAX_POINTS,
        **ranges: Any,
    ) -> "Scene":
        """The robot in an MJCF file, driven by its own actuators.

        Args:
            path: the file.
            control_step: s; by default the whole number of timesteps nearest to 0.02 s.
            name: the scene's name; by default the path.
            terrain: ``"plane"`` adds level ground at z = 0 to a file that has none.
            max_contact_points: about how many of them; fewer make faster models.
            ranges: fields of `Sampling` in place of those that follow from the joints'
                limits and the actuators' strengths.

        Raises:
            ValueError: a file that is not there or does not compile, a robot with
                something not supported (named), or a plane beside another ground.
        """
        parts = importer.read_mjcf(Path(path), control_step, terrain)
        scene = cls._from(name or str(Path(path)), *parts, ranges)
        return replace(scene, max_contact_points=max_contact_points)

    @classmethod
    def from_dm_control(
        cls, domain: str, task: str, hold: int = 1, **ranges: Any
    ) -> "Scene":
        """The robot of a dm_control suite task, such as ``"cheetah", "run"``.

        Its control step is ``hold`` of the suite's; ``ranges`` as for `from_mjcf`. Raises
        ValueError: no such task or hold, or a robot with something not supported.
        """
        env = importer.load_suite(domain, task)
        model = env.physics.model.ptr
        substeps = hold * round(env.control_timestep() / model.opt.timestep)
        name = f"dm_control/{domain}-{task}" + (f"/{hold}" if hold != 1 else "")
        importer.suite_name(name)  # refuses a hold that cannot be
        return cls._from(name, model, substeps, ranges)

    @classmethod
    def from_gymnasium(cls, env_id: str, **ranges: Any) -> "Scene":
        """The robot of a Gymnasium MuJoCo environment, at the environment's step.

        Such as ``"Ant-v5"``: version 5 names its file. ``ranges`` as for `from_mjcf`.
        Raises ValueError: no such environment, or a robot with something not supported.
        """
        path, frame_skip = importer.gymnasium_file(env_id)
        model, _ = importer.read_mjcf(path, None)
        return cls._from(f"gymnasium/{env_id}", model, frame_skip, ranges)

    @classmethod
    def _from(
        cls, name: str, model: mujoco.MjModel, substeps: int, ranges: dict[str, Any]
    ) -> "Scene":
        check_supported(name, model)
        controller = ActuatorController.from_model(model)
        control_step = substeps * model.opt.timestep
        sampling = default_sampling(model, controller, control_step, **ranges)
        scene = cls(name, model, substeps, controller, sampling)
        terrain = scene.terrain  # refuses a ground without features right away
        if terrain is not None and terrain.is_per_env and not scene.sampling.ground:
            raise ValueError(
                f"scene '{scene.name}' has a ground of its own in each env: expected "
                "ground=, a function that draws it"
            )
        return scene

    @property
    def control_step(self) -> float:
        """Time between two states, s."""
        return self.model.opt.timestep * self.substeps

    def with_substeps(self, substeps: int, integrator: int | None = None) -> "Scene":
        """The same scene, its control step cut into another number of substeps."""
        expect_count(1, substeps=substeps)
        model = copy.copy(self.model)
        model.opt.timestep = self.control_step / substeps
        if integrator is not None:
            model.opt.integrator = integrator
        return replace(self, model=model, substeps=substeps)

    def vary(self, ranges: Ranges) -> "Scene":
        """The same with such as ``{"mass:pole": (0.3, 3.0)}``, see `Variation`."""
        varied = Variation(self.model, self.actuated, ranges) if ranges else None
        return replace(self, variation=varied)

    @property
    def integrator(self) -> str:
        """Of its MuJoCo, as in MJCF: ``Euler``, ``RK4``, ``implicitfast``, ..."""
        kind = mujoco.mjtIntegrator(self.model.opt.integrator)
        name = str(kind.name).removeprefix("mjINT_")
        return {"EULER": "Euler", "RK4": "RK4"}.get(name, name.lower())

    @cached_property
    def reference(self) -> "Scene":
        """The reference solver's scene: MuJoCo's RK4, four substeps in one of its own."""
        if self.reference_ratio > 1:
            return self
        finer = self.with_substeps(REFERENCE_RATIO * self.substeps, RK4)
        return replace(finer, reference_ratio=REFERENCE_RATIO)

    @cached_property
    def layout(self) -> JointLayout:
        """Where each joint lives in qpos and qvel."""
        return JointLayout.from_model(self.model)

    @cached_property
    def base(self) -> Base:
        """The body whose frame is B_t."""
        return Base.from_model(self.model)

    @cached_property
    def fixed_base_pose(self) -> tuple[np.ndarray, np.ndarray]:
        """World position ``(3,)`` and rotation ``(3, 3)`` of a fixed base."""
        return root_pose(self.model, self.base.body)

    @cached_property
    def actuated(self) -> list[int]:
        """Distinct dofs with a joint torque, in the order of the actuators."""
        return driven_dofs(self.model)

    @property
    def servos(self) -> ActuatorController | None:
        """The robot's own actuators where a force depends on the state, else None."""
        own = self.controller
        return own if isinstance(own, ActuatorController) and not own.is_motor else None

    @cached_property
    def contacts(self) -> ContactPoints:
        """The robot's contact points; none where nothing can touch."""
        return contact_points(self.model, self.base, self.max_contact_points)

    @cached_property
    def terrain(self) -> Terrain | None:
        """The ground, or None where nothing can touch it."""
        grounds = terrain_geoms(self.model) if len(self.contacts) else []
        return Terrain.from_model(self.model, grounds) if grounds else None

    @cached_property
    def terrain_distance(self) -> TerrainDistance:
        """Distance to the ground, exact wherever a contact point has features.

        Raises ValueError where nothing can touch a ground.
        """
        if self.terrain is None:
            raise ValueError(f"nothing in scene '{self.name}' can touch a ground")
        return TerrainDistance(self.terrain, float(self.contacts.margins.max()))

    @cached_property
    def symmetries(self) -> Symmetries:
        """Coordinates that the dynamics do not depend on."""
        return find_symmetries(self.model, self.substeps, self.servos is not None)

    @cached_property
    def hash(self) -> str:
        """Fingerprint of the physics: equal for equal robots, steps and grounds."""
        return fingerprint(self.model, self.substeps)

    @cached_property
    def robot_hash(self) -> str:
        """Fingerprint of the robot and its steps alone: equal over any ground."""
        return robot_fingerprint(self.model, self.substeps)

    def sample_initial(
        self, count: int, generator: Generator
    ) -> tuple[dict[str, Tensor], Tensor]:
        """Initial states for training, and each one's torque scale ``(count, 1)``.

        Returns:
            ``qpos (count, nq)``, ``qvel (count, nv)`` and, where the ground varies,
            ``terrain (count, terrain.size)``, all float64.
        """
        how = count, generator, self.clearances, partial(deepest_contacts, self.model)
        return draw_initial(self.sampling, self.layout, *how)

    def clearances(self, qpos: Tensor, terrain: Tensor | None = None) -> Tensor:
        """Gap between every contact point's shape and the ground, m, ``(*batch, P)``.

        ``terrain (*batch, terrain.size)``: None for the scene's own ground.
        """
        return self._ground(qpos, terrain)[0]

    def place_on_terrain(self, state: dict[str, Tensor], gap: Tensor) -> None:
        """Move floating bases, in place, along the ground's normal to a ``gap (n,)``, m."""
        if self.base.is_floating and self.terrain is not None:
            qpos, q = state["qpos"], self.base.qpos_address
            gaps, normals = self._ground(qpos, state.get("terrain"))
            if self.base.others:  # the robot's own points count, not the props'
                trees = self.model.body_treeid
                own = trees[self.contacts.bodies] == trees[self.base.body]
                if not own.any():
                    return
                gaps = torch.where(torch.from_numpy(own), gaps, torch.inf)
            lowest, point = gaps.min(-1)
            normal = normals[torch.arange(len(qpos)), point]  # (num_envs, 3), in B_t
            up = (self.base_pose(qpos)[1] @ normal[..., None])[..., 0]
            qpos[:, q : q + 3] += (gap - lowest)[:, None] * up

    def _ground(self, qpos: Tensor, terrain: Tensor | None) -> tuple[Tensor, Tensor]:
        """Gap ``(*batch, P)``, m, and the ground's normal ``(*batch, P, 3)`` in B_t."""
        if self.terrain is None:
            none = qpos.new_zeros(*qpos.shape[:-1], 0)
            return none, none[..., None].expand(*none.shape, 3)
        still = qpos.new_zeros(0, self.layout.nv)
        points, _ = placed(self.point_kinematics, qpos)(qpos, still)
        ground = placed(self.terrain_distance, qpos)
        distance, normal = ground(points, terrain, *self.base_pose(qpos))
        return distance - placed(self._radii, qpos).get_buffer("radii"), normal

    def base_pose(self, qpos: Tensor) -> tuple[Tensor, Tensor]:
        """World position ``(*batch, 3)`` and rotation ``(*batch, 3, 3)`` of B_t."""
        return placed(self._pose, qpos)(qpos)

    # constants as tensors that stay: compiled code would make them anew of arrays
    @cached_property
    def _pose(self) -> BasePose:
        return BasePose(self.model, self.base)

    @cached_property
    def _radii(self) -> nn.Module:
        module = nn.Module()
        keep_constants(module, radii=self.contacts.radii)  # (P,)
        return module

    @cached_property
    def point_kinematics(self) -> PointKinematics:
        """Kinematics of the contact points."""
        points = self.contacts
        return PointKinematics(self.model, self.base, points.bodies, points.positions)
