"""A hybrid is its analytic step until its network has learned something."""

import pytest
import torch
from dynamics_helpers import (
    ANALYTIC,
    each_analytic,
    enliven,
    little_data,
    random_drive,
    roll,
    scene_stats,
    unequal_keys,
)
from helpers import in_ground, random_transitions
from torch import nn

from torchrl_nerd.analytic import STEPS, make_step
from torchrl_nerd.checkpoint import load_checkpoint, make_card, save_checkpoint
from torchrl_nerd.configs import NO_PREDICTIONS, TrainConfig
from torchrl_nerd.dynamics import AnalyticDynamics, NeRDDynamics
from torchrl_nerd.evaluation.stability.states import rotated
from torchrl_nerd.geometry.manifold import differentiate_pos
from torchrl_nerd.keys import JOINT_TORQUE, QPOS, QVEL, TERRAIN
from torchrl_nerd.modules.hybrid import HybridNeRD
from torchrl_nerd.modules.networks import NETWORKS
from torchrl_nerd.modules.training_range import magnitudes
from torchrl_nerd.robots import load_scene
from torchrl_nerd.training.samples import cover
from torchrl_nerd.training.start import begin_from

ROWS = 32
PRODUCTS = "mlp-4x128", "mlp-4x128-products"


def fresh(scene, step, network="mlp-2x64"):
    made = make_step(scene, STEPS[step])
    stats = scene_stats(scene)
    return HybridNeRD(scene, made, NO_PREDICTIONS, NETWORKS[network], stats)


def lively(scene, step, generator):
    model = fresh(scene, step)
    enliven(model.network, generator)
    return model


def advance(model, rows):
    state = rows.select(QPOS, QVEL)
    return NeRDDynamics(model).step(state, rows[JOINT_TORQUE], rows.get(TERRAIN, None))


@each_analytic
def test_a_fresh_one_moves_as_its_step_does(scene, step, generator):
    """The analytic change stays float64, whatever the network computes in."""
    rows = random_transitions(scene, ROWS, generator)
    given = rows.select(QPOS, QVEL), rows[JOINT_TORQUE], rows.get(TERRAIN, None)
    expected = AnalyticDynamics(make_step(scene, STEPS[step])).step(*given)
    for dtype in (torch.float64, torch.float32, torch.bfloat16):
        after = advance(fresh(scene, step).to(dtype), rows)
        for key in (QPOS, QVEL):
            torch.testing.assert_close(after[key], expected[key], atol=1e-9, rtol=1e-9)


@each_analytic
def test_changes_are_bounded_by_speed_and_not_by_the_data(scene, step, generator):
    """The analytic step knows harder impacts than any in the data."""
    model, rows = fresh(scene, step), random_transitions(scene, ROWS, generator)
    expected = advance(model, rows)
    cover(model, little_data(scene))
    bounds, limit = model.training_range, model.training_range.speed
    for end in (bounds.target_low, bounds.target_high):
        end.zero_()  # data in which nothing ever changed
    after = advance(model, rows)
    is_slow = (magnitudes(bounds.vectors, expected[QVEL]) < limit).all(-1)
    assert is_slow.any()
    for key in (QPOS, QVEL):
        torch.testing.assert_close(after[key][is_slow], expected[key][is_slow])
    enliven(model.network, generator)
    bounds.qpos_low.fill_(-torch.inf), bounds.qpos_high.fill_(torch.inf)
    rows[JOINT_TORQUE] = 1e2 * rows[JOINT_TORQUE]
    after = advance(model, rows)
    speed = magnitudes(bounds.vectors, after[QVEL])
    assert (speed <= limit * (1.0 + 1e-9)).all()
    moved = differentiate_pos(scene.layout, rows[QPOS], after[QPOS])
    is_within = magnitudes(bounds.vectors, rows[QVEL]) <= limit
    farthest = scene.control_step * limit + 1e-9
    assert (magnitudes(bounds.vectors, moved) <= farthest)[is_within].all()


@each_analytic
@pytest.mark.parametrize("times", [1e3, 1e30, 1e200])
def test_torques_that_overflow_the_step_leave_it_finite(scene, step, times, generator):
    model = lively(scene, step, generator)
    rows = random_transitions(scene, 8, generator)
    cover(model, little_data(scene))
    rows[JOINT_TORQUE] *= times
    rows[QVEL] *= 10.0
    after, bounds = advance(model, rows), model.training_range
    assert after[QPOS].isfinite().all()
    speed = magnitudes(bounds.vectors, after[QVEL])
    assert (speed <= bounds.speed * (1.0 + 1e-9)).all()


@each_analytic
@pytest.mark.parametrize("key", [QPOS, QVEL, JOINT_TORQUE])
def test_nan_shows_in_the_next_state_of_its_own_env(scene, step, key, generator):
    model = lively(scene, step, generator)
    rows = random_transitions(scene, 8, generator)
    cover(model, little_data(scene))
    for column in range(rows[key].shape[-1]):
        broken = rows.clone()
        broken[key][0, column] = torch.nan
        after = advance(model, broken)
        state = torch.cat((after[QPOS], after[QVEL]), -1)
        assert not state[0].isfinite().all()
        assert state[1:].isfinite().all()


