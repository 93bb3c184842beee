"""Presets of the cartpole: data, training, test rollouts, PPO."""

from torchrl_nerd.configs import DataConfig, PPOConfig, TrainConfig
from torchrl_nerd.robots.cartpole.tasks import CartpoleSwingup
from torchrl_nerd.robots.robot import EvaluationProtocol, Preset


def protocol() -> EvaluationProtocol:
    """Paper, Fig. 3."""
    published = {
        ("passive", 100, "slider"): 0.0002,
        ("passive", 500, "slider"): 0.004,
        ("passive", 1000, "slider"): 0.033,
        ("passive", 100, "hinge"): 0.0004,
        ("passive", 500, "hinge"): 0.013,
        ("passive", 1000, "hinge"): 0.075,
    }
    cases = {"passive": CartpoleSwingup()}
    return EvaluationProtocol(cases, (100, 500, 1000), published)


PRESETS = {
    "cartpole": Preset(
        protocol,
        DataConfig(trajectories=20_000, steps=100),
        TrainConfig(steps=30_000, rollout_steps=3_000, single_step_fraction=0.0),
        task="cartpole/swingup",
    )
}
PPO = {"cartpole/swingup": PPOConfig()}
