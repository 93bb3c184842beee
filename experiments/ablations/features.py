"""Other features than `SceneFeatures`."""

import torch
from torch import Tensor

from torchrl_nerd.configs import FeatureConfig
from torchrl_nerd.geometry.rotations import matrix_from_quat, rotate, wrap_angle
from torchrl_nerd.keys import (
    CONTACT_DEPTH,
    CONTACT_FORCE,
    CONTACT_NORMAL,
    CONTACT_VELOCITY,
)
from torchrl_nerd.scenes import Scene
from torchrl_nerd.transforms import ContactFeatures
from torchrl_nerd.transforms.scene_features import SceneFeatures

from .paper_input import BaseFrame, PaperInput

WORLD_POSE = 9  # position, and two columns of the rotation, in place of gravity


def predictions(scene: Scene) -> FeatureConfig:
    """Which predictions of the contact law the base has.

    The tip of the double pendulum moves by centimetres before it touches, so that its
    contacts are predicted along unconstrained motion.
    """
    return FeatureConfig(True, unconstrained_motion=scene.name == "double_pendulum")


def base(scene: Scene) -> SceneFeatures:
    """The features of the base."""
    return SceneFeatures(scene, predictions(scene))


class DistanceTokens(SceneFeatures):
    """Of contacts no more than the paper sees: distances, and normals where they vary."""

    def __init__(self, scene: Scene) -> None:
        super().__init__(scene, predictions(scene))
        derived = (CONTACT_VELOCITY, CONTACT_DEPTH, CONTACT_FORCE)
        sizes = self.contact.sizes
        self.kept = [number for number, key in enumerate(sizes) if key not in derived]
        self.size -= sum(sizes.get(key, 0) for key in derived)

    def forward(
        self, qpos: Tensor, qvel: Tensor, drive: Tensor, terrain: Tensor | None
    ) -> Tensor:
        """``(*batch, size)``."""
        state = self.robot.state_features(qpos, qvel)
        found = self.contact.contact_features(qpos, qvel, terrain, drive)
        kept = (found[number] for number in self.kept)
        return torch.cat((state, drive, *kept), -1)


class PaperTokens(SceneFeatures):
    """The paper's full input, of which the scene's own are what is left, see `PaperInput`.

    Angles of hinges without limits within half a turn of zero.
    """

    def __init__(self, scene: Scene) -> None:
        super().__init__(scene, predictions(scene))
        self.input = PaperInput(scene)
        self.size = self.input.size

    def forward(
        self, qpos: Tensor, qvel: Tensor, drive: Tensor, terrain: Tensor | None
    ) -> Tensor:
        """``(*batch, size)``."""
        angles, wrapped = self.robot.joints.angles, qpos.clone()
        wrapped[..., angles] = wrap_angle(qpos[..., angles])
        return self.input(wrapped, qvel, drive, terrain)


class LinkTokens(SceneFeatures):
    """The paper's frame for a fixed base: its first link's, which turns with its joint."""

    def __init__(self, scene: Scene) -> None:
        super().__init__(scene, predictions(scene))
        self.frame = BaseFrame(scene)

    def forward(
        self, qpos: Tensor, qvel: Tensor, drive: Tensor, terrain: Tensor | None
    ) -> Tensor:
        """``(*batch, size)``."""
        state = self.robot.state_features(qpos, qvel)
        found = self.contact.contact_features(qpos, qvel, terrain, drive)
        found = aim(self.contact, found, self.frame(qpos)[0].mT)
        return torch.cat((state, drive, *found), -1)


class EndToEndTokens(SceneFeatures):
    """State in world axes and torque: the paper's end to end, which sees no contact."""

    def __init__(self, scene: Scene) -> None:
        super().__init__(scene, predictions(scene))
        joints = self.robot.joints
        self.num_parts = 4 + len(
            joints.balls
        )  # sine, cosine, position, balls, velocity
        angles, others = 2 * len(joints.angles), len(joints.positions)
        width = angles + others + 6 * len(joints.balls) + len(joints.velocities)
        base = (WORLD_POSE + 6) * scene.base.is_floating
        self.size = base + width + len(scene.actuated)

    def forward(
        self, qpos: Tensor, qvel: Tensor, drive: Tensor, terrain: Tensor | None
    ) -> Tensor:
        """``(*batch, size)``."""
        joints = self.robot.joints(qpos, qvel)[: self.num_parts]
        return torch.cat((*base_in_world(self, qpos, qvel), *joints, drive), -1)


class WorldTokens(SceneFeatures):
    """The scene's features in world axes, and where the robot stands: NeRD eq. 1."""

    def __init__(self, scene: Scene) -> None:
        super().__init__(scene, predictions(scene))
        if scene.base.is_floating:
            self.size += WORLD_POSE - 3

    def forward(
        self, qpos: Tensor, qvel: Tensor, drive: Tensor, terrain: Tensor | None
    ) -> Tensor:
        """``(*batch, size)``."""
        found = self.contact.contact_features(qpos, qvel, terrain, drive)
        found = aim(self.contact, found, self.contact.pose(qpos)[1])
        base, joints = base_in_world(self, qpos, qvel), self.robot.joints(qpos, qvel)
        return torch.cat((*base, *joints, drive, *found), -1)


def base_in_world(tokens: SceneFeatures, qpos: Tensor, qvel: Tensor) -> list[Tensor]:
    """Pose and velocity of a floating base in world axes."""
    base = tokens.robot.base
    if not base.is_floating:
        return []
    q, v = base.qpos_address, base.dof_address
    quat = qpos[..., q + 3 : q + 7]
    columns = matrix_from_quat(quat)[..., :2].flatten(-2)
    angular = rotate(quat, qvel[..., v + 3 : v + 6])
    return [qpos[..., q : q + 3], columns, qvel[..., v : v + 3], angular]


def aim(contact: ContactFeatures, features: list[Tensor], turn: Tensor) -> list[Tensor]:
    """Contact features whose vectors are written in other axes.

    Args:
        contact: whose `contact_features` they are.
        features: each ``(*batch, width)``.
        turn: ``(*batch, 3, 3)``, from B_t into these axes.
    """

    def turned(vectors: Tensor) -> Tensor:
        return (turn @ vectors.unflatten(-1, (-1, 3)).mT).mT.flatten(-2)

    found = dict(zip(contact.sizes, features, strict=True))
    speed, sliding = found[CONTACT_VELOCITY].unflatten(-1, (-1, 4)).split((1, 3), -1)
    sliding = turned(sliding.flatten(-2)).unflatten(-1, (-1, 3))
    found[CONTACT_VELOCITY] = torch.cat((speed, sliding), -1).flatten(-2)
    if CONTACT_NORMAL in found:
        found[CONTACT_NORMAL] = turned(found[CONTACT_NORMAL])
    if CONTACT_FORCE in found and contact.base.is_floating:
        base, joints = found[CONTACT_FORCE].tensor_split((6,), -1)
        found[CONTACT_FORCE] = torch.cat((turned(base), joints), -1)
    return list(found.values())
