"""NeRDDynamics: encode, network with its history, decode."""

import copy

import pytest
import torch
from dynamics_helpers import (
    HAS_COMPILER,
    LEARNED,
    double_model,
    enliven,
    in_small_steps,
    random_drive,
    random_model,
    roll,
    unequal_keys,
)
from torch import Tensor

from torchrl_nerd.checkpoint import from_pretrained
from torchrl_nerd.configs import NO_PREDICTIONS
from torchrl_nerd.dynamics import NeRDDynamics
from torchrl_nerd.modules.nerd import Encoded, NeRD
from torchrl_nerd.modules.networks import NETWORKS
from torchrl_nerd.robots import load_scene

ROWS, STEPS = 4, 14
each_inference = pytest.mark.parametrize("inference", LEARNED)
SCENE = load_scene("cartpole")


def encoded(model: NeRD, state, torques, terrain) -> Encoded:
    """What the model makes ``(rows, steps, ...)`` of a path of true or learned states."""
    ground = None if terrain is None else terrain[:, None].expand(-1, len(torques), -1)
    torques = torques.transpose(0, 1)
    return model.encode(state["qpos"], state["qvel"], torques, ground)


@each_inference
@pytest.mark.parametrize("network", ["transformer-2x64", "mlp-4x64", "gru"])
def test_a_path_is_encode_network_decode(scene, inference, network, generator):
    model, window = double_model(scene, generator, network), 5
    start, torques, terrain = random_drive(scene, ROWS, STEPS, generator)
    dynamics = NeRDDynamics(model, inference, window)
    after = roll(dynamics, start, torques, terrain)
    before = torch.cat((start[:, None], after[:, :-1]), 1)
    found = encoded(model, before, torques, terrain)
    tokens = found.token
    with torch.no_grad():
        if inference == "streaming":
            outputs = model.network(tokens)
        else:
            parts = [tokens[:, max(0, t - window + 1) : t + 1] for t in range(STEPS)]
            outputs = torch.stack([model.network(part)[:, -1] for part in parts], 1)
        qpos, qvel = model.decode((before["qpos"], before["qvel"]), found, outputs)
    # what has learned nothing may fly off, where rounding turns it by whole turns
    is_calm = torch.cat((before["qvel"], qvel), -1).abs().amax(-1) < 1e3
    assert is_calm.any()
    close = {"atol": 1e-10, "rtol": 1e-10}
    torch.testing.assert_close(after["qpos"][is_calm], qpos[is_calm], **close)
    torch.testing.assert_close(after["qvel"][is_calm], qvel[is_calm], **close)


@each_inference
def test_history_matters_and_a_reset_empties_it(scene, inference, generator):
    dynamics = NeRDDynamics(in_small_steps(random_model(scene, generator)), inference)
    start, torques, terrain = random_drive(scene, ROWS, 2, generator)
    first = dynamics.step(start, torques[0], terrain)
    dynamics.step(first, torques[1], terrain)
    second = dynamics.step(start, torques[0], terrain)
    assert (first["qvel"] != second["qvel"]).any(-1).all()
    dynamics.reset(start)
    assert not unequal_keys(dynamics.step(start, torques[0], terrain), first)


@each_inference
def test_gradients_are_those_of_finite_differences(scene, inference, generator):
    model = in_small_steps(double_model(scene, generator))
    start, torques, terrain = random_drive(scene, ROWS, 4, generator)
    torques = 0.1 * torques
    weight = torch.randn(ROWS, scene.model.nv, generator=generator).double()

    def objective(push: Tensor) -> Tensor:
        dynamics = NeRDDynamics(model, inference, differentiable=True)
        driven = torch.cat((torques[:1] * (1.0 + push), torques[1:]))
        return (weight * roll(dynamics, start, driven, terrain)["qvel"][:, -1]).sum()

    push = torch.zeros((), dtype=torch.float64, requires_grad=True)
    (gradient,) = torch.autograd.grad(objective(push), push)
    with torch.no_grad():
        h = torch.tensor(1e-4, dtype=torch.float64)
        rounding = 1e-14 * objective(0.0 * h).abs() / h
        slopes = [
            (objective(k * h) - objective(-k * h)) / (2.0 * k * h) for k in (1, 2)
        ]
    slope = (4.0 * slopes[0] - slopes[1]) / 3.0
    assert bool(gradient != 0.0) == bool(scene.actuated)
    tolerance = 1e-6 + float(rounding)
    torch.testing.assert_close(gradient, slope, atol=tolerance, rtol=1e-5)


