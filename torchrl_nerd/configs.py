"""Configurations of data, training, fine-tuning and policy learning: pure data."""

from dataclasses import dataclass, fields
from typing import Literal, get_args

from torchrl_nerd.settings import (
    SettingError,
    expect_above_zero,
    expect_at_least,
    expect_count,
    expect_share,
)

COUNTS = (
    *("batch_size", "sequence_length", "rollout_batch_size", "rollout_length"),
    *("save_every", "validate_every", "rollout_restarts"),
)

Update = Literal["physics", "all", "head"]
Precision = Literal["float32", "float64"]


@dataclass(frozen=True)
class FeatureConfig:
    """What is among a model's features beside state, torque and contacts."""

    # the penalty law's forces at contacts and joint limits over the coming step, for
    # scenes that follow it; see `PredictedForce`
    predicted_force: bool = False
    # contacts predicted along the motion that the robot has if nothing touches it, not at
    # constant velocity; see `AlongUnconstrainedMotion`
    unconstrained_motion: bool = False
    # the robot's parameters, for a model of a varied scene that is told what others
    # find in their history; see `Variation`
    parameters: bool = False
    self_contact: bool = False  # of the robot with itself, see `SelfContactFeatures`


NO_PREDICTIONS = FeatureConfig()


@dataclass(frozen=True)
class UnconstrainedConfig:
    """An `UnconstrainedStep`."""


@dataclass(frozen=True)
class PenaltyContactConfig:
    """A `PenaltyContactStep`; fields as its arguments."""

    num_stages: int = 2
    num_outer_steps: int = 2
    merged_substeps: int = 1
    precision: Precision = "float32"

    def __post_init__(self) -> None:
        if self.precision not in get_args(Precision):
            raise SettingError(
                f"expected precision of {', '.join(get_args(Precision))}, "
                f"got {self.precision!r}"
            )


@dataclass(frozen=True)
class FreeBodyConfig:
    """A `FreeBodyPenaltyStep`; fields as its arguments."""

    num_substeps: int = 8


StepConfig = UnconstrainedConfig | PenaltyContactConfig | FreeBodyConfig


@dataclass(frozen=True)
class DataConfig:
    """Size and seed of a data set.

    Raises:
        SettingError: a size below one.
    """

    trajectories: int = 10_000  # to draw; those that diverge are dropped and counted
    steps: int = 100  # control steps of each trajectory
    seed: int = 0  # of initial states and torques

    def __post_init__(self) -> None:
        sizes = {"trajectories": self.trajectories, "steps": self.steps}
        expect_at_least(1, **sizes)
        expect_count(1, **sizes)


