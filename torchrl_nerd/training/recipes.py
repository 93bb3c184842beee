"""How a model of each scene is made: ``nerd train SCENE`` with its defaults."""

from dataclasses import dataclass, replace
from typing import Any, Literal

from torchrl_nerd.data.generate import DataConfig, Draw
from torchrl_nerd.data.strategies import strategies
from torchrl_nerd.evaluation.rollout_error import Source
from torchrl_nerd.scenes import Scene
from torchrl_nerd.tasks import make_task
from torchrl_nerd.training.train_config import TrainConfig


@dataclass(frozen=True)
class Recipe:
    """Data and training of one scene, and what validates it.

    | field | meaning |
    |---|---|
    | ``data``, ``train`` | how much, and how |
    | ``task`` | its resets start the validation; None: the scene's sampling ranges do |
    | ``strategy`` | how data are drawn, see `strategies`; None: the scene's own sampling |
    | ``exports`` | which checkpoint of a run is the model: the best one or the last |
    """

    data: DataConfig
    train: TrainConfig
    task: str | None
    strategy: str | None = None
    exports: Literal["best", "last"] = "best"

    def draw(self, scene: Scene) -> tuple[str, Draw] | None:
        """The strategy's name and what it draws, for `generate`."""
        if self.strategy is None or self.task is None:
            return None
        return self.strategy, strategies(scene, make_task(self.task))[self.strategy]

    def source(self, scene: Scene) -> Source:
        """Whose starts validate."""
        return scene if self.task is None else make_task(self.task)


def _mlp(
    task: str | None,
    trajectories: int,
    network: str,
    steps: int,
    rollout_steps: int,
    softening: float,
    **others: Any,
) -> Recipe:
    """An MLP on single states: without a history, sequences tell it less."""
    train = TrainConfig(
        network=network,
        steps=steps,
        rollout_steps=rollout_steps,
        single_share=1.0,
        softening=softening,
        **others,
    )
    return Recipe(DataConfig(trajectories=trajectories, steps=100), train, task)


def _grounded(
    task: str, trajectories: int, steps: int, network: str = "grounded", **others: Any
) -> Recipe:
    """A step along springs and its correction; its last checkpoint is the model.

    Passive starts, which validate, tell little of what it is worth under torque.
    """
    others = {"validate_every": 5_000, **others}
    made = _mlp(task, trajectories, network, steps, 0, softening=0.02, **others)
    return replace(made, exports="last")


def _free(task: str) -> Recipe:
    """A step along the free motion and its correction, for arms."""
    return _mlp(
        task, 12_000, "free", 6_000, 500, softening=0.0001, validate_every=1_000
    )


RECIPES: dict[str, Recipe] = {
    "cartpole": Recipe(
        DataConfig(trajectories=20_000, steps=100),
        TrainConfig(steps=30_000, rollout_steps=3_000, single_share=0.0),
        "cartpole/swingup",
    ),
    "double_pendulum": replace(
        _grounded("double_pendulum/passive", 30_000, 20_000), strategy="level"
    ),
    "ant": _grounded(
        "ant/run",
        20_000,
        20_000,
        "grounded-halves",
        validate_every=4_000,
        bf16_share=0.85,
    ),
    "anymal": _grounded(
        "anymal/forward",
        20_000,
        20_000,
        "grounded-halves",
        validate_every=4_000,
        bf16_share=0.8,
    ),
    "franka": _free("franka/reach_torque"),
    "franka_gravity": replace(
        _free("franka_gravity/reach_torque"), strategy="correlated"
    ),
    "cube": replace(_grounded("cube/toss", 8_000, 10_000), strategy="resting"),
    "cube_real": _grounded("cube_real/toss", 8_000, 10_000),
    "cube_slope": replace(
        _grounded("cube_slope/toss", 8_000, 10_000), strategy="resting"
    ),
}

# Of robots that nobody has tuned one for, such as imported ones.
ANY_ROBOT = _mlp(None, 10_000, "mlp-large", 10_000, 500, softening=0.02)


def recipe_of(name: str) -> Recipe:
    """The recipe of the scene of that name, or the one of any robot."""
    return RECIPES.get(name, ANY_ROBOT)
