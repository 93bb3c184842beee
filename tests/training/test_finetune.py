"""Fine-tuning on a dozen real recording: what moves, what stays, and that it helps."""

from dataclasses import replace

import pytest
import torch
from helpers import simulated, slow_but

from torchrl_nerd import load_scene
from torchrl_nerd.configs import NO_PREDICTIONS, FinetuneConfig
from torchrl_nerd.evaluation.position_error import position_errors
from torchrl_nerd.modules.nerd import NeRD
from torchrl_nerd.modules.networks import network_config
from torchrl_nerd.settings import SettingError
from torchrl_nerd.training.finetune import (
    FineTuner,
    converged,
    rollout_error,
    score,
    start_model,
    weighted_error,
)
from torchrl_nerd.training.samples import cover, data_stats

QUICK = FinetuneConfig(
    update="all", epochs=0.2, batch_size=64, sequence_length=4, validate_every=100
)
NUMBERS = torch.arange(12)


@pytest.fixture
def model(real_cube, recording):
    return fresh(real_cube, recording)


def fresh(scene, recording) -> NeRD:
    """Fresh weights, statistics of the recording."""
    data = recording.transitions()[:, None]
    learned = NeRD(
        scene, NO_PREDICTIONS, network_config("mlp-4x64"), data_stats(scene, data)
    )
    cover(learned, data)
    return learned


def tuner(model, recording, **changes) -> FineTuner:
    config = replace(QUICK, **changes)
    return FineTuner(model, recording, NUMBERS[2:], NUMBERS[:2], config, quiet=True)


def weights(model) -> dict[str, torch.Tensor]:
    return {k: v.clone() for k, v in model.state_dict().items()}


@pytest.mark.parametrize(
    "name", slow_but(["cartpole"], ["cube_real", "cartpole", "double_pendulum"])
)
def test_it_learns_from_a_log_of_any_robot(name, recording, generator):
    """Real tosses; a driven robot; one over a ground that varies."""
    scene = load_scene(name)
    log = recording
    if name != "cube_real":
        log = simulated(scene, generator, trajectories=12)
    config = replace(QUICK, epochs=6, batch_size=32, sequence_length=6, states=7)
    some = NUMBERS[:4]
    run = FineTuner(fresh(scene, log), log, some, some, config, quiet=True)
    run.run()
    best = min(run.curve, key=score)
    assert score(best) < 0.8 * score(run.curve[0])
    errors = 2 if name == "cube_real" else scene.model.nq
    assert len(best) == 3 + errors  # beside epoch, seconds and loss


def test_physics_is_fitted_without_gradients(real_cube, recording):
    step = start_model(real_cube)
    run = tuner(step, recording, update=None, evaluations=2)
    run.run()
    epochs = [point["epoch"] for point in run.curve]
    assert run.update == "physics"
    assert epochs == sorted(set(epochs)) and epochs[-1] < 4.1
    lowest = min(run.curve, key=score)
    found = run.errors(run.checks)["base_position"].mean()
    assert found == pytest.approx(lowest["position_m"])


def test_only_an_analytic_step_has_physics_to_fit(model, recording):
    with pytest.raises(SettingError, match="analytic step"):
        tuner(model, recording, update="physics")


def test_trajectories_that_are_too_short_are_refused(model, recording):
    with pytest.raises(ValueError, match="at least 2000 states, got none"):
        tuner(model, recording, states=2000)


def test_statistics_are_frozen_and_the_given_model_is_left_alone(model, recording):
    before = weights(model)
    after = weights(tuner(model, recording).run())
    assert all(torch.equal(before[k], v) for k, v in weights(model).items())
    frozen = [k for k in before if k.startswith("normalize")]
    assert frozen and all(torch.equal(before[k], after[k]) for k in frozen)


@pytest.mark.parametrize("update", ["all", "head"])
def test_only_what_was_asked_for_changes(model, recording, update, generator):
    with torch.no_grad():
        for weight in model.network.parameters():
            weight += 0.01 * torch.randn(weight.shape, generator=generator)
    run = tuner(model, recording, update=update)
    run._step(run.starts[:64], 4)
    for name, old in model.network.named_parameters():
        change = dict(run.model.network.named_parameters())[name] - old
        assert bool(change.any()) == (update == "all" or "head" in name)


def test_it_stops_where_validation_stands_still_at_full_length(model, recording):
    run = tuner(model, recording, epochs=1.0, validate_every=1, patience=2, lr=0.0)
    run.run()
    short = run.config.short_history_fraction * run.updates_per_epoch
    done = run.curve[-1]["epoch"] * run.updates_per_epoch
    assert done == pytest.approx(int(short) + 2) and done < run.updates_per_epoch


def test_no_epoch_leaves_the_model_as_it_is(model, recording):
    tuned = tuner(model, recording, epochs=0.0)
    before, after = weights(model), weights(tuned.run())
    assert all(torch.equal(before[k], after[k]) for k in before)
    assert [point["epoch"] for point in tuned.curve] == [0.0]


def test_runs_of_one_seed_are_the_same(model, recording):
    first, second = (weights(tuner(model, recording).run()) for _ in range(2))
    assert all(torch.equal(first[k], second[k]) for k in first)


@pytest.mark.parametrize("name", ["cube_real", "ant", "cartpole"])
def test_the_loss_has_a_slope_where_nothing_is_wrong(name, generator):
    scene = load_scene(name)
    window = simulated(scene, generator, trajectories=3, states=5)
    qpos = window.qpos.clone().requires_grad_()
    error = weighted_error(scene, position_errors(scene, window.qpos, qpos))
    error.sum().backward()
    assert error.max() < 1e-6 and qpos.grad.isfinite().all()


def test_gradients_are_those_of_the_error(model, recording):
    """Against differences, along the gradient of the last layer."""
    window = recording.windows(recording.starts(4)[:8], 4)
    head = [w for n, w in model.network.named_parameters() if "head" in n][0]
    slope = torch.autograd.grad(rollout_error(model, window).sum(), head)[0]
    change, ends = 1e-2 * slope / slope.norm(), []
    for sign in (1.0, -1.0):
        with torch.no_grad():
            head += sign * change
            ends.append(float(rollout_error(model, window).sum()))
            head -= sign * change
    expected = pytest.approx((ends[0] - ends[1]) / 2.0, rel=0.05)
    assert float((slope * change).sum()) == expected


def test_convergence_is_the_first_point_near_the_best():
    errors = (1.0, 0.5, 0.21, 0.2, 0.3)
    curve = [
        {"epoch": i, "seconds": 10 * i, "position_m": 0.0, "orientation_rad": e}
        for i, e in enumerate(errors)
    ]
    found = converged(curve)
    assert found["converged_epoch"] == 2 and found["validation_orientation_rad"] == 0.2


@pytest.mark.parametrize(
    "changes",
    [
        {"update": "some"},
        {"batch_size": 0},
        {"states": 1},
        {"lr": -1.0},
        {"short_history_fraction": 1.5},
    ],
)
def test_settings_out_of_range_are_refused(changes):
    with pytest.raises(SettingError, match="expected"):
        replace(QUICK, **changes)
