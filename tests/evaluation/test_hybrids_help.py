"""Every shipped hybrid earns its place: without its network its error is larger."""

from typing import cast

import pytest
import torch
from helpers import slow_but
from network_off import without_network
from tensordict import TensorDict

from torchrl_nerd import from_pretrained
from torchrl_nerd.checkpoint import shipped_card, shipped_models
from torchrl_nerd.dynamics import AnalyticDynamics, MujocoDynamics, NeRDDynamics
from torchrl_nerd.evaluation.position_error import position_errors
from torchrl_nerd.evaluation.rollout_error import (
    action_drive,
    initial_states,
    open_loop,
)
from torchrl_nerd.modules.hybrid import HybridNeRD
from torchrl_nerd.robots import protocol_of

HYBRIDS = [n for n in shipped_models() if shipped_card(n)["kind"] == "hybrid"]
TRAJECTORIES, SEED = 128, 4242  # per case; a test seed: nothing was chosen on it
LEAST_GAIN = 1.2  # a fifth
CASES = [(name, drive) for name in HYBRIDS for drive in ("passive", "driven")]
QUICK = CASES[-1:]  # of the last hybrid, driven


def test_there_are_some():
    assert HYBRIDS


@pytest.mark.parametrize(("name", "drive"), slow_but(QUICK, CASES))
def test_without_its_network_the_error_rises_by_a_fifth(name, drive):
    """Over all cases of the protocol, and outside the interval of the difference."""
    model = cast(HybridNeRD, from_pretrained(name))
    protocol, dynamics = protocol_of(model.scene), MujocoDynamics(model.scene)
    sources, steps = list(protocol.cases.values()), max(protocol.horizons)
    start = cast(
        TensorDict,
        torch.cat([initial_states(each, TRAJECTORIES, SEED) for each in sources]),
    )
    actions = action_drive(sources[0], len(start), steps, SEED, drive == "driven")
    ground_truth = open_loop(dynamics, start, steps, actions)
    found: list[dict[str, torch.Tensor]] = []
    for each in (model, without_network(model)):
        path = open_loop(NeRDDynamics(each), start, steps, actions)
        found.append(position_errors(model.scene, ground_truth, path))
    for quantity in found[0]:
        with_it, without = (errors[quantity].mean(1) for errors in found)
        assert without.mean() > LEAST_GAIN * with_it.mean(), quantity
        difference = without - with_it
        interval = 1.96 * difference.std() / len(difference) ** 0.5
        assert difference.mean() > interval, quantity


@pytest.mark.parametrize("name", HYBRIDS)
def test_without_its_network_it_is_its_analytic_step(name, generator):
    model = cast(HybridNeRD, from_pretrained(name))
    start, torque = model.scene.sample_initial(8, generator)
    terrain = start.pop("terrain", None)
    state = TensorDict(start, [8])
    torque = torque * torch.ones(8, len(model.scene.actuated))
    bare = NeRDDynamics(without_network(model)).step(state, torque, terrain)
    step = AnalyticDynamics(model.analytic_step).step(state, torque, terrain)
    for key in ("qpos", "qvel"):
        torch.testing.assert_close(bare[key], step[key], atol=1e-9, rtol=1e-9)
