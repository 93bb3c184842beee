"""A scene: one robot, its ground, its controller, and how finely the truth is stepped."""

import hashlib
from dataclasses import dataclass
from functools import cached_property

import mujoco
import numpy as np
import torch
from torch import Generator

from torchrl_nerd.geometry.kinematics import (
    Base,
    PointKinematics,
    matrix_from_quat,
    mount_pose,
)
from torchrl_nerd.geometry.manifold import JointLayout
from torchrl_nerd.scenes.contact_points import (
    ContactPoints,
    contact_points,
    ground_geoms,
)
from torchrl_nerd.scenes.controllers import Controller
from torchrl_nerd.scenes.explain import Symmetries, find_symmetries
from torchrl_nerd.scenes.sampling import Sampling, sample_scale, uniform
from torchrl_nerd.scenes.terrain import Terrain
from torchrl_nerd.scenes.terrain_distance import TerrainDistance

_HASHED_FIELDS = (
    *("body_parentid", "body_pos", "body_quat", "body_mass", "body_inertia"),
    *("body_ipos", "body_iquat", "jnt_type", "jnt_pos", "jnt_axis", "jnt_range"),
    *("jnt_limited", "jnt_stiffness", "jnt_solref", "jnt_solimp", "dof_armature"),
    *("dof_damping", "dof_frictionloss", "geom_type", "geom_size", "geom_pos"),
    *("geom_quat", "geom_friction", "geom_solref", "geom_solimp", "geom_contype"),
    *("geom_conaffinity", "geom_condim", "geom_margin", "geom_gap", "geom_solmix"),
    *("geom_priority", "jnt_margin", "actuator_trnid", "actuator_gear", "qpos0"),
)


