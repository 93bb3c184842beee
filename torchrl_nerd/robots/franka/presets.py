"""Presets of both Frankas: data, training, test rollouts, PPO."""

from dataclasses import replace

from torchrl_nerd.configs import DataConfig, PPOConfig, TrainConfig
from torchrl_nerd.robots.franka.tasks import (
    FrankaGravityReachTorque,
    FrankaReachTorque,
)
from torchrl_nerd.robots.robot import EvaluationProtocol, Preset


def protocol() -> EvaluationProtocol:
    """An episode of random torques within the effort limits; nothing is published.

    Passive, the arm would stay where it is: it starts at rest and knows no gravity.
    """
    cases = {"random": FrankaReachTorque()}
    return EvaluationProtocol(cases, (128,), random_actions=("random",))


def gravity_protocol() -> EvaluationProtocol:
    """As `protocol`."""
    cases = {"random": FrankaGravityReachTorque()}
    return EvaluationProtocol(cases, (128,), random_actions=("random",))


_TRAIN = TrainConfig(
    network="mlp-4x128",
    steps=12_000,
    rollout_steps=600,
    single_step_fraction=1.0,
    loss_eps=0.0001,
    validate_every=3_000,
    bf16_fraction=0.85,
)
_DATA = DataConfig(trajectories=12_000, steps=100)
PRESETS = {
    "franka": Preset(protocol, _DATA, _TRAIN, task="franka/reach_torque"),
    "franka_gravity": Preset(
        gravity_protocol,
        _DATA,
        replace(_TRAIN, steps=10_000, rollout_steps=500, validate_every=2_500),
        task="franka_gravity/reach_torque",
        strategy="correlated",
    ),
}
# The reference code's policy has an LSTM before its hidden layers; here it sees the last
# three observations, and is updated four times as often.
_FRANKA = PPOConfig(
    total_frames=26_200_000,
    num_envs=1024,
    epochs=8,
    minibatch=4096,
    lr=2e-3,
    std=0.7,
    frame_stack=3,  # its observation has no velocities, and the policy must brake
)
PPO = {
    "franka/reach": _FRANKA,
    # std: of the torque that it can give; to brake in time by torque takes a wider policy
    "franka/reach_torque": replace(_FRANKA, std=0.3, widths=(128, 128)),
}
