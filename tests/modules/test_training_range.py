"""Inside the training data nothing is touched; outside everything stays bounded."""

import torch
from dynamics_helpers import LEARNED, little_data, random_drive, random_model

from torchrl_nerd.dynamics import NeRDDynamics
from torchrl_nerd.geometry.constants import cast_constants
from torchrl_nerd.geometry.manifold import differentiate_pos
from torchrl_nerd.modules.training_range import TrainingRange, magnitudes
from torchrl_nerd.robots import load_scene
from torchrl_nerd.training.samples import cover, normalised

ROWS = 16


def test_training_data_are_left_as_they_are(scene, generator):
    model, data = random_model(scene, generator), little_data(scene)
    tokens, targets = normalised(model, data)
    assert torch.equal(model.training_range.clamp_features(tokens), tokens)
    assert torch.equal(model.training_range.clamp_target(targets), targets)
    qvel = data["next", "qvel"]
    assert torch.equal(model.training_range.limit_motion(qvel, 1.0), qvel)
    qpos = data["next", "qpos"]
    for kept, given in zip(
        model.training_range.stop_joints(qpos, qvel), (qpos, qvel), strict=True
    ):
        assert torch.equal(kept, given)


def test_one_training_state_in_a_hundred_is_called_unfamiliar(scene, generator):
    model = random_model(scene, generator)
    tokens, _ = normalised(model, little_data(scene))
    share = (model.ood_score(tokens.flatten(0, -2)) > 1.0).double().mean()
    assert 0.005 < share < 0.015


def test_whatever_comes_in_speeds_and_motions_stay_bounded(scene, generator):
    model = random_model(scene, generator)
    state, torques, terrain = random_drive(scene, ROWS, 20, generator)
    wild = 10.0 ** (6.0 * torch.rand(ROWS, 1, generator=generator).double())
    state["qvel"] = wild * state["qvel"]
    bounds = model.training_range
    limit = bounds.speed * (1.0 + 1e-9)
    for inference in LEARNED:
        dynamics, now = NeRDDynamics(model, inference), state
        for torque in wild * torques:
            before, now = now, dynamics.step(now, torque, terrain)
            assert now["qpos"].isfinite().all()
            assert (magnitudes(bounds.vectors, now["qvel"]) <= limit).all()
            moved = differentiate_pos(scene.layout, before["qpos"], now["qpos"])
            moved = magnitudes(bounds.vectors, moved)
            is_within = magnitudes(bounds.vectors, before["qvel"]) <= bounds.speed
            assert (moved <= scene.control_step * limit + 1e-6)[is_within].all()


def test_widened_bounds_hold_both(scene, generator):
    model, other = (random_model(scene, generator) for _ in range(2))
    data = little_data(scene)[::2]
    data["next", "qvel"] = 3.0 * data["next", "qvel"]
    cover(other, data)
    mine, theirs = model.training_range, other.training_range
    before = {key: value.clone() for key, value in mine.state_dict().items()}
    sizes = model.scene_features.size, model.state_delta.size
    mine.widen(TrainingRange(scene, *sizes))  # never fitted
    assert all(torch.equal(mine.state_dict()[k], v) for k, v in before.items())
    mine.widen(theirs)
    for key, value in mine.state_dict().items():
        wider = torch.minimum if key.endswith("low") else torch.maximum
        assert torch.equal(value, wider(before[key], theirs.state_dict()[key])), key
    assert (mine.speed > before["speed"]).any()


def test_joints_with_limits_stop_where_the_data_end(scene, generator):
    layout = scene.layout
    bounds = random_model(scene, generator).training_range
    shape = (ROWS, layout.nq + layout.nv)
    wild = 100.0 * torch.randn(shape, dtype=torch.float64, generator=generator)
    qpos, qvel = wild.split((layout.nq, layout.nv), -1)
    place, speed = bounds.stop_joints(qpos, qvel)
    for q, v in bounds.limited:
        low, high = bounds.qpos_low[q], bounds.qpos_high[q]
        assert ((place[:, q] >= low) & (place[:, q] <= high)).all()
        assert (speed[:, v][qpos[:, q] > high] <= 0.0).all()
        assert (speed[:, v][qpos[:, q] < low] >= 0.0).all()
    free_q = [q for q in range(layout.nq) if q not in dict(bounds.limited)]
    free_v = [v for v in range(layout.nv) if v not in dict(bounds.limited).values()]
    assert torch.equal(place[:, free_q], qpos[:, free_q])
    assert torch.equal(speed[:, free_v], qvel[:, free_v])


def test_beyond_the_training_range_is_out_of_distribution(scene, generator):
    model = random_model(scene, generator)
    bounds = model.training_range
    tokens, _ = normalised(model, little_data(scene))
    tokens = tokens.flatten(0, -2)[:ROWS].double()
    entry = torch.randint(tokens.shape[-1], (ROWS,), generator=generator)
    step = 1e-6 + torch.rand(ROWS, generator=generator).double()
    rows = torch.arange(ROWS)
    tokens[rows, entry] = bounds.feature_high[entry] + step
    assert (model.ood_score(tokens) > 1.0).all()
    assert torch.equal(
        bounds.clamp_features(tokens)[rows, entry], bounds.feature_high[entry]
    )


def test_gradients_are_finite_at_rest(scene, generator):
    model = random_model(scene, generator)
    state, torques, terrain = random_drive(scene, ROWS, 1, generator)
    qvel = torch.zeros_like(state["qvel"]).requires_grad_()
    memory = model.network.empty_memory(ROWS)
    _, after, _ = model.step(
        (state["qpos"], qvel),
        torques[0],
        terrain,
        lambda token: model.network.step(token, memory),
    )
    after.square().sum().backward()
    assert qvel.grad is not None and qvel.grad.isfinite().all()


def test_a_joint_that_never_moved_in_the_data_stays(generator):
    bounds = random_model(load_scene("cartpole"), generator).training_range
    bounds.speed[0] = 0.0
    motion = torch.tensor([[0.0, 0.1], [3.0, 0.1]], dtype=torch.float64)
    assert bounds.limit_motion(motion, 1.0)[:, 0].tolist() == [0.0, 0.0]


def test_a_model_that_saw_no_data_is_bounded_by_nothing(scene, generator):
    bounds = TrainingRange(scene, 5, 2 * scene.model.nv)
    assert not bounds.is_fitted
    wild = 1e9 * torch.randn(ROWS, 5, generator=generator).double()
    assert torch.equal(bounds.clamp_features(wild), wild)


def test_a_model_that_knows_no_range_says_so_in_any_precision():
    for dtype in (torch.float64, torch.float32):
        known = TrainingRange(load_scene("cartpole"), 3, 2)
        assert not cast_constants(known, dtype).is_fitted
