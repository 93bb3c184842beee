"""Presets of the cubes: data, training, test rollouts."""

from dataclasses import replace

from torchrl_nerd.configs import DataConfig, TrainConfig
from torchrl_nerd.robots.cube.tasks import CubeToss, RealCubeToss, SlopeToss
from torchrl_nerd.robots.robot import EvaluationProtocol, Preset, RecordedProtocol

STEPS = 80  # of a toss, as in the paper's appendix C.4, whose results are of real ones


def protocol() -> EvaluationProtocol:
    """Tosses onto level ground."""
    return EvaluationProtocol({"toss": CubeToss()}, (STEPS,))


def real_protocol() -> EvaluationProtocol:
    """As `protocol`, with the measured cube's mass."""
    return EvaluationProtocol({"toss": RealCubeToss()}, (STEPS,))


def slope_protocol() -> EvaluationProtocol:
    """As `protocol`, over slopes."""
    return EvaluationProtocol({"toss": SlopeToss()}, (STEPS,))


# 510 tosses of a cube, ContactNets (CoRL 2020, arXiv 2009.11193). The parameters are those
# of its repository; it has no stiffness or damping: those of the scene's board.
_RECORDED = RecordedProtocol(
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
_DATA = DataConfig(trajectories=8_000, steps=100)
_TRAIN = TrainConfig(
    network="mlp-4x128",
    predicted_force=True,
    steps=12_000,
    rollout_steps=600,
    single_step_fraction=1.0,
    loss_eps=0.02,
    validate_every=3_000,
    bf16_fraction=0.85,
)
_SHORTER = replace(_TRAIN, steps=10_000, rollout_steps=500, validate_every=2_500)
PRESETS = {
    "cube": Preset(
        protocol,
        _DATA,
        _TRAIN,
        task="cube/toss",
        strategy="resting",
        recorded=_RECORDED,
    ),
    "cube_real": Preset(
        real_protocol,
        _DATA,
        replace(_SHORTER, predicted_force=False),
        task="cube_real/toss",
        recorded=_RECORDED,
    ),
    "cube_slope": Preset(
        slope_protocol,
        _DATA,
        _SHORTER,
        task="cube_slope/toss",
        strategy="resting",
    ),
}
