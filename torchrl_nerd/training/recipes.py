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


def _arm(task: str) -> Recipe:
    """A fixed base without contact."""
    config = TrainConfig(
        network="mlp", steps=10_000, rollout_steps=1_000, single_share=1.0
    )
    return Recipe(DataConfig(trajectories=10_000, steps=100), config, task)


def _cube(task: str) -> Recipe:
    """A free body with nothing but contact."""
    config = TrainConfig(
        network="mlp",
        steps=10_000,
        rollout_steps=1_000,
        single_share=1.0,
        softening=0.1,
    )
    return Recipe(DataConfig(trajectories=10_000, steps=100), config, task)


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
    "ant": Recipe(
        DataConfig(trajectories=20_000, steps=100),
        TrainConfig(
            network="mlp-large",
            steps=26_000,
            rollout_steps=1_500,
            single_share=1.0,
            softening=0.02,
        ),
        "ant/run",
    ),
    "anymal": Recipe(
        DataConfig(trajectories=10_000, steps=100),
        TrainConfig(
            network="mlp-large",
            steps=10_000,
            rollout_steps=500,
            single_share=1.0,
            softening=0.02,
        ),
        "anymal/forward",
    ),
    "franka": _arm("franka/reach_torque"),
    "franka_gravity": _arm("franka_gravity/reach_torque"),
    "cube": _cube("cube/toss"),
    "cube_real": _cube("cube_real/toss"),
}
