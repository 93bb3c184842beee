"""A NeRD's encode and decode are the scene's transforms and nothing else."""

import copy
from pathlib import Path

import mujoco
import numpy as np
import pytest
import torch
from dynamics_helpers import random_drive, random_model, scene_stats
from tensordict import TensorDict

from torchrl_nerd.configs import NO_PREDICTIONS
from torchrl_nerd.dynamics import MujocoDynamics
from torchrl_nerd.modules import nerd
from torchrl_nerd.modules.nerd import TARGET, Encoded, NeRD, SceneFeatures
from torchrl_nerd.modules.networks import NETWORKS
from torchrl_nerd.robots import SCENES, load_scene
from torchrl_nerd.transforms import (
    ContactFeatures,
    RobotCentric,
    StateDelta,
)

ROWS = 32


def learned():
    """What a learned model's output is added to, without encoding a state."""
    return Encoded(torch.empty(0), torch.empty(0), 0.0, 1.0)


each_precision = pytest.mark.parametrize(
    ("dtype", "tolerance"), [(torch.float32, 1e-5), (torch.float64, 1e-11)]
)


@each_precision
def test_decode_inverts_the_normalised_target(scene, dtype, tolerance, generator):
    model = NeRD(
        scene, NO_PREDICTIONS, NETWORKS["transformer-2x64"], scene_stats(scene)
    )
    model.network.to(dtype)
    state, torques, terrain = random_drive(scene, ROWS, 1, generator)
    after = MujocoDynamics(scene).step(state, torques[0], terrain)
    now = state["qpos"], state["qvel"]
    delta = StateDelta(scene).delta(*now, after["qpos"], after["qvel"])
    output = model.normalize.normalize(TARGET, delta).to(dtype)
    qpos, qvel = model.decode(now, learned(), output)
    assert qpos.dtype == qvel.dtype == torch.float64
    scale = scene_stats(scene)[TARGET].std.max() * output.abs().max()
    for got, want in ((qpos, after["qpos"]), (qvel, after["qvel"])):
        assert (got - want).abs().max() < tolerance * (scale + want.abs().max())


class OtherDelta(StateDelta):
    """Some other target."""


def test_features_and_targets_of_ones_own_are_not_lost_over_another_ground():
    scene = load_scene("cartpole")
    given = {"state_delta": OtherDelta(scene)}
    model = NeRD(scene, NO_PREDICTIONS, NETWORKS["mlp-1x16"], **given)
    with pytest.raises(ValueError, match="got SceneFeatures and OtherDelta$"):
        model.with_terrain(scene)


@each_precision
def test_encode_is_the_transforms_normalised(scene, dtype, tolerance, generator):
    model = NeRD(
        scene, NO_PREDICTIONS, NETWORKS["transformer-2x64"], scene_stats(scene)
    )
    model.network.to(dtype)
    state, torques, terrain = random_drive(scene, ROWS, 1, generator)
    token = model.encode(state["qpos"], state["qvel"], torques[0], terrain).token
    following = TensorDict({"joint_torque": torques[0]}, [ROWS])
    td = state.clone().set("next", following)
    if terrain is not None:
        td["terrain"] = terrain
    robot, contact = RobotCentric(scene), ContactFeatures(scene)
    contact(robot(td))
    keys = [*robot.sizes, *contact.sizes]
    raw = torch.cat([td[key].double() for key in keys], -1)
    stats = scene_stats(scene)["token"]
    expected = (raw - stats.mean) / stats.std
    assert token.dtype == dtype and token.shape[-1] == SceneFeatures(scene).size
    # the transforms hand over float32, whose rounding a small deviation magnifies
    slack = 1e-6 * (raw.abs() + 1.0) / stats.std + tolerance * (1.0 + expected.abs())
    assert ((token - expected).abs() <= slack).all()


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64, torch.bfloat16])
def test_casting_a_model_casts_its_network_only(scene, dtype, generator):
    model = random_model(scene, generator).to(dtype)
    state, torques, terrain = random_drive(scene, ROWS, 1, generator)
    token = model.encode(state["qpos"], state["qvel"], torques[0], terrain).token
    # the ends of a network stay float32
    assert token.dtype == (torch.float32 if dtype == torch.bfloat16 else dtype)
    for buffer in model.normalize.buffers():
        assert buffer.dtype == torch.float64


