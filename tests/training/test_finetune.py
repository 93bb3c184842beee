"""Fine-tuning on a dozen real tosses: what moves, what stays, and that it helps."""

from dataclasses import replace

import pytest
import torch
from tensordict import TensorDict

from torchrl_nerd.configs import FinetuneConfig
from torchrl_nerd.dynamics import NeRDDynamics
from torchrl_nerd.evaluation.rollout_error import open_loop
from torchrl_nerd.geometry.manifold import integrate_pos
from torchrl_nerd.modules.pose_encoder import PoseEncoder
from torchrl_nerd.settings import SettingError
from torchrl_nerd.training.convergence import converged, score
from torchrl_nerd.training.finetune import FineTuner
from torchrl_nerd.training.pose_loss import pose_error, rollout
from torchrl_nerd.training.toss_models import from_scratch

QUICK = FinetuneConfig(
    update="all", epochs=0.2, batch_size=64, sequence_length=4, validate_every=100
)
NUMBERS = torch.arange(12)


@pytest.fixture
def model(real_cube, tosses):
    return from_scratch(real_cube, tosses, "residual", seed=0)


def tuner(model, tosses, **changes) -> FineTuner:
    config = replace(QUICK, **changes)
    return FineTuner(model, tosses, NUMBERS[2:], NUMBERS[:2], config, quiet=True)


def weights(model) -> dict[str, torch.Tensor]:
    return {k: v.clone() for k, v in model.state_dict().items()}


def test_it_learns_from_real_tosses(model, tosses):
    run = tuner(model, tosses, epochs=1.0, length=8, physics_lr=0.05)
    run.run()
    first, *_, last = [point for point in run.curve]
    assert last["orientation_rad"] < first["orientation_rad"]


def test_physics_is_fitted_without_gradients(model, tosses):
    run = tuner(model, tosses, update="physics", evaluations=2)
    best = run.run()
    epochs = [point["epoch"] for point in run.curve]
    assert epochs == sorted(set(epochs)) and epochs[-1] < 4.1
    lowest = min(run.curve, key=score)
    assert run.errors(run.checks)[0].mean() == pytest.approx(lowest["position_m"])
    network = model.network.state_dict()
    assert all(torch.equal(network[k], v) for k, v in best.network.state_dict().items())


def test_only_a_simulator_has_physics_to_fit(real_cube, tosses):
    with pytest.raises(SettingError, match="simulator"):
        tuner(
            from_scratch(real_cube, tosses, "mlp-4x64", seed=0),
            tosses,
            update="physics",
        )


def test_statistics_are_frozen_and_the_given_model_is_left_alone(model, tosses):
    before = weights(model)
    after = weights(tuner(model, tosses).run())
    assert all(torch.equal(before[k], v) for k, v in weights(model).items())
    frozen = [k for k in before if k.startswith("normalize")]
    assert frozen and all(torch.equal(before[k], after[k]) for k in frozen)


@pytest.mark.parametrize("update", ["all", "head", "low-rank"])
def test_only_what_was_asked_for_changes(model, tosses, update, generator):
    with torch.no_grad():
        for weight in model.network.parameters():
            weight += 0.01 * torch.randn(weight.shape, generator=generator)
    run = tuner(model, tosses, update=update, rank=2)
    run._update(run._batch(run.starts[:64], 4, generator))
    run._frozen()  # a copy: training goes on
    run._update(run._batch(run.starts[:64], 4, generator))
    after = run._frozen()
    state = TensorDict({"qpos": tosses.qpos[:9], "qvel": tosses.qvel[:9]}, [9])
    steps = [open_loop(NeRDDynamics(x.eval()), state, 1) for x in (run.model, after)]
    torch.testing.assert_close(*steps)
    for name, old in model.network.named_parameters():
        change = dict(after.network.named_parameters())[name] - old
        if update == "head":
            assert bool(change.any()) == ("head" in name)
        elif update == "low-rank":
            is_matrix = change.ndim == 2
            assert is_matrix or not change.any()
            if is_matrix:
                assert torch.linalg.matrix_rank(change, atol=1e-7) <= 2


def test_it_stops_where_validation_stands_still_at_full_length(model, tosses):
    still = {"lr": 0.0, "physics_lr": 0.0}
    run = tuner(model, tosses, epochs=1.0, validate_every=1, patience=2, **still)
    run.run()
    short = run.config.short_history_fraction * run.updates_per_epoch
    done = run.curve[-1]["epoch"] * run.updates_per_epoch
    assert done == pytest.approx(int(short) + 2) and done < run.updates_per_epoch


def test_runs_of_one_seed_are_the_same(model, tosses):
    first, second = (weights(tuner(model, tosses).run()) for _ in range(2))
    assert all(torch.equal(first[k], second[k]) for k in first)


def test_poses_at_any_rate_are_enough(model, tosses):
    poses = replace(tosses, qvel=torch.full_like(tosses.qvel, float("nan")))
    run = tuner(
        model, poses, observe="poses", every=3, poses=2, pose_noise=1e-4, length=6
    )
    best = run.run()
    assert all(weight.isfinite().all() for weight in best.parameters())
    assert run.curve[-1]["position_m"] < 0.2


@pytest.mark.parametrize("is_high", [True, False])
def test_the_encoder_knows_velocities_in_flight_and_slopes_on_ground(
    real_cube, generator, is_high
):
    every = int(torch.randint(1, 4, (), generator=generator))
    encoder = PoseEncoder(real_cube, poses=5, every=every)
    linear, angular = torch.randn(2, 8, 3, generator=generator).double()
    start = real_cube.sample_initial(8, generator)[0]["qpos"]
    start[:, 2] = 2.0 if is_high else -2.0
    qvel = torch.cat((linear, angular), 1)
    time = real_cube.control_step * every * torch.arange(5).double()
    window = torch.stack(
        [integrate_pos(real_cube.layout, start, t * qvel) for t in time], 1
    )
    gravity = torch.as_tensor(real_cube.model.opt.gravity) * is_high
    window[..., :3] += 0.5 * time[:, None] ** 2 * gravity
    qvel[:, :3] += time[-1] * gravity
    qpos, found = encoder(window)
    torch.testing.assert_close(qpos, window[:, -1])
    torch.testing.assert_close(found, qvel, atol=1e-9, rtol=0)


def test_the_loss_is_smooth_where_nothing_is_wrong(model, tosses):
    window = tosses.windows(tosses.starts(5)[:8], 5)
    start = window["qpos"][:, 0].requires_grad_()
    path = rollout(model, start, window["qvel"][:, 0], 4)
    error = pose_error(path, path.detach())
    error.sum().backward()
    assert error.max() < 1e-3 and start.grad.isfinite().all()


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
    [{"update": "some"}, {"rows": 0}, {"observe": "sound"}, {"every": 3}],
)
def test_settings_out_of_range_are_refused(changes):
    with pytest.raises(SettingError, match="expected"):
        replace(QUICK, **changes)
