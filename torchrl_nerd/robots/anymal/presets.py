"""Presets of ANYmal: data, training, test rollouts, PPO."""

from dataclasses import replace

from torchrl_nerd.configs import DataConfig, TrainConfig
from torchrl_nerd.robots.anymal.scene import anymal
from torchrl_nerd.robots.anymal.tasks import AnymalForward, AnymalSideways
from torchrl_nerd.robots.robot import WALKING_PPO, EvaluationProtocol, Preset, Robot

PRESET = Preset(
    # a PD controller holds the nominal pose for an episode; nothing is published
    EvaluationProtocol({"standing": AnymalForward()}, (100, 1000)),
    DataConfig(trajectories=20_000, steps=100),
    TrainConfig(  # the first stage of anymal-mlp; `make model-anymal-mlp` continues it
        network="mlp-4x128",
        predicted_force=True,
        steps=15_000,
        rollout_steps=1_000,
        single_step_fraction=1.0,
        loss_eps=0.02,
        bf16_fraction=0.8,
    ),
    task="anymal/forward",
    variation={
        "payload:base": (0.0, 10.0),
        "payload_x:base": (-0.2, 0.2),
        "motor": (0.7, 1.2),
        "frictionloss": (0.0, 2.0),
        "friction": (0.3, 1.5),
    },
)
PPO = replace(WALKING_PPO, total_frames=65_500_000)
ROBOT = Robot(
    scenes={"anymal": anymal},
    tasks={"anymal/forward": AnymalForward, "anymal/sideways": AnymalSideways},
    presets={"anymal": PRESET},
    ppo={"anymal/forward": PPO, "anymal/sideways": PPO},
)
