"""Models that are a step along the equation of motion until they have learned something."""

import pytest
import torch
from dynamics_helpers import (
    FREE,
    GROUNDED,
    STEPPED,
    each_stepped,
    enliven,
    little_data,
    random_drive,
    roll,
    scene_stats,
    unequal_keys,
)
from helpers import in_ground, random_transitions

from torchrl_nerd.checkpoint import (
    load_checkpoint,
    make_card,
    make_model,
    save_checkpoint,
)
from torchrl_nerd.dynamics import NeRDDynamics
from torchrl_nerd.evaluation.stability.states import turned
from torchrl_nerd.geometry.manifold import differentiate_pos
from torchrl_nerd.keys import JOINT_TORQUE, QPOS, QVEL, TERRAIN
from torchrl_nerd.modules.correction import FreeConfig, GroundedConfig
from torchrl_nerd.modules.free import FreeNeRD
from torchrl_nerd.modules.grounded import GroundedNeRD
from torchrl_nerd.modules.networks import STEPS
from torchrl_nerd.robots import SCENES, load_scene
from torchrl_nerd.training.sequences import cover
from torchrl_nerd.training.start import begin_from

ROWS = 32
KINDS = {FreeConfig: FreeNeRD, GroundedConfig: GroundedNeRD}


def fresh(scene, network):
    return make_model(scene, STEPS[network], scene_stats(scene))


def lively(scene, network, generator):
    model = fresh(scene, network)
    enliven(model.network, generator)
    return model


def step(model, rows):
    state = rows.select(QPOS, QVEL)
    return NeRDDynamics(model).step(state, rows[JOINT_TORQUE], rows.get(TERRAIN, None))


def test_the_papers_robots_are_moved_so():
    assert "franka" in [scene.name for scene in FREE]
    names = {scene.name for scene in GROUNDED}
    assert {"ant", "anymal", "cube", "double_pendulum"} <= names


@each_stepped
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64], ids=str)
def test_a_fresh_one_moves_as_its_step_does(scene, network, dtype, generator):
    """With springs in the model's precision: they magnify the rounding of float32."""
    model = fresh(scene, network).to(dtype)
    rows = random_transitions(scene, ROWS, generator)
    inputs = rows[QPOS], rows[QVEL], rows[JOINT_TORQUE]
    if isinstance(model, GroundedNeRD):
        qpos, qvel, _ = model.ground_step(*inputs, rows.get(TERRAIN, None), dtype)
    else:
        qpos, qvel, *_ = model.free_step(*inputs)
    after, size = step(model, rows), 1.0 + (qvel - rows[QVEL]).abs().amax()
    tolerance = 50.0 * torch.finfo(dtype).eps * size
    assert (after[QPOS] - qpos).abs().max() < tolerance
    assert (after[QVEL] - qvel).abs().max() < tolerance


@each_stepped
def test_changes_are_bounded_by_speed_and_not_by_the_data(scene, network, generator):
    """A step knows of impacts that are harder than any in the data."""
    model, rows = fresh(scene, network), random_transitions(scene, ROWS, generator)
    expected = step(model, rows)
    cover(model, little_data(scene))
    coverage, limit = model.coverage, model.coverage.speed
    for end in (coverage.target_low, coverage.target_high):
        end.zero_()  # data in which nothing ever changed
    coverage.still.zero_()
    after = step(model, rows)
    is_slow = (coverage.sizes(expected[QVEL]) < limit).all(-1)
    assert is_slow.any()
    for key in (QPOS, QVEL):
        torch.testing.assert_close(after[key][is_slow], expected[key][is_slow])
    enliven(model.network, generator)
    coverage.qpos_low.fill_(-torch.inf), coverage.qpos_high.fill_(torch.inf)
    rows[JOINT_TORQUE] = 1e2 * rows[JOINT_TORQUE]
    after = step(model, rows)
    assert (coverage.sizes(after[QVEL]) <= limit * (1.0 + 1e-9)).all()
    moved = differentiate_pos(scene.layout, rows[QPOS], after[QPOS])
    way = 0.5 * coverage.sizes(rows[QVEL]) + 1.5 * limit  # m/s: trapezoid, residual
    assert (coverage.sizes(moved) <= 2.0 * scene.control_step * way).all()
    is_within = coverage.sizes(rows[QVEL]) <= limit
    farthest = scene.control_step * limit + 1e-9
    assert (coverage.sizes(moved) <= farthest)[is_within].all()


