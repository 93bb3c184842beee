"""Which rollouts measure a scene: the paper's tests, with the figures it published."""

from dataclasses import dataclass

from torchrl_nerd.tasks import Task
from torchrl_nerd.tasks.cartpole import CartpoleSwingup
from torchrl_nerd.tasks.double_pendulum import GROUNDS, DoublePendulumPassive


@dataclass(frozen=True)
class Protocol:
    """Passive open-loop rollouts of one scene.

    | field | meaning |
    |---|---|
    | ``cases`` | name -> task whose reset distribution gives the starts |
    | ``horizons`` | control steps over which errors are averaged |
    | ``published`` | (case, horizon, quantity) -> the paper's mean error, m or rad |
    """

    cases: dict[str, Task]
    horizons: tuple[int, ...]
    published: dict[tuple[str, int, str], float]


def cartpole() -> Protocol:
    """Paper, Fig. 3."""
    published = {
        ("passive", 100, "slider"): 0.0002,
        ("passive", 500, "slider"): 0.004,
        ("passive", 1000, "slider"): 0.033,
        ("passive", 100, "hinge"): 0.0004,
        ("passive", 500, "hinge"): 0.013,
        ("passive", 1000, "hinge"): 0.075,
    }
    return Protocol({"passive": CartpoleSwingup()}, (100, 500, 1000), published)


def double_pendulum() -> Protocol:
    """Paper, appendix C.2: no ground in reach (0) and grounds 1 to 6."""
    cases: dict[str, Task] = {
        f"ground {number}": DoublePendulumPassive(number)
        for number in range(len(GROUNDS))
    }
    first = (0.004, 0.012, 0.008, 0.005, 0.011, 0.029, 0.008)
    second = (0.007, 0.015, 0.011, 0.011, 0.018, 0.056, 0.013)
    published = {}
    for case, joint1, joint2 in zip(cases, first, second, strict=True):
        published[case, 100, "joint1"] = joint1
        published[case, 100, "joint2"] = joint2
    return Protocol(cases, (100,), published)


PROTOCOLS = {"cartpole": cartpole, "double_pendulum": double_pendulum}
