"""Presets of the cubes: data, training, test rollouts."""

from dataclasses import replace

from torchrl_nerd.configs import DataConfig, TrainConfig
from torchrl_nerd.robots.cube.scene import cube, cube_real, cube_slope
from torchrl_nerd.robots.cube.tasks import CubeToss, RealCubeToss, SlopeToss
from torchrl_nerd.robots.robot import (
    EvaluationProtocol,
    Preset,
    RecordedProtocol,
    Robot,
)

STEPS = (80,)  # of a toss: paper, appendix C.4, whose results are of real ones
# 510 tosses of a cube, ContactNets (CoRL 2020, arXiv 2009.11193). The parameters are those
# of its repository; it has no stiffness or damping: those of the scene's board.
RECORDED = RecordedProtocol(
    scene="cube_real",
    model="cube_tosses",
    parameters={
        "gravity": 9.81,
        "friction": 0.18,
        "stiffness": 1e4,
        "damping": 50.0,
        "slip": 50.0,
    },
    published={
        name: {"position_error_m": position, "orientation_error_rad": orientation}
        for name, position, orientation in (
            ("paper: simulator, tuned by hand", 0.036, 0.383),
            ("paper: NeRD from scratch", 0.023, 0.276),
            ("paper: NeRD fine-tuned", 0.018, 0.266),
            ("paper: ContactNets", 0.017, 0.242),
        )
    },
)
DATA = DataConfig(trajectories=8_000, steps=100)
TRAIN = TrainConfig(
    network="mlp-4x128",
    predicted_force=True,
    steps=12_000,
    rollout_steps=600,
    single_step_fraction=1.0,
    loss_eps=0.02,
    validate_every=3_000,
    bf16_fraction=0.85,
)
SHORTER = replace(TRAIN, steps=10_000, rollout_steps=500, validate_every=2_500)
ROBOT = Robot(
    scenes={"cube": cube, "cube_real": cube_real, "cube_slope": cube_slope},
    tasks={
        "cube/toss": CubeToss,
        "cube_real/toss": RealCubeToss,
        "cube_slope/toss": SlopeToss,
    },
    presets={
        "cube": Preset(
            EvaluationProtocol({"toss": CubeToss()}, STEPS),
            DATA,
            TRAIN,
            task="cube/toss",
            strategy="resting",
            recorded=RECORDED,
            # no mass: MuJoCo's contacts grow with it, and all motion stays the same
            variation={"friction": (0.3, 4.0), "stiffness": (0.5, 2.0)},
        ),
        "cube_real": Preset(
            EvaluationProtocol({"toss": RealCubeToss()}, STEPS),
            DATA,
            replace(SHORTER, predicted_force=False),
            task="cube_real/toss",
            recorded=RECORDED,
        ),
        "cube_slope": Preset(
            EvaluationProtocol({"toss": SlopeToss()}, STEPS),
            DATA,
            SHORTER,
            task="cube_slope/toss",
            strategy="resting",
        ),
    },
)