@each_stepped
@pytest.mark.parametrize("times", [1e3, 1e6, 1e30, 1e200])
def test_torques_that_overflow_the_step_leave_it_finite(
    scene, network, times, generator
):
    model = lively(scene, network, generator)
    rows = random_transitions(scene, 8, generator)
    cover(model, little_data(scene))
    rows[JOINT_TORQUE] *= times
    rows[QVEL] *= 10.0
    after = step(model, rows)
    sizes = model.coverage.sizes(after[QVEL])
    assert after[QPOS].isfinite().all()
    assert (sizes <= model.coverage.speed * (1.0 + 1e-9)).all()


@each_stepped
@pytest.mark.parametrize("key", [QPOS, QVEL, JOINT_TORQUE])
def test_what_is_no_number_stays_none(scene, network, key, generator):
    """And shows in the next state: nothing hides a fault."""
    model = lively(scene, network, generator)
    rows = random_transitions(scene, 8, generator)
    cover(model, little_data(scene))
    for column in range(rows[key].shape[-1]):
        broken = rows.clone()
        broken[key][0, column] = torch.nan
        after = step(model, broken)
        state = torch.cat((after[QPOS], after[QVEL]), -1)
        assert not state[0].isfinite().all()
        assert state[1:].isfinite().all()


@each_stepped
@pytest.mark.parametrize("inference", ["streaming", "window"])
def test_it_comes_back_from_disk(scene, network, inference, generator, tmp_path):
    model = lively(scene, network, generator)
    save_checkpoint(model, tmp_path, make_card(model))
    loaded = load_checkpoint(tmp_path)
    assert loaded.config == model.config and type(loaded) is KINDS[type(STEPS[network])]
    drive = random_drive(scene, 4, 5, generator)
    paths = [roll(NeRDDynamics(m, inference), *drive) for m in (model, loaded)]
    assert not unequal_keys(*paths)


def test_it_keeps_the_substeps_that_it_learned_from(generator, tmp_path):
    """RK4 has no error of its substeps to share, and the plain scene's Euler has."""
    scene = load_scene("cartpole")
    model = lively(scene.reference, "free", generator)
    assert model.free_step.lag == 0.0 < fresh(scene, "free").free_step.lag
    save_checkpoint(model, tmp_path, make_card(model))
    loaded = load_checkpoint(tmp_path, scene)
    assert loaded.free_step.lag == 0.0
    assert (
        loaded.free_step.parts == model.free_step.parts
    )  # pushes at the ends of joints
    drive = random_drive(scene, 4, 5, generator)
    paths = [roll(NeRDDynamics(m), *drive) for m in (model, loaded)]
    assert not unequal_keys(*paths)


@each_stepped
def test_rows_do_not_see_each_other(scene, network, generator):
    # in float64: springs may magnify the rounding of float32 a thousand times
    model = lively(scene, network, generator).double()
    rows = random_transitions(scene, ROWS, generator)
    together, alone = step(model, rows), step(model, rows[3:4])
    for key in (QPOS, QVEL):
        torch.testing.assert_close(
            alone[key][0], together[key][3], atol=1e-6, rtol=1e-6
        )