@each_inference
def test_gradients_reach_every_weight_through_partial_resets(inference, generator):
    model = double_model(SCENE, generator)
    dynamics = NeRDDynamics(model, inference, differentiable=True)
    start, torques, terrain = random_drive(SCENE, ROWS, 6, generator)
    rows = torch.tensor([False, True, False, True])
    middle = roll(dynamics, start, torques[:3], terrain)[:, -1]
    dynamics.reset(middle, rows)
    end = roll(dynamics, middle, torques[3:], terrain)[:, -1]
    (end["qpos"].square().sum() + end["qvel"].square().sum()).backward()
    for name, weight in model.network.named_parameters():
        assert weight.grad is not None and weight.grad.isfinite().all(), name
        assert weight.grad.abs().max() > 0.0, name


@each_inference
def test_without_asking_no_graph_is_kept(inference, generator):
    dynamics = NeRDDynamics(random_model(SCENE, generator), inference)
    start, torques, terrain = random_drive(SCENE, ROWS, 2, generator)
    path = roll(dynamics, start, torques.requires_grad_(), terrain)
    assert not path["qpos"].requires_grad and not path["qvel"].requires_grad


@each_inference
def test_two_dynamics_of_one_model_have_histories_of_their_own(inference, generator):
    model = random_model(SCENE, generator)
    drive, other = (random_drive(SCENE, ROWS, STEPS, generator) for _ in range(2))
    expected = roll(NeRDDynamics(model, inference), *drive)
    first, second = (NeRDDynamics(model, inference) for _ in range(2))
    state, states = drive[0], []
    for step in range(STEPS):
        second.step(other[0], other[1][step], other[2])
        state = first.step(state, drive[1][step], drive[2])
        states.append(state)
    assert not unequal_keys(torch.stack(states, 1), expected)


@each_inference
def test_a_deep_copy_takes_its_history_along(inference, generator):
    dynamics = NeRDDynamics(random_model(SCENE, generator), inference)
    start, torques, terrain = random_drive(SCENE, ROWS, STEPS, generator)
    middle = roll(dynamics, start, torques[:5], terrain)[:, -1]
    twin = copy.deepcopy(dynamics)
    expected = roll(dynamics, middle, torques[5:], terrain)
    assert not unequal_keys(roll(twin, middle, torques[5:], terrain), expected)


@pytest.mark.slow
@each_inference
@pytest.mark.parametrize("network", ["transformer-2x64", "mlp-4x64", "gru"])
def test_compiled_equals_eager(scene, inference, network, generator):
    model = random_model(scene, generator, network)
    start, torques, terrain = random_drive(scene, ROWS, STEPS, generator)
    eager, compiled = (NeRDDynamics(model, inference, compile=c) for c in (False, True))
    rows = torch.tensor([False, True, False, True])
    state = start
    for step, torque in enumerate(torques):
        if step == 6:
            eager.reset(state, rows)
            compiled.reset(state, rows)
        expected = eager.step(state, torque, terrain)
        got = compiled.step(state, torque, terrain)
        for key in ("qpos", "qvel"):
            torch.testing.assert_close(got[key], expected[key], atol=1e-5, rtol=1e-5)
        state = expected
    assert HAS_COMPILER != compiled._compiled.is_eager  # nothing in it fell back


def test_bad_choices_are_refused_in_one_sentence(generator):
    model = NeRD(SCENE, NO_PREDICTIONS, NETWORKS["mlp-4x64"])
    with pytest.raises(ValueError, match="'streaming' or 'window', got 'batch'"):
        NeRDDynamics(model, inference="batch")
    with pytest.raises(ValueError, match="window of at least 1.*got 0"):
        NeRDDynamics(model, inference="window", window=0)


@pytest.mark.slow
def test_a_compiled_step_follows_its_weights(generator):
    """Changed in place, put in another's stead, or of another dtype."""
    model = from_pretrained("double_pendulum-mlp")
    drive = random_drive(model.scene, 4, 3, generator)
    compiled = NeRDDynamics(model, compile=True)
    roll(compiled, *drive)
    other = from_pretrained("double_pendulum-mlp").state_dict()
    for change in (
        lambda: enliven(model.network, generator),
        lambda: model.load_state_dict(other, assign=True),
        model.double,
    ):
        change()
        found, expected = roll(compiled, *drive), roll(NeRDDynamics(model), *drive)
        torch.testing.assert_close(found, expected, atol=1e-5, rtol=1e-5)
    assert not compiled._compiled.is_eager or not HAS_COMPILER
