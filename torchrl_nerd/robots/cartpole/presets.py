"""Presets of the cartpole: data, training, test rollouts, PPO."""

from torchrl_nerd.configs import DataConfig, PPOConfig, TrainConfig
from torchrl_nerd.robots.cartpole.scene import cartpole
from torchrl_nerd.robots.cartpole.tasks import CartpoleSwingup
from torchrl_nerd.robots.robot import EvaluationProtocol, Preset, Robot

PUBLISHED = {  # paper, Fig. 3
    ("passive", 100, "slider"): 0.0002,
    ("passive", 500, "slider"): 0.004,
    ("passive", 1000, "slider"): 0.033,
    ("passive", 100, "hinge"): 0.0004,
    ("passive", 500, "hinge"): 0.013,
    ("passive", 1000, "hinge"): 0.075,
}
PRESET = Preset(
    EvaluationProtocol({"passive": CartpoleSwingup()}, (100, 500, 1000), PUBLISHED),
    DataConfig(trajectories=20_000, steps=100),
    TrainConfig(steps=30_000, rollout_steps=3_000, single_step_fraction=0.0),
    task="cartpole/swingup",
    variation={
        "mass:cart": (0.5, 2.0),
        "mass:pole": (0.3, 3.0),
        "damping:slider": (0.0, 20.0),
        "damping:hinge": (0.0, 1.0),
        "motor": (0.6, 1.4),
    },
)
ROBOT = Robot(
    scenes={"cartpole": cartpole},
    tasks={"cartpole/swingup": CartpoleSwingup},
    presets={"cartpole": PRESET},
    ppo={"cartpole/swingup": PPOConfig()},
)