@dataclass(frozen=True, eq=False)
class Scene:
    """Everything that learned and true dynamics share about a robot and its place.

    | field | meaning |
    |---|---|
    | ``name`` | its name in the registry |
    | ``model`` | compiled MuJoCo model; ``opt.timestep`` is one substep |
    | ``substeps`` | MuJoCo steps per control step |
    | ``controller`` | turns actions into joint torques |
    | ``sampling`` | ranges of training states and torques |

    Raises:
        ValueError: the model has something no NeRD can be built for (named).
    """

    name: str
    model: mujoco.MjModel
    substeps: int
    controller: Controller
    sampling: Sampling

    def __post_init__(self) -> None:
        if self.substeps < 1:
            raise ValueError(f"expected at least 1 substep, got {self.substeps}")
        counts = {"tendon": self.model.ntendon, "equality constraint": self.model.neq}
        for what, count in counts.items():
            if count:
                raise ValueError(f"scene '{self.name}' has a {what}: not supported")

    @property
    def control_step(self) -> float:
        """Time between two states, s."""
        return self.model.opt.timestep * self.substeps

    @cached_property
    def layout(self) -> JointLayout:
        """Where each joint lives in qpos and qvel."""
        return JointLayout.from_model(self.model)

    @cached_property
    def base(self) -> Base:
        """The body whose frame is B_t."""
        return Base.from_model(self.model)

    @cached_property
    def mount(self) -> tuple[np.ndarray, np.ndarray]:
        """World position ``(3,)`` and rotation ``(3, 3)`` of a fixed base."""
        return mount_pose(self.model, self.base)

    @cached_property
    def actuated(self) -> list[int]:
        """Dof address of each actuated joint, in the order of the actuators."""
        joints = self.model.actuator_trnid[:, 0]
        return [int(self.model.jnt_dofadr[j]) for j in joints]

    @cached_property
    def contacts(self) -> ContactPoints:
        """The robot's contact points; none where nothing can touch."""
        return contact_points(self.model, self.base)

    @cached_property
    def terrain(self) -> Terrain | None:
        """The ground, or None where nothing can touch it."""
        grounds = ground_geoms(self.model) if len(self.contacts) else []
        return Terrain.from_model(self.model, grounds) if grounds else None

    @cached_property
    def terrain_distance(self) -> TerrainDistance:
        """Distance to the ground, exact wherever a contact point has features.

        Raises:
            ValueError: the scene has no ground.
        """
        if self.terrain is None:
            raise ValueError(f"nothing in scene '{self.name}' can touch a ground")
        return TerrainDistance(self.terrain, float(self.contacts.margins.max()))

    @cached_property
    def symmetries(self) -> Symmetries:
        """Coordinates that the dynamics do not depend on."""
        return find_symmetries(self.model, self.substeps)

    @cached_property
    def hash(self) -> str:
        """Fingerprint of the physics: equal for equal robots, steps and grounds."""
        digest = hashlib.sha256()
        for field in _HASHED_FIELDS:
            digest.update(np.ascontiguousarray(getattr(self.model, field)).tobytes())
        option = self.model.opt
        numbers = [option.timestep, self.substeps, *option.gravity, option.impratio]
        numbers += [option.density, option.viscosity, *option.wind]
        numbers += [int(option.integrator), int(option.disableflags), int(option.cone)]
        digest.update(np.array(numbers, float).tobytes())
        return digest.hexdigest()[:16]

    def sample_initial(
        self, rows: int, generator: Generator
    ) -> tuple[dict[str, torch.Tensor], torch.Tensor]:
        """Initial states for training, and each row's torque scale ``(rows, 1)``.

        Returns:
            ``qpos (rows, nq)``, ``qvel (rows, nv)`` and, where the ground varies,
            ``terrain (rows, terrain.size)``, all float64.
        """
        ranges = self.sampling
        qpos, qvel = self._draw(rows, generator)
        torque_scale, speed_scale = sample_scale(ranges, rows, generator)
        state = {"qpos": qpos, "qvel": speed_scale * qvel}
        if ranges.ground is not None:
            state["terrain"] = ranges.ground(qpos, generator)
        return state, torque_scale

    def _draw(
        self, rows: int, generator: Generator
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """Positions and velocities within the ranges, clear of the ground."""
        ranges = self.sampling
        qpos = uniform(ranges.qpos_low, ranges.qpos_high, rows, generator)
        qvel = uniform(ranges.qvel_low, ranges.qvel_high, rows, generator)
        if ranges.base is not None:
            base_pos, base_vel = ranges.base.draw(rows, generator)
            qpos = torch.cat((base_pos, qpos), -1)
            qvel = torch.cat((base_vel, qvel), -1)
        if ranges.clearance is not None:
            is_low = self.clearances(qpos).amin(-1) < ranges.clearance
            if is_low.any():
                again = self._draw(int(is_low.sum()), generator)
                qpos[is_low], qvel[is_low] = again
        return qpos, qvel

    def clearances(
        self, qpos: torch.Tensor, terrain: torch.Tensor | None = None
    ) -> torch.Tensor:
        """Gap between every contact point's shape and the ground, m, ``(*batch, P)``.

        Args:
            qpos: ``(*batch, nq)``.
            terrain: ``(*batch, terrain.size)``; None for the scene's own ground.
        """
        if self.terrain is None:
            return qpos.new_zeros(*qpos.shape[:-1], 0)
        at_rest = torch.zeros_like(qpos[..., :1]).expand(
            *qpos.shape[:-1], self.layout.nv
        )
        points, _ = self.point_kinematics.to(qpos.device)(qpos, at_rest)
        ground = self.terrain_distance.to(qpos.device)
        distance, _ = ground(points, terrain, *self.base_pose(qpos))
        return distance - torch.as_tensor(self.contacts.radii).to(qpos)

    def base_pose(self, qpos: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """World position ``(*batch, 3)`` and rotation ``(*batch, 3, 3)`` of B_t."""
        if not self.base.is_floating:
            batch = qpos.shape[:-1]
            position, rotation = (torch.as_tensor(x).to(qpos) for x in self.mount)
            return position.expand(*batch, 3), rotation.expand(*batch, 3, 3)
        q = self.base.qpos_address
        return qpos[..., q : q + 3], matrix_from_quat(qpos[..., q + 3 : q + 7])

    @cached_property
    def point_kinematics(self) -> PointKinematics:
        """Kinematics of the contact points."""
        points = self.contacts
        return PointKinematics(self.model, self.base, points.bodies, points.positions)
