"""What a network sees of a state: the features of a scene as one vector."""

import torch
from torch import Tensor, nn

from torchrl_nerd.scenes.scene import Scene
from torchrl_nerd.transforms import ContactFeatures, RobotCentric


class SceneTokens(nn.Module):
    """The features of a scene as one vector per state.

    `RobotCentric`, torques and `ContactFeatures`, in this order.

    Args:
        scene: the robot.
    """

    def __init__(self, scene: Scene) -> None:
        super().__init__()
        self.robot = RobotCentric(scene)
        self.contact = ContactFeatures(scene)
        widths = (*self.robot.sizes.values(), *self.contact.sizes.values())
        self.size = sum(widths)

    def gap(self, raw: Tensor) -> Tensor:
        """Between contact points and the ground, m, ``(*batch, P)``, of raw tokens.

        Far ones are farther away than they show.
        """
        contact = self.contact
        first = self.size - sum(contact.sizes.values())
        beyond = raw[..., first : first + contact.count]
        return beyond + (contact.margins - contact.radii)

    def forward(
        self, qpos: Tensor, qvel: Tensor, joint_torque: Tensor, terrain: Tensor | None
    ) -> Tensor:
        """Raw tokens ``(*batch, F)`` in the dtype of the state."""
        state = self.robot.state_features(qpos, qvel)
        contacts = self.contact.contact_features(qpos, qvel, terrain, joint_torque)
        return torch.cat((state, joint_torque, *contacts), -1)
