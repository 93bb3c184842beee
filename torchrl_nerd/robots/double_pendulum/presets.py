"""Presets of the double pendulum: data, training, test rollouts."""

from torchrl_nerd.configs import DataConfig, TrainConfig
from torchrl_nerd.robots.double_pendulum.scene import GROUNDS
from torchrl_nerd.robots.double_pendulum.tasks import DoublePendulumPassive
from torchrl_nerd.robots.double_pendulum.unseen_terrain import unseen_terrain
from torchrl_nerd.robots.robot import EvaluationProtocol, Preset


def protocol() -> EvaluationProtocol:
    """Paper, appendix C.2: no ground in reach (0) and grounds 1 to 6."""
    cases = {
        f"terrain {number}": DoublePendulumPassive(number)
        for number in range(len(GROUNDS))
    }
    first = (0.004, 0.012, 0.008, 0.005, 0.011, 0.029, 0.008)
    second = (0.007, 0.015, 0.011, 0.011, 0.018, 0.056, 0.013)
    published = {}
    for case, joint1, joint2 in zip(cases, first, second, strict=True):
        published[case, 100, "joint1"] = joint1
        published[case, 100, "joint2"] = joint2
    return EvaluationProtocol(cases, (100,), published)


PRESETS = {
    "double_pendulum": Preset(
        protocol,
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
        unseen_terrain=unseen_terrain,
    )
}
