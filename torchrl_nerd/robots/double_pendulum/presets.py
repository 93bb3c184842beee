"""Presets of the double pendulum: data, training, test rollouts."""

from torchrl_nerd.configs import DataConfig, TrainConfig
from torchrl_nerd.robots.double_pendulum.scene import double_pendulum
from torchrl_nerd.robots.double_pendulum.tasks import DoublePendulumPassive
from torchrl_nerd.robots.robot import EvaluationProtocol, Preset, Robot

# Paper, appendix C.2: 100 steps over no ground in reach (0) and grounds 1 to 6.
PUBLISHED = {
    (f"terrain {number}", 100, joint): error
    for joint, errors in {
        "joint1": (0.004, 0.012, 0.008, 0.005, 0.011, 0.029, 0.008),
        "joint2": (0.007, 0.015, 0.011, 0.011, 0.018, 0.056, 0.013),
    }.items()
    for number, error in enumerate(errors)
}
TERRAINS = {f"terrain {n}": DoublePendulumPassive(n) for n in range(7)}
PRESET = Preset(
    EvaluationProtocol(TERRAINS, (100,), PUBLISHED),
    DataConfig(trajectories=30_000, steps=100),
    TrainConfig(
        network="transformer-2x96",
        steps=36_000,
        rollout_steps=4_000,
        single_step_fraction=0.0,
        loss_eps=1.0,
    ),
    hybrid=TrainConfig(
        network="mlp-2x64",
        step="penalty-contact",
        steps=20_000,
        rollout_steps=0,
        single_step_fraction=1.0,
        loss_eps=0.02,
        validate_every=5_000,
    ),
    task="double_pendulum/passive",
    strategy="level",
    exports="last",  # passive starts, which validate, say little about driven motion
    variation={
        "mass:link1": (0.5, 2.0),
        "mass:link2": (0.5, 2.0),
        "damping:joint1": (0.0, 20.0),
        "damping:joint2": (0.0, 20.0),
        "motor": (0.6, 1.4),
        "friction": (0.2, 2.0),
    },
)
ROBOT = Robot(
    scenes={"double_pendulum": double_pendulum},
    tasks={"double_pendulum/passive": DoublePendulumPassive},
    presets={"double_pendulum": PRESET},
)
