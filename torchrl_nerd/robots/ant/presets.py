"""Presets of the Ant: data, training, test rollouts, PPO."""

from dataclasses import replace

from torchrl_nerd.configs import DataConfig, TrainConfig
from torchrl_nerd.robots.ant.scene import ant
from torchrl_nerd.robots.ant.tasks import AntRun, AntSpin, AntSpinTrack
from torchrl_nerd.robots.robot import WALKING_PPO, EvaluationProtocol, Preset, Robot

PUBLISHED = {  # paper, Fig. 3
    ("passive", 500, "base_position"): 0.057,
    ("passive", 500, "base_orientation"): 0.095,
    ("passive", 500, "joints"): 0.077,
}
PRESET = Preset(
    EvaluationProtocol({"passive": AntRun()}, (100, 500), PUBLISHED),
    DataConfig(trajectories=15_000, steps=100),
    TrainConfig(  # `make model-ant` adds data along a policy
        network="transformer-4x128-products",
        symmetries=4,
        predicted_force=True,
        steps=15_000,
        rollout_steps=3_000,
        rollout_lr_ratio=0.25,
        single_step_fraction=0.85,
        use_symmetry=True,
        loss_eps=0.02,
        validate_every=4_000,
        bf16_fraction=0.9,
    ),
    task="ant/run",
    variation={
        "payload:torso": (0.0, 20.0),
        "motor": (0.6, 1.2),
        "damping": (0.0, 5.0),
        "friction": (0.3, 1.5),
    },
)
PPO = replace(WALKING_PPO, total_frames=32_800_000)
ROBOT = Robot(
    scenes={"ant": ant},
    tasks={"ant/run": AntRun, "ant/spin": AntSpin, "ant/spin_track": AntSpinTrack},
    presets={"ant": PRESET},
    ppo={
        "ant/run": PPO,
        "ant/spin": PPO,
        # to keep to a rate takes a wider policy
        "ant/spin_track": replace(PPO, widths=(256, 128, 64)),
    },
)