@each_analytic
@pytest.mark.parametrize("inference", ["streaming", "window"])
def test_it_comes_back_from_disk(scene, step, inference, generator, tmp_path):
    model = lively(scene, step, generator)
    card = make_card(model)
    assert card["kind"] == "hybrid" and card["step"]["kind"] in step
    loaded = load_checkpoint(save_checkpoint(model, tmp_path, card))
    assert type(loaded) is HybridNeRD and loaded.config == model.config
    assert loaded.analytic_step.config == model.analytic_step.config
    drive = random_drive(scene, 4, 5, generator)
    paths = [roll(NeRDDynamics(m, inference), *drive) for m in (model, loaded)]
    assert not unequal_keys(*paths)


@each_analytic
def test_envs_do_not_see_each_other(scene, step, generator):
    # in float64: stiff contacts may magnify the rounding of float32 a thousand times
    model = lively(scene, step, generator).double()
    rows = random_transitions(scene, ROWS, generator)
    together, alone = advance(model, rows), advance(model, rows[3:4])
    for key in (QPOS, QVEL):
        torch.testing.assert_close(
            alone[key][0], together[key][3], atol=1e-3, rtol=1e-3
        )


@pytest.mark.parametrize(
    ("scene", "step"),
    [(scene, step) for scene, step in ANALYTIC if scene.base.is_floating],
    ids=lambda x: getattr(x, "name", x),
)
def test_it_is_invariant_under_yaw(scene, step, generator):
    model, rows = (
        lively(scene, step, generator).double(),
        in_ground(scene, ROWS, generator),
    )
    quat = rows[QPOS][:, scene.base.qpos_address + 3 :][:, :4]
    quat.copy_(quat / quat.norm(dim=-1, keepdim=True))
    angle = torch.pi * torch.rand(1, generator=generator).double()
    turn = torch.cat((angle.cos(), torch.zeros(2), angle.sin()))
    there = advance(model, rotated(scene, rows, turn))
    expected = rotated(scene, advance(model, rows), turn)
    for key in (QPOS, QVEL):
        close = (there[key] - expected[key]).abs() <= 1e-3 * (1.0 + expected[key].abs())
        assert close.all(-1).double().mean() > 0.9  # float32 may decide on touching


def test_where_the_defect_is_zero_the_network_has_no_influence(generator):
    """A cube that falls without turning: its dynamics change nowhere in the step."""
    scene = load_scene("cube")
    model = lively(scene, "penalty-contact", generator)
    rows = random_transitions(scene, ROWS, generator)
    rows[QPOS][:, 2], rows[QVEL][:, 3:] = 5.0, 0.0
    after, speed = advance(model, rows)[QVEL], rows[QVEL].clone()
    speed[:, 2] += float(scene.model.opt.gravity[2]) * scene.control_step
    torch.testing.assert_close(after, speed, atol=1e-5, rtol=1e-5)
    touching = in_ground(scene, ROWS, generator)
    plain = fresh(scene, "penalty-contact")
    difference = advance(model, touching)[QVEL] - advance(plain, touching)[QVEL]
    assert difference.abs().max() > 1e-3


def test_of_a_varied_robot_the_network_always_counts(generator, tmp_path):
    """Also from disk, where the scene of an env is that of one robot."""
    scene = load_scene("cartpole")
    rows = random_transitions(scene, 2, generator)
    for key in (QPOS, QVEL, JOINT_TORQUE):
        rows[key] = torch.zeros_like(rows[key])  # at rest: the defect is zero
    still = advance(lively(scene, "unconstrained", generator), rows)
    model = lively(scene.vary({"motor": (0.5, 2.0)}), "unconstrained", generator)
    moved = advance(model, rows)
    assert (still[QVEL].abs() < 1e-12).all() and (moved[QVEL].abs() > 1e-6).all()
    folder = save_checkpoint(model, tmp_path, make_card(model))
    config = TrainConfig("mlp-2x64", "unconstrained")
    for one in (
        load_checkpoint(folder, scene),
        load_checkpoint(folder).with_terrain(scene),
        begin_from(model, scene, config),
    ):
        again = advance(one, rows)
        torch.testing.assert_close(again[QVEL], moved[QVEL], rtol=1e-4, atol=1e-7)


@pytest.mark.slow
@each_analytic
def test_compiled_equals_eager(scene, step, generator):
    model = lively(scene, step, generator)
    drive = random_drive(scene, 4, 5, generator)
    paths = [roll(NeRDDynamics(model, compile=c), *drive) for c in (False, True)]
    for key in (QPOS, QVEL):
        torch.testing.assert_close(
            paths[1][key][:, 0], paths[0][key][:, 0], atol=1e-4, rtol=1e-4
        )


def test_its_last_layer_is_zero_at_first_and_no_other_is(generator):
    model = fresh(load_scene("double_pendulum"), "penalty-contact")
    linear = [m for m in model.network.modules() if isinstance(m, nn.Linear)]
    assert not linear[-1].weight.any() and all(m.weight.any() for m in linear[:-1])


def test_its_products_add_nothing_at_first(generator):
    scene = load_scene("double_pendulum")
    rows = random_transitions(scene, ROWS, generator)
    pair = (fresh(scene, "penalty-contact", name) for name in PRODUCTS)
    plain, model = (advance(model, rows) for model in pair)
    assert torch.equal(plain[QVEL], model[QVEL])
