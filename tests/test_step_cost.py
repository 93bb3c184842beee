"""What a step costs: counted arithmetic is the textbook's, memory is what is held."""

import pytest
import torch
from dynamics_helpers import random_model
from step_cost import step_cost
from tensordict import TensorDict

from torchrl_nerd.configs import NO_PREDICTIONS
from torchrl_nerd.dynamics import GuardedDynamics, MujocoDynamics, NeRDDynamics
from torchrl_nerd.modules.nerd import NeRD
from torchrl_nerd.modules.networks import NETWORKS, GRUConfig, MLPConfig
from torchrl_nerd.modules.symmetric import HEAD_WIDTH
from torchrl_nerd.robots import load_scene

FREE = ("cartpole", "franka_gravity")  # no contact: the network's products alone
KINDS = ("mlp-4x64", "mlp-1x32", "gru", "transformer-2x64", "paper")


def closed_form(network: str, inputs: int, outputs: int) -> int:
    """Multiplications and additions in the matrix products of one token."""
    config = NETWORKS[network]
    width = config.width
    embed, head = inputs * width, width * HEAD_WIDTH + HEAD_WIDTH * outputs
    if isinstance(config, GRUConfig):
        return 2 * (embed + 6 * width**2 * config.layers + width * outputs)
    feed_forward = 2 * width * 4 * width
    if isinstance(config, MLPConfig):
        return 2 * (embed + config.depth * feed_forward + head)
    # scores and means of the past are sums of products, not matrix products
    return 2 * (embed + config.layers * (4 * width**2 + feed_forward) + head)


def state_of(scene, rows, generator):
    return TensorDict(scene.sample_initial(rows, generator)[0], [rows])


@pytest.mark.parametrize("network", KINDS)
@pytest.mark.parametrize("name", FREE)
def test_counted_arithmetic_is_the_closed_form(name, network, generator):
    scene = load_scene(name)
    model = random_model(scene, generator, network)
    rows = int(torch.randint(1, 9, (), generator=generator))
    cost = step_cost(NeRDDynamics(model), state_of(scene, rows, generator))
    expected = closed_form(network, model.scene_features.size, model.state_delta.size)
    assert cost is not None and cost.flop == expected


def test_compiled_and_window_steps_are_counted_and_true_ones_are_not(generator):
    scene = load_scene("cartpole")
    model = random_model(scene, generator)
    state = state_of(scene, 3, generator)

    def flop(**how: object) -> float:
        cost = step_cost(NeRDDynamics(model, **how), state)
        assert cost is not None
        return cost.flop

    assert flop(compile=True) == flop()
    size = int(torch.randint(2, 12, (), generator=generator))
    width, layers = model.config.width, model.config.layers
    seen = 4 * size**2 * width * layers  # there scores are matrix products
    streamed = closed_form(
        "transformer-2x64", model.scene_features.size, model.state_delta.size
    )
    assert flop(inference="window", window=size) == size * streamed + seen
    guarded = step_cost(GuardedDynamics(NeRDDynamics(model)), state)
    assert guarded is not None
    assert guarded.flop == flop() + 2 * model.scene_features.size**2  # its spread
    assert step_cost(MujocoDynamics(scene, num_threads=1), state) is None


@pytest.mark.parametrize("name", [*FREE, "cube"])
def test_memory_is_what_a_row_holds(name, generator):
    scene = load_scene(name)
    state = state_of(scene, 2, generator)
    window = int(torch.randint(1, 12, (), generator=generator))
    age = 8  # bytes of a counter
    for network in ("mlp-4x64", "gru", "transformer-4x128"):
        model = NeRD(scene, NO_PREDICTIONS, NETWORKS[network])
        held = {
            "mlp-4x64": 0,
            "gru": 4 * 128,
            "transformer-4x128": age
            + 4 * (4 * 2 * 10 * 128),  # layers, keys and values, tokens
        }[network]
        streaming = step_cost(NeRDDynamics(model), state)
        recomputing = NeRDDynamics(model, inference="window", window=window)
        recomputed = step_cost(recomputing, state)
        assert streaming is not None and recomputed is not None
        assert streaming.memory_bytes == held
        assert recomputed.memory_bytes == age + 4 * window * model.scene_features.size
        numbers = scene.model.nq + scene.model.nv
        assert streaming.state_bytes == recomputed.state_bytes == 8 * numbers
