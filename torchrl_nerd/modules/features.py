"""The features of a state as one vector: what a network sees."""

import torch
from torch import Tensor, nn

from torchrl_nerd.configs import NO_PREDICTIONS, FeatureConfig
from torchrl_nerd.scenes.scene import Scene
from torchrl_nerd.transforms import ContactFeatures, RobotCentric


class SceneFeatures(nn.Module):
    """`RobotCentric`, joint torques and `ContactFeatures` of a state, concatenated.

    Args:
        scene: the robot and its ground.
        config: which predictions are among them.
    """

    def __init__(self, scene: Scene, config: FeatureConfig = NO_PREDICTIONS) -> None:
        super().__init__()
        self.config = config
        self.robot = RobotCentric(scene, config)
        self.contact = ContactFeatures(scene, config)
        self.size = sum((*self.robot.sizes.values(), *self.contact.sizes.values()))

    def forward(
        self, qpos: Tensor, qvel: Tensor, joint_torque: Tensor, terrain: Tensor | None
    ) -> Tensor:
        """Raw features ``(*batch, F)`` in the dtype of the state."""
        state = self.robot.state_features(qpos, qvel)
        contacts = self.contact.contact_features(qpos, qvel, terrain, joint_torque)
        return torch.cat((state, joint_torque, *contacts), -1)