@dataclass(frozen=True)
class TrainConfig:
    """Settings of a training: one-step targets first, then rollouts of the model.

    Raises:
        SettingError: a number that is too small, symmetries of a hybrid, whose
            analytic change has no symmetric copies, or symmetric copies of the data of
            a robot that is nearly symmetric.
    """

    network: str = "transformer-2x64"  # transformer, mlp or gru with depth x width
    step: str | None = None  # analytic step that a hybrid corrects; None: learned model
    predicted_force: bool = False  # feature: contact forces by the penalty law
    # feature: contacts along the unconstrained motion in place of constant velocity
    unconstrained_motion: bool = False
    parameters: bool = False  # feature: the robot's parameters, of a varied scene
    self_contact: bool = False  # features of the robot's contacts with itself
    steps: int = 20_000  # updates on one-step targets
    rollout_steps: int = 2_000  # further updates on the model's own rollouts
    batch_size: int = 64  # sequences per update
    sequence_length: int = 16  # control steps of a sequence
    # share of updates on as many single states in place of sequences
    single_step_fraction: float = 0.75
    use_symmetry: bool = False  # augment data by the robot's symmetries
    # mirrors of the robot and their products that the network itself has: 1, 2, 4 or 8;
    # 0 for as many as there are
    symmetries: int = 1
    near_symmetry: bool = False  # mirrors that a step has but for a few percent, too
    rollout_batch_size: int = 128  # rollouts per update
    rollout_length: int = 8  # control steps of a rollout
    rollout_history: int = 0  # recorded steps that the model sees before it
    lr: float = 0.01  # peak learning rate of Muon, for weight matrices
    adamw_lr: float = 3e-3  # peak learning rate of AdamW, for all other weights
    rollout_lr_ratio: float = 0.1  # learning rates of rollouts, as a share of the peaks
    rollout_restarts: int = 1  # times that the learning rate of rollouts starts anew
    warmup: int = 200  # updates over which the learning rate rises from zero
    # share of the one-step updates, the first ones, in bfloat16 where the device has it
    bf16_fraction: float = 0.0
    loss_eps: float = 0.01  # of the relative loss: keeps samples at rest finite
    clip: float = 1.0  # largest norm of the gradient
    ema: float = 0.995  # decay of the averaged weights, which are the ones saved
    save_every: int = 1_000  # updates between saves: a killed run loses at most these
    validate_every: int = 2_000  # updates between validations against MuJoCo
    seed: int = 0  # of weights and batches

    def __post_init__(self) -> None:
        for setting in fields(self):
            named = {setting.name: getattr(self, setting.name)}
            least = 1 if setting.name in COUNTS else 0
            if setting.type in (int, float):
                expect_at_least(least, **named)
            if setting.type is int:
                expect_count(least, **named)
        expect_above_zero(clip=self.clip, loss_eps=self.loss_eps)
        fractions = "single_step_fraction", "bf16_fraction", "ema"
        expect_share(**{name: getattr(self, name) for name in fractions})
        if not self.total_steps:
            raise SettingError(
                "expected steps or rollout_steps of at least 1, got none"
            )
        if self.use_symmetry and self.step is not None:
            raise SettingError(
                "expected training without use_symmetry for a hybrid, got it with one"
            )
        if self.near_symmetry and (self.use_symmetry or self.symmetries < 2):
            raise SettingError(
                "expected near_symmetry with symmetries above 1 and without use_symmetry, "
                f"got symmetries {self.symmetries} and use_symmetry {self.use_symmetry}"
            )
        if self.symmetries > 1 and self.step is not None:
            raise SettingError(
                f"expected 1 of symmetries for a hybrid, got {self.symmetries}"
            )

    @property
    def features(self) -> FeatureConfig:
        """What is among the model's features."""
        predicted = self.predicted_force, self.unconstrained_motion
        return FeatureConfig(*predicted, self.parameters, self.self_contact)

    @property
    def total_steps(self) -> int:
        """Updates of both kinds."""
        return self.steps + self.rollout_steps

    @property
    def longest(self) -> int:
        """Control steps that a trajectory of the data must have."""
        rollout = self.rollout_states if self.rollout_steps else 1
        return max(self.sequence_length, rollout)

    @property
    def rollout_states(self) -> int:
        """Control steps of a rollout and its history."""
        return self.rollout_history + self.rollout_length


@dataclass(frozen=True)
class FinetuneConfig:
    """Settings of fine-tuning on recordings.

    Raises:
        SettingError: a value that cannot be.
    """

    # what changes: physical parameters (physics), all weights, or the last layer (head);
    # default: physics for an analytic step, all for a network
    update: Update | None = None
    evaluations: int = 90  # of physical parameters, in each of two stages
    epochs: float = 2.0  # at most; an epoch shows every training window once
    batch_size: int = 384  # windows per update
    sequence_length: int = 24  # control steps of a rollout
    # share of updates, the first ones, on rollouts of half the length
    short_history_fraction: float = 0.5
    lr: float = 1e-3  # peak learning rate of Adam
    clip: float = 0.3  # largest norm of the gradient
    states: int = 80  # of a validation window, and of windows that physics is fitted to
    validate_every: int = 20  # updates between validations
    patience: int = 4  # validations without progress, at full length, before it stops
    seed: int = 0  # of batches

    def __post_init__(self) -> None:
        if self.update not in (None, *get_args(Update)):
            known = ", ".join(get_args(Update))
            raise SettingError(f"expected update of {known}, got '{self.update}'")
        expect_at_least(2, states=self.states)
        counts = ("evaluations", "batch_size", "sequence_length")
        counts = (*counts, "validate_every", "patience")
        numbers = ("epochs", "lr", "clip")
        expect_share(short_history_fraction=self.short_history_fraction)
        for least, names in ((1, counts), (0, numbers)):
            expect_at_least(least, **{name: getattr(self, name) for name in names})


@dataclass(frozen=True)
class PPOConfig:
    """Proximal policy optimisation: Schulman et al., https://arxiv.org/abs/1707.06347."""

    total_frames: int = 3_000_000  # actions to learn from
    num_envs: int = 1024  # that step together
    horizon: int = 32  # actions of every env between two updates
    epochs: int = 5  # passes over those actions
    minibatch: int = 2048  # actions per gradient
    lr: float = 3e-3  # Adam's step size at the start; falls linearly to zero
    gamma: float = 0.99  # discount per action
    lmbda: float = 0.95  # advantage estimation: 0 trusts the critic, 1 the rewards
    clip: float = 0.2  # how far an action's probability ratio counts
    std: float = 1.0  # of actions at the start, before they are squashed
    frame_stack: int = 1  # last observations that policy and critic see
    widths: tuple[int, ...] = (64, 64)  # hidden layers of policy and critic