@pytest.mark.parametrize(
    ("scene", "network"), [(s, n) for s, n in STEPPED if s.base.is_floating]
)
def test_north_is_a_way_like_any_other(scene, network, generator):
    model, rows = (
        lively(scene, network, generator).double(),
        in_ground(scene, ROWS, generator),
    )
    quat = rows[QPOS][:, scene.base.qpos_address + 3 :][:, :4]
    quat.copy_(quat / quat.norm(dim=-1, keepdim=True))
    angle = torch.pi * torch.rand(1, generator=generator).double()
    turn = torch.cat((angle.cos(), torch.zeros(2), angle.sin()))
    there = step(model, turned(scene, rows, turn))
    expected = turned(scene, step(model, rows), turn)
    for key in (QPOS, QVEL):
        torch.testing.assert_close(there[key], expected[key], atol=1e-6, rtol=1e-6)


def test_where_there_is_no_doubt_the_network_has_no_say(generator):
    """An arm at rest that nothing drives stays, whatever the weights are."""
    scene = load_scene("franka")
    model = lively(scene, "free", generator)
    rows = random_transitions(scene, ROWS, generator)
    rows[QVEL].zero_()
    rows[JOINT_TORQUE] = 0.0 * rows[JOINT_TORQUE]
    model.normalize = fresh(scene, "free").normalize
    after = step(model, rows)
    assert (after[QVEL] - rows[QVEL]).abs().max() < 1e-6
    driven = random_transitions(scene, ROWS, generator)
    paths = step(model, driven), step(fresh(scene, "free"), driven)
    assert (paths[0][QVEL] - paths[1][QVEL]).abs().max() > 1e-3


def test_nor_has_it_in_a_fall_without_turning(generator):
    """Nothing changes between two looks at a cube that falls as it is."""
    scene = load_scene("cube")
    model = lively(scene, "grounded", generator)
    rows = random_transitions(scene, ROWS, generator)
    rows[QPOS][:, 2], rows[QVEL][:, 3:] = 5.0, 0.0
    after, speed = step(model, rows)[QVEL], rows[QVEL].clone()
    speed[:, 2] += float(scene.model.opt.gravity[2]) * scene.control_step
    torch.testing.assert_close(after, speed, atol=1e-5, rtol=1e-5)


@each_stepped
def test_only_the_mlp_is_cast(scene, network, generator):
    """The step's own change keeps float32, whatever the network computes in."""
    rows = random_transitions(scene, ROWS, generator)
    half = fresh(scene, network).bfloat16()
    assert half.dtype == torch.bfloat16
    own = half.free_step if network == "free" else half.ground_step
    kept = [x for x in own.buffers() if x.is_floating_point()]
    assert all(x.dtype == torch.float64 for x in kept)
    expected, after = step(fresh(scene, network), rows), step(half, rows)
    assert torch.equal(after[QVEL], expected[QVEL])


@pytest.mark.slow
@each_stepped
def test_compiled_equals_eager(scene, network, generator):
    model = lively(scene, network, generator)
    drive = random_drive(scene, 4, 5, generator)
    paths = [roll(NeRDDynamics(model, compile=c), *drive) for c in (False, True)]
    for key in (QPOS, QVEL):
        torch.testing.assert_close(
            paths[1][key][:, 0], paths[0][key][:, 0], atol=1e-4, rtol=1e-4
        )


def test_another_robot_is_refused():
    name = next(name for name in SCENES if load_scene(name) not in FREE)
    with pytest.raises(ValueError, match="alone move, got scene"):
        make_model(load_scene(name), STEPS["free"])
    with pytest.raises(ValueError, match="expected a ground to step on, got scene"):
        make_model(FREE[0], STEPS["grounded"])


@each_stepped
def test_it_can_be_learned_on(scene, network, generator):
    start = lively(scene.foreseeing(False), network, generator)
    model = begin_from(start, scene, network)
    weights = start.network.state_dict()
    assert type(model) is KINDS[type(STEPS[network])]
    assert all(
        torch.equal(model.network.state_dict()[k], x) for k, x in weights.items()
    )
    with pytest.raises(ValueError, match=f"start from, {network}, got mlp"):
        begin_from(start, scene, "mlp-4x64")
