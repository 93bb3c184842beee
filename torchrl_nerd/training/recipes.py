"""How the shipped model of each scene is made: ``nerd train SCENE`` with its defaults."""

from dataclasses import dataclass

from torchrl_nerd.data.generate import DataConfig
from torchrl_nerd.training.trainer import TrainConfig


@dataclass(frozen=True)
class Recipe:
    """Data and training of one scene, and the task that validates it."""

    data: DataConfig
    train: TrainConfig
    task: str


RECIPES: dict[str, Recipe] = {
    "cartpole": Recipe(
        DataConfig(trajectories=20_000, steps=100),
        TrainConfig(steps=30_000, rollout_steps=3_000),
        "cartpole/swingup",
    ),
    "double_pendulum": Recipe(
        DataConfig(trajectories=40_000, steps=100),
        TrainConfig(
            network="mlp-wide",
            steps=36_000,
            rollout_steps=4_000,
            single_share=1.0,
            softening=1.0,
        ),
        "double_pendulum/passive",
    ),
}