def test_leading_dimensions_are_free(scene, generator):
    model = random_model(scene, generator)
    state, torques, terrain = random_drive(scene, 12, 1, generator)
    values = [state["qpos"], state["qvel"], torques[0]]
    split = [x.unflatten(0, (3, 4)) for x in values]
    ground = None if terrain is None else terrain.unflatten(0, (3, 4))
    flat, shaped = model.encode(*values, terrain), model.encode(*split, ground)
    for a, b in zip(shaped[:2], flat[:2], strict=True):
        torch.testing.assert_close(a.flatten(0, 1), b, atol=1e-6, rtol=1e-6)
    output = torch.randn(12, model.state_delta.size, generator=generator)
    flat = model.decode(tuple(values[:2]), flat, output)
    shaped = model.decode(tuple(split[:2]), shaped, output.unflatten(0, (3, 4)))
    for a, b in zip(shaped, flat, strict=True):
        torch.testing.assert_close(a.flatten(0, 1), b, atol=1e-12, rtol=1e-12)


def test_without_statistics_zero_output_is_motion_at_constant_velocity(
    scene, generator
):
    model = NeRD(scene, NO_PREDICTIONS, NETWORKS["mlp-4x64"])
    state, _, _ = random_drive(scene, ROWS, 1, generator)
    zeros = torch.zeros(ROWS, model.state_delta.size)
    qpos, qvel = model.decode((state["qpos"], state["qvel"]), learned(), zeros)
    expected = state["qpos"].numpy().copy()
    for row, velocity in zip(expected, state["qvel"].numpy(), strict=True):
        mujoco.mj_integratePos(scene.model, row, velocity, scene.control_step)
    np.testing.assert_allclose(qpos, expected, atol=1e-12)
    torch.testing.assert_close(qvel, state["qvel"], atol=1e-12, rtol=1e-12)


def test_the_learned_step_does_not_see_where_its_statistics_live(scene, generator):
    model = random_model(scene, generator)
    twin = model.copy_for(scene)
    twin.load_state_dict(model.state_dict())
    state, torques, terrain = random_drive(scene, ROWS, 1, generator)
    inputs = state["qpos"], state["qvel"], torques[0], terrain
    encoded = model.encode(*inputs)
    assert torch.equal(twin.encode(*inputs).token, encoded.token)
    output = model.network(encoded.token[:, None])[:, 0]
    decoded, expected = (m.decode(inputs[:2], encoded, output) for m in (twin, model))
    assert torch.equal(decoded[0], expected[0]) and torch.equal(decoded[1], expected[1])


def test_a_deep_copy_owns_its_weights_and_statistics(generator):
    model = random_model(load_scene("cartpole"), generator)
    before = {key: value.clone() for key, value in model.state_dict().items()}
    with torch.no_grad():
        for value in copy.deepcopy(model).state_dict().values():
            value.fill_(torch.nan)
    assert all(torch.equal(before[k], v) for k, v in model.state_dict().items())


@pytest.mark.parametrize("name", NETWORKS)
def test_every_network_builds_for_every_scene(name):
    for scene in map(load_scene, SCENES):
        model = NeRD(scene, NO_PREDICTIONS, NETWORKS[name])
        tokens = torch.zeros(2, 3, model.token_size)
        with torch.no_grad():
            output = model.network(tokens)
        assert output.shape == (2, 3, 2 * scene.model.nv)


def test_one_file_has_the_model_in_250_lines():
    """What a student reads, with no branch on the kind of model."""
    source = Path(nerd.__file__).read_text()
    assert len(source.splitlines()) <= 250
    words = ("isinstance", "hasattr", "getattr", "Hybrid", "analytic step")
    code = "\n".join(line for line in source.splitlines() if "#" not in line)
    assert not [word for word in words if word in code]
