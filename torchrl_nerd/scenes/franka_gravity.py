"""Franka Panda under gravity, with the inertials that were identified on the real arm."""

from torchrl_nerd.scenes.franka import GAIN, arm_scene
from torchrl_nerd.scenes.scene import Scene

LOW = (-2.8973, -1.7628, -2.8973, -3.0718, -2.8973, -0.0175, -2.8973)  # rad; data sheet
HIGH = (2.8973, 1.7628, 2.8973, -0.0698, 2.8973, 3.7525, 2.8973)


def franka_gravity() -> Scene:
    """Build the scene. ``qpos`` = joint angles (rad), all limited.

    Inertials (Gaz et al. 2019, https://doi.org/10.1109/LRA.2019.2931248), limits, damping
    (1 N m s/rad) and armature (0.1 kg m^2) of MuJoCo Menagerie's arm without a hand; time
    steps and torques of the paper's.
    """
    return arm_scene("franka_gravity", LOW, HIGH, GAIN)
