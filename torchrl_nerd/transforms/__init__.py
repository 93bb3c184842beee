"""TorchRL transforms between raw states and what the network sees and predicts."""

from torchrl_nerd.transforms.contact_features import ContactFeatures
from torchrl_nerd.transforms.normalize import Normalize, Stats
from torchrl_nerd.transforms.robot_centric import RobotCentric
from torchrl_nerd.transforms.self_contact import SelfContactFeatures
from torchrl_nerd.transforms.state_delta import StateDelta

__all__ = [
    "ContactFeatures",
    "Normalize",
    "RobotCentric",
    "SelfContactFeatures",
    "StateDelta",
    "Stats",
]
