"""bfloat16 is for inner matrices, not for the ends of a network."""

import copy
from dataclasses import replace

import pytest
import torch
from dynamics_helpers import random_drive, random_model, roll

from torchrl_nerd import load_scene
from torchrl_nerd.dynamics import NeRDDynamics
from torchrl_nerd.modules.linear import FullLinear, InnerLinear

NETWORKS = "transformer-2x64", "adaptive-4x64", "mlp-2x32", "gru"


def dtypes(network: torch.nn.Module, kind: type) -> set[torch.dtype]:
    found = (m for m in network.modules() if isinstance(m, kind))
    return {weight.dtype for m in found for weight in m.parameters()}


@pytest.mark.parametrize("network", NETWORKS)
def test_ends_stay_float32_and_the_result_is_near(network, generator):
    scene = load_scene("cartpole")
    model = random_model(scene, generator, network)
    rounded = copy.deepcopy(model).to(torch.bfloat16)
    assert dtypes(rounded.network, FullLinear) == {torch.float32}
    assert dtypes(rounded.network, InnerLinear) <= {torch.bfloat16}
    start, torque, terrain = random_drive(scene, 5, 4, generator)
    here, there = (
        roll(NeRDDynamics(x), start, torque, terrain)["qvel"] for x in (model, rounded)
    )
    assert here.dtype == there.dtype == torch.float64
    assert 0.0 < (here - there).abs().max() / here.abs().max() < 0.1
    again = rounded.to(torch.float64)
    assert dtypes(again.network, torch.nn.Linear) == {torch.float64}


def test_another_ground_keeps_the_precision(generator):
    scene = load_scene("ant")
    model = random_model(scene, generator, "mlp-2x32").to(torch.bfloat16)
    other = model.with_terrain(replace(scene))
    assert dtypes(other.network, InnerLinear) == {torch.bfloat16}
    weights = other.network.state_dict()
    for name, weight in model.network.state_dict().items():
        assert torch.equal(weights[name], weight), name
