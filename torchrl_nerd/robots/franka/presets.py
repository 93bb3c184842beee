"""Presets of both Frankas: data, training, test rollouts, PPO."""

from dataclasses import replace

from torchrl_nerd.configs import DataConfig, PPOConfig, TrainConfig
from torchrl_nerd.robots.franka.scene import franka, franka_gravity
from torchrl_nerd.robots.franka.tasks import (
    FrankaGravityReachTorque,
    FrankaReach,
    FrankaReachOSC,
    FrankaReachTorque,
)
from torchrl_nerd.robots.robot import EvaluationProtocol, Preset, Robot

TRAIN = TrainConfig(
    network="mlp-4x128-products",
    steps=12_000,
    rollout_steps=600,
    single_step_fraction=1.0,
    loss_eps=0.0001,
    validate_every=3_000,
    bf16_fraction=0.85,
)
DATA = DataConfig(trajectories=12_000, steps=100)
# The reference code's policy has an LSTM before its hidden layers; here it sees the last
# three observations, and is updated four times as often.
PPO = PPOConfig(
    total_frames=26_200_000,
    num_envs=1024,
    epochs=8,
    minibatch=4096,
    lr=2e-3,
    std=0.7,
    frame_stack=3,  # its observation has no velocities, and the policy must brake
)
# Of both: an episode of random torques within the effort limits; nothing is published.
# Passive, the arm would stay where it is: it starts at rest and knows no gravity.
RANDOM = {"horizons": (128,), "random_actions": ("random",)}
VARIATION = {
    "payload:link7": (0.0, 3.0),
    "damping": (0.0, 5.0),
    "frictionloss": (0.0, 2.0),
    "motor": (0.8, 1.2),
}
ROBOT = Robot(
    scenes={"franka": franka, "franka_gravity": franka_gravity},
    tasks={
        "franka/reach": FrankaReach,
        "franka/reach_torque": FrankaReachTorque,
        "franka/reach_osc": FrankaReachOSC,
        "franka_gravity/reach_torque": FrankaGravityReachTorque,
    },
    presets={
        "franka": Preset(
            EvaluationProtocol({"random": FrankaReachTorque()}, **RANDOM),
            DATA,
            TRAIN,
            task="franka/reach_torque",
            variation=VARIATION,
        ),
        "franka_gravity": Preset(
            EvaluationProtocol({"random": FrankaGravityReachTorque()}, **RANDOM),
            DATA,
            replace(
                TRAIN,
                network="mlp-4x128",
                steps=10_000,
                rollout_steps=500,
                validate_every=2_500,
            ),
            task="franka_gravity/reach_torque",
            strategy="correlated",
            variation=VARIATION,
        ),
    },
    ppo={
        "franka/reach": PPO,
        # std: of the torque that it can give; to brake by torque takes a wider policy
        "franka/reach_torque": replace(PPO, std=0.3, widths=(128, 128)),
        # the controller brakes: one observation is enough, and it pays to be greedy
        "franka/reach_osc": replace(
            PPO,
            total_frames=1_600_000,
            num_envs=512,
            minibatch=2048,
            gamma=0.95,
            frame_stack=1,
        ),
    },
)
