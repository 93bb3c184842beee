"""How a model is trained."""

from dataclasses import asdict, dataclass

from torchrl_nerd.modules.networks import network_config
from torchrl_nerd.settings import expect_at_least

COUNTS = (
    *("rows", "length", "rollout_rows", "rollout_length"),
    *("save_every", "validate_every", "rollout_rounds"),
)


@dataclass(frozen=True)
class TrainConfig:
    """How to train.

    | field | meaning |
    |---|---|
    | ``network`` | name in `NETWORKS`, or ``free``, see `FreeNeRD`, or ``grounded``, see
      `GroundedNeRD` |
    | ``steps`` | updates on one-step targets |
    | ``rollout_steps`` | further updates on the model's own rollouts |
    | ``rows``, ``length`` | sequences per update and tokens of each |
    | ``single_share`` | share of updates on as many single states instead |
    | ``flies`` | have rows that nothing pushes move along the free motion, see `Flight` |
    | ``use_symmetry`` | show each sample as a random one of its mirror images |
    | ``rollout_rows``, ``rollout_length`` | the same for rollouts |
    | ``lr``, ``lr_other`` | peak step sizes of Muon (matrices) and AdamW (the rest) |
    | ``rollout_lr`` | share of the peak at which the rollout updates begin |
    | ``rollout_rounds`` | how often, in equal parts of them, they begin there anew |
    | ``warmup`` | updates over which the step size rises from zero |
    | ``bf16_share`` | share of the one-step updates, the first ones, whose matrices are
      multiplied in bfloat16: faster on processors that have it; all updates on CUDA |
    | ``softening`` | of the relative loss; see `losses.relative_error` |
    | ``clip`` | largest norm of the gradient |
    | ``ema`` | decay of the averaged weights, which are the ones saved |
    | ``save_every`` | updates between saves: what a kill can lose |
    | ``validate_every`` | updates between rollouts in true physics |
    | ``seed`` | of weights and batches |

    Raises:
        SettingError: an unknown network, or a number that is too small.
    """

    network: str = "tiny"
    steps: int = 20_000
    rollout_steps: int = 2_000
    rows: int = 64
    length: int = 16
    single_share: float = 0.75
    flies: bool = False
    use_symmetry: bool = False
    rollout_rows: int = 128
    rollout_length: int = 8
    lr: float = 0.01
    lr_other: float = 3e-3
    rollout_lr: float = 0.1
    rollout_rounds: int = 1
    warmup: int = 200
    bf16_share: float = 0.0
    softening: float = 0.01
    clip: float = 1.0
    ema: float = 0.995
    save_every: int = 1_000
    validate_every: int = 2_000
    seed: int = 0

    def __post_init__(self) -> None:
        network_config(self.network)  # or refuse its name
        for name, value in asdict(self).items():
            if name != "network":
                expect_at_least(1 if name in COUNTS else 0, **{name: value})

    @property
    def total_steps(self) -> int:
        """Updates of both kinds."""
        return self.steps + self.rollout_steps
