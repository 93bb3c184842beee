"""Which rollouts measure a scene: the paper's tests, with the figures it published."""

from collections.abc import Mapping
from dataclasses import dataclass

from torchrl_nerd.evaluation.rollout_error import Source
from torchrl_nerd.scenes import Scene
from torchrl_nerd.tasks.ant import AntRun
from torchrl_nerd.tasks.anymal import AnymalForward
from torchrl_nerd.tasks.cartpole import CartpoleSwingup
from torchrl_nerd.tasks.cube import CubeToss, RealCubeToss, SlopeToss
from torchrl_nerd.tasks.double_pendulum import GROUNDS, DoublePendulumPassive
from torchrl_nerd.tasks.franka import FrankaGravityReachTorque, FrankaReachTorque


@dataclass(frozen=True)
class Protocol:
    """Open-loop rollouts of one scene.

    The action is zero, and the task's controller makes torque of it: none where it is a
    torque (passive motion), springs to the standing pose for ANYmal.

    | field | meaning |
    |---|---|
    | ``cases`` | name -> task or scene whose resets or ranges give the starts |
    | ``horizons`` | control steps over which errors are averaged |
    | ``published`` | (case, horizon, quantity) -> the paper's mean error, m or rad |
    | ``random_actions`` | cases with uniform actions in [-1, 1] in place of zero |
    """

    cases: Mapping[str, Source]
    horizons: tuple[int, ...]
    published: dict[tuple[str, int, str], float]
    random_actions: tuple[str, ...] = ()


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
    cases = {
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


def ant() -> Protocol:
    """Paper, Fig. 3."""
    published = {
        ("passive", 500, "base_position"): 0.057,
        ("passive", 500, "base_orientation"): 0.095,
        ("passive", 500, "joints"): 0.077,
    }
    return Protocol({"passive": AntRun()}, (100, 500), published)


def franka() -> Protocol:
    """An episode of random torques within the effort limits; no published figures.

    Passive, the arm would stay where it is: it starts at rest and knows no gravity.
    """
    cases = {"random": FrankaReachTorque()}
    return Protocol(cases, (128,), {}, random_actions=("random",))


def franka_gravity() -> Protocol:
    """As `franka`."""
    cases = {"random": FrankaGravityReachTorque()}
    return Protocol(cases, (128,), {}, random_actions=("random",))


def anymal() -> Protocol:
    """Springs to the standing pose for an episode; no published figures."""
    return Protocol({"standing": AnymalForward()}, (100, 1000), {})


def cube() -> Protocol:
    """Tosses of 80 steps as in the paper's appendix C.4, whose figures are of real ones."""
    return Protocol({"toss": CubeToss()}, (80,), {})


def cube_real() -> Protocol:
    """As `cube`."""
    return Protocol({"toss": RealCubeToss()}, (80,), {})


def cube_slope() -> Protocol:
    """As `cube`, over slopes."""
    return Protocol({"toss": SlopeToss()}, (80,), {})


PROTOCOLS = {
    "cartpole": cartpole,
    "double_pendulum": double_pendulum,
    "ant": ant,
    "franka": franka,
    "franka_gravity": franka_gravity,
    "anymal": anymal,
    "cube": cube,
    "cube_real": cube_real,
    "cube_slope": cube_slope,
}


def protocol_of(scene: Scene) -> Protocol:
    """That of a registered scene; of any other robot, starts within its own ranges.

    These are sent once with a zero action and once with random ones, where it has motors.
    """
    if scene.name in PROTOCOLS:
        return PROTOCOLS[scene.name]()
    names = ("passive", "random") if scene.actuated else ("passive",)
    cases: dict[str, Source] = {name: scene for name in names}
    return Protocol(cases, (20, 100), {}, random_actions=names[1:])
