"""A model that is its free motion's step until it has learned something."""

import pytest
import torch
from dynamics_helpers import (
    FREE,
    each_free,
    enliven,
    random_drive,
    roll,
    scene_stats,
    unequal_keys,
)
from helpers import random_transitions

from torchrl_nerd.checkpoint import (
    load_checkpoint,
    make_card,
    make_model,
    save_checkpoint,
)
from torchrl_nerd.dynamics import NeRDDynamics
from torchrl_nerd.keys import JOINT_TORQUE, QPOS, QVEL
from torchrl_nerd.modules.correction import FreeConfig
from torchrl_nerd.modules.free import FreeNeRD
from torchrl_nerd.scenes import SCENES, load_scene
from torchrl_nerd.training.start import begin_from

ROWS = 32


def fresh(scene):
    return make_model(scene, FreeConfig(), scene_stats(scene))


def lively(scene, generator):
    model = fresh(scene)
    enliven(model.network, generator)
    return model


def step(model, rows):
    state = rows.select(QPOS, QVEL)
    return NeRDDynamics(model).step(state, rows[JOINT_TORQUE])


@each_free
def test_a_fresh_one_moves_as_its_step_does(scene, generator):
    model, rows = fresh(scene), random_transitions(scene, ROWS, generator)
    assert isinstance(model, FreeNeRD)
    inputs = rows[QPOS], rows[QVEL], rows[JOINT_TORQUE]
    qpos, qvel, *_ = model.free_step(*inputs)
    after, size = step(model, rows), 1.0 + (qvel - rows[QVEL]).abs().amax()
    assert (after[QPOS] - qpos).abs().max() < 1e-6 * size
    assert (after[QVEL] - qvel).abs().max() < 1e-6 * size


@each_free
@pytest.mark.parametrize("inference", ["streaming", "window"])
def test_it_comes_back_from_disk(scene, inference, generator, tmp_path):
    model = lively(scene, generator)
    save_checkpoint(model, tmp_path, make_card(model))
    loaded = load_checkpoint(tmp_path)
    assert loaded.config == model.config and type(loaded) is FreeNeRD
    drive = random_drive(scene, 4, 5, generator)
    paths = [roll(NeRDDynamics(m, inference), *drive) for m in (model, loaded)]
    assert not unequal_keys(*paths)


def test_it_keeps_the_substeps_that_it_learned_from(generator, tmp_path):
    """RK4 has no error of its substeps to share, and the plain scene's Euler has."""
    scene = load_scene("cartpole")
    model = lively(scene.fine, generator)
    assert model.free_step.lag == 0.0 < fresh(scene).free_step.lag
    save_checkpoint(model, tmp_path, make_card(model))
    loaded = load_checkpoint(tmp_path, scene)
    assert loaded.free_step.lag == 0.0
    drive = random_drive(scene, 4, 5, generator)
    paths = [roll(NeRDDynamics(m), *drive) for m in (model, loaded)]
    assert not unequal_keys(*paths)


@each_free
def test_rows_do_not_see_each_other(scene, generator):
    model, rows = lively(scene, generator), random_transitions(scene, ROWS, generator)
    together, alone = step(model, rows), step(model, rows[3:4])
    for key in (QPOS, QVEL):
        torch.testing.assert_close(
            alone[key][0], together[key][3], atol=1e-5, rtol=1e-5
        )


def test_where_there_is_no_doubt_the_network_has_no_say(generator):
    """An arm at rest that nothing drives stays, whatever the weights are."""
    scene = load_scene("franka")
    model, rows = lively(scene, generator), random_transitions(scene, ROWS, generator)
    rows[QVEL].zero_()
    rows[JOINT_TORQUE] = 0.0 * rows[JOINT_TORQUE]
    model.normalize = fresh(scene).normalize
    after = step(model, rows)
    assert (after[QVEL] - rows[QVEL]).abs().max() < 1e-6
    driven = random_transitions(scene, ROWS, generator)
    lively_path, fresh_path = step(model, driven), step(fresh(scene), driven)
    assert (lively_path[QVEL] - fresh_path[QVEL]).abs().max() > 1e-3


@each_free
def test_only_the_mlp_is_cast(scene, generator):
    """The step's own change keeps float32, whatever the network computes in."""
    rows = random_transitions(scene, ROWS, generator)
    half = fresh(scene).bfloat16()
    assert half.dtype == torch.bfloat16
    assert all(x.dtype == torch.float64 for x in half.free_step.buffers())
    expected, after = step(fresh(scene), rows), step(half, rows)
    assert torch.equal(after[QVEL], expected[QVEL])


@pytest.mark.slow
def test_compiled_equals_eager(generator):
    scene = load_scene("franka")
    model, drive = lively(scene, generator), random_drive(scene, 4, 5, generator)
    paths = [roll(NeRDDynamics(model, compile=c), *drive) for c in (False, True)]
    for key in (QPOS, QVEL):
        torch.testing.assert_close(paths[1][key], paths[0][key], atol=1e-5, rtol=1e-5)


def test_another_robot_is_refused():
    name = next(name for name in SCENES if load_scene(name) not in FREE)
    with pytest.raises(ValueError, match="alone move, got scene"):
        make_model(load_scene(name), FreeConfig())


@each_free
def test_it_can_be_learned_on(scene, generator):
    start = lively(scene, generator)
    model = begin_from(start, scene, "free")
    weights = start.network.state_dict()
    assert isinstance(model, FreeNeRD)
    assert all(
        torch.equal(model.network.state_dict()[k], x) for k, x in weights.items()
    )
    with pytest.raises(ValueError, match="start from, free, got mlp"):
        begin_from(start, scene, "mlp")
