"""All that a model sees of a state: robot, torques, contacts, and what it is told."""

import torch
from torch import Tensor, nn

from torchrl_nerd.configs import NO_PREDICTIONS, FeatureConfig
from torchrl_nerd.scenes.scene import Scene
from torchrl_nerd.transforms.contact_features import ContactFeatures
from torchrl_nerd.transforms.robot_centric import RobotCentric
from torchrl_nerd.transforms.self_contact import SelfContactFeatures


class SceneFeatures(nn.Module):
    """Robot, drive, contacts with the ground and with itself of a state, concatenated.

    See `RobotCentric`, `ContactFeatures` and `SelfContactFeatures`. The drive is joint
    torques, servos' controls and what the model is told, see `drive_of`.

    Raises:
        ValueError: a model that is told parameters, of a scene that does not vary.
    """

    def __init__(self, scene: Scene, config: FeatureConfig = NO_PREDICTIONS) -> None:
        super().__init__()
        self.config = config
        self.robot = RobotCentric(scene, config)
        self.contact = ContactFeatures(scene, config)
        self.own = SelfContactFeatures(scene, config)
        parts = self.robot, self.contact, self.own
        self.size = sum(size for part in parts for size in part.sizes.values())
        self.variation = scene.variation if config.parameters else None
        if config.parameters and self.variation is None:
            raise ValueError(
                f"expected a varied scene for a told model, got '{scene.name}'"
            )
        self.size += 0 if self.variation is None else self.variation.size

    def told(self, parameters: Tensor | None) -> Tensor | None:
        """What a model that is told the env's parameters gets of them; else None."""
        if self.variation is None or parameters is None:
            return None
        return self.variation.shares(parameters)

    def forward(
        self, qpos: Tensor, qvel: Tensor, drive: Tensor, terrain: Tensor | None
    ) -> Tensor:
        """Raw features ``(*batch, F)`` in the dtype of the state."""
        state = self.robot.state_features(qpos, qvel)
        contacts = self.contact.contact_features(qpos, qvel, terrain, drive)
        own = self.own.self_contact_features(qpos, qvel)
        return torch.cat((state, drive, *contacts, *own), -1)
