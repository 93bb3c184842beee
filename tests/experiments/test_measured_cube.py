"""The study of the measured cube: its MuJoCo, its encoder, its simulated tosses."""

from dataclasses import replace
from pathlib import Path

import pytest
import torch
from tensordict import TensorDict

from torchrl_nerd.analytic import FreeBodyPenaltyStep
from torchrl_nerd.dynamics import MujocoDynamics
from torchrl_nerd.geometry.manifold import integrate_pos
from torchrl_nerd.training.physics_fit import CENTRE

FOLDER = Path(__file__).parents[2] / "experiments" / "measured_cube"
NUMBERS = torch.arange(12)


@pytest.fixture(autouse=True)
def importable(monkeypatch):
    monkeypatch.syspath_prepend(str(FOLDER))


def test_a_cube_of_other_parameters_has_them(real_cube):
    from mujoco_cube import PUBLISHED, cube_with

    other = {**PUBLISHED, "size": 0.04, "friction": 0.5, "inertia": 0.001}
    model = cube_with(real_cube, other).model
    assert abs(model.geom_size[1] - 0.04).max() < 1e-12
    assert model.geom_friction[1, 0] == 0.5 and model.body_inertia[1, 0] == 0.001
    assert real_cube.model.geom_size[1, 0] == 0.0524  # left as it was
    assert not model.body_ipos[1].any()
    stiffness = -model.geom_solref[1, 0] / model.body_invweight0[1, 0]
    assert stiffness == pytest.approx(PUBLISHED["stiffness"], rel=1e-6)


def test_mujocos_centre_of_mass_falls_freely(real_cube, generator):
    """As the analytic step's does, in flight, up to the error of MuJoCo's substeps."""
    from mujoco_cube import PUBLISHED, SUBSTEPS, cube_with

    centre = 0.01 * torch.randn(3, generator=generator).double()
    values = dict(zip(CENTRE, centre.tolist(), strict=True))
    ground_truth = MujocoDynamics(
        cube_with(real_cube, {**PUBLISHED, **values}), num_threads=1
    )
    step = FreeBodyPenaltyStep(real_cube, num_substeps=SUBSTEPS)
    step.set_values(values)
    state = real_cube.sample_initial(8, generator)[0]
    real_cube.place_on_terrain(state, torch.ones(8, dtype=torch.float64))
    start = TensorDict(state, [8])
    ground_truth.reset(start)
    expected = ground_truth.step(start, start["qpos"][:, :0])
    qpos, qvel, _ = step(start["qpos"], start["qvel"])
    moved = (expected["qpos"] - start["qpos"]).abs().max()
    assert (qpos - expected["qpos"]).abs().max() < 1e-3 * moved
    changed = (expected["qvel"] - start["qvel"])[:, :3].abs().max()
    assert (qvel - expected["qvel"])[:, :3].abs().max() < 0.02 * changed


@pytest.mark.parametrize("is_high", [True, False])
def test_the_encoder_knows_velocities_in_flight_and_slopes_on_ground(
    real_cube, generator, is_high
):
    from pose_encoder import PoseEncoder

    every = int(torch.randint(1, 4, (), generator=generator))
    encoder = PoseEncoder(real_cube, poses=5, every=every)
    qvel = torch.randn(8, 6, generator=generator).double()
    start = real_cube.sample_initial(8, generator)[0]["qpos"]
    start[:, 2] = 2.0 if is_high else -2.0
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


def test_poses_at_any_rate_are_enough(real_cube, recording):
    """No recorded velocity is used: NaN would reach the errors."""
    from partial_observation import Case, Fit

    poses = replace(recording, qvel=torch.full_like(recording.qvel, torch.nan))
    fit = Fit(real_cube, poses, Case(every=3, noise=1e-4, poses=2))
    rows = poses.starts(fit.encoder.span + 80)[::40]
    before = fit.errors(rows, poses)["base_position"].mean()
    fit.run(NUMBERS[2:], NUMBERS[:2], evaluations=2)
    after = fit.errors(rows, poses)["base_position"].mean()
    assert 0.0 < after < 0.05 and before.isfinite()


def test_simulated_cubes_differ(real_cube):
    from from_scratch import fresh_model, simulate_tosses

    tosses = simulate_tosses(real_cube, cubes=3, tosses=2, states=6)
    assert len(tosses) == 6 and tosses.qpos.isfinite().all()
    fall = tosses.qvel[1::6, 2] - tosses.qvel[::6, 2]  # all start in flight
    assert fall[::2].unique().numel() == 3
    assert fresh_model(real_cube, tosses, "mlp-4x64").scene is real_cube
