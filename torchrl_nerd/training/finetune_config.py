"""How a model is taught by recorded tosses."""

from dataclasses import dataclass
from typing import Literal, get_args

from torchrl_nerd.settings import SettingError, expect_at_least

Update = Literal["physics", "all", "head", "low-rank"]
Observe = Literal["states", "poses"]


@dataclass(frozen=True)
class FinetuneConfig:
    """How to fine-tune.

    | field | meaning |
    |---|---|
    | ``update`` | physics alone, without gradients, or all, head, low-rank weights too |
    | ``evaluations`` | of physics, in each of two stages |
    | ``epochs`` | at most; an epoch shows every training window once |
    | ``rows`` | windows per update |
    | ``length`` | steps of a rollout |
    | ``short_share`` | share of the updates, the first ones, at half that length |
    | ``rank`` | of low-rank changes |
    | ``lr`` | peak step size of the network |
    | ``physics_lr`` | peak step size of a simulator's parameters, if there is one |
    | ``noise`` | m, added to starts: of a position, and of corners that turns move |
    | ``use_symmetry`` | show each window as a random one of its mirror images |
    | ``clip`` | largest norm of the network's gradient |
    | ``validate_every`` | updates between rollouts of the validation tosses |
    | ``patience`` | validations without progress, at full length, before it stops |
    | ``observe`` | whole states, or poses alone: a window encoder finds the start |
    | ``every`` | control steps between observed poses |
    | ``pose_noise`` | m, added to every observed pose: a worse camera |
    | ``poses`` | in the encoder's window |
    | ``seed`` | of batches and fresh weights |

    Raises:
        SettingError: a value that cannot be.
    """

    update: Update = "physics"
    evaluations: int = 90
    epochs: float = 2.0
    rows: int = 384
    length: int = 24
    short_share: float = 0.5
    rank: int = 4
    lr: float = 1e-3
    physics_lr: float = 1e-2
    noise: float = 2e-5
    use_symmetry: bool = False
    clip: float = 0.3
    validate_every: int = 20
    patience: int = 4
    observe: Observe = "states"
    every: int = 1
    pose_noise: float = 0.0
    poses: int = 3
    seed: int = 0

    def __post_init__(self) -> None:
        for name, kinds in (("update", Update), ("observe", Observe)):
            if getattr(self, name) not in get_args(kinds):
                known = ", ".join(get_args(kinds))
                raise SettingError(
                    f"expected {name} of {known}, got '{getattr(self, name)}'"
                )
        if self.observe == "states" and (self.every > 1 or self.pose_noise > 0.0):
            raise SettingError("expected observe 'poses' with every or pose_noise")
        counts = ("evaluations", "every", "rows", "length", "rank", "validate_every")
        expect_at_least(
            1, **{name: getattr(self, name) for name in (*counts, "patience")}
        )
        for name in ("epochs", "lr", "physics_lr", "noise", "clip", "short_share"):
            expect_at_least(0, **{name: getattr(self, name)})
