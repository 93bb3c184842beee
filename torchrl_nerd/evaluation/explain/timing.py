"""What the compact input saves: encoding and network against the paper's input."""

from collections.abc import Callable
from dataclasses import dataclass
from statistics import median
from time import perf_counter

import torch
from tensordict import TensorDict
from torch import Tensor

from torchrl_nerd.evaluation.explain.paper_input import PaperInput
from torchrl_nerd.keys import JOINT_TORQUE, QPOS, QVEL, TERRAIN
from torchrl_nerd.modules.networks import network_config
from torchrl_nerd.modules.scene_tokens import SceneTokens
from torchrl_nerd.scenes import Scene

ROUNDS = 40
WARM_UP = 5


@dataclass(frozen=True)
class StepTime:
    """Median times of one streaming step for a batch of rows, ms.

    | field | meaning |
    |---|---|
    | ``rows``, ``network`` | batch, and name of the network |
    | ``encode``, ``step`` | compact input: features; network |
    | ``paper_encode``, ``paper_step`` | the same for the paper's full input |
    | ``ratio`` | compact over full, both parts: median over pairs of steps, no unit |
    """

    rows: int
    network: str
    encode: float
    step: float
    paper_encode: float
    paper_step: float
    ratio: float


@torch.no_grad()
def time_inputs(scene: Scene, states: TensorDict, network: str) -> StepTime:
    """Both inputs through one kind of network, turn by turn so that load hits both.

    Args:
        scene: the robot.
        states: ``[rows]``.
        network: one of `NETWORKS`.

    Raises:
        SettingError: no such network.
    """
    config = network_config(network)
    ground = states.get(TERRAIN, None)
    inputs = states[QPOS], states[QVEL], states[JOINT_TORQUE], ground
    runs = []
    for encoder in (SceneTokens(scene), PaperInput(scene)):
        net = config.build(encoder.size, 2 * scene.layout.nv)
        runs.append((encoder, net, net.empty_memory(len(states))))
    times: list[list[float]] = [[], [], [], []]
    for _ in range(WARM_UP + ROUNDS):
        for i, (encoder, net, memory) in enumerate(runs):
            token, seconds = _timed(lambda e=encoder: e(*inputs).float())
            times[2 * i].append(seconds)
            _, seconds = _timed(lambda n=net, t=token, m=memory: n.step(t, m))
            times[2 * i + 1].append(seconds)
    kept = [t[WARM_UP:] for t in times]
    ratio = median((a + b) / (c + d) for a, b, c, d in zip(*kept, strict=True))
    compact, step, paper, paper_step = (1e3 * median(t) for t in kept)
    return StepTime(len(states), network, compact, step, paper, paper_step, ratio)


def _timed(call: Callable[[], Tensor]) -> tuple[Tensor, float]:
    began = perf_counter()
    result = call()
    return result, perf_counter() - began
