"""Errors over recorded tosses: zero for the truth, and intervals that cover."""

import math

import torch
from tensordict import TensorDict

from torchrl_nerd.analytic.free_body import FreeBodyPenaltyStep
from torchrl_nerd.dynamics import MujocoDynamics
from torchrl_nerd.evaluation.parameter_fit import CENTRE
from torchrl_nerd.evaluation.system_identification import (
    PUBLISHED,
    SUBSTEPS,
    cube_with,
)
from torchrl_nerd.evaluation.toss_error import (
    no_motion,
    paired_interval,
    path_errors,
    resampled_means,
    summarize_both,
    toss_errors,
)


class Replay:
    """Dynamics that know the recording: the row after the one that they are given."""

    def __init__(self, scene, tosses):
        self.scene, self.tosses = scene, tosses

    def reset(self, state, rows=None):
        pass

    def step(self, state, joint_torque, terrain=None):
        apart = torch.cdist(state["qpos"], self.tosses.qpos)
        after = apart.argmin(1) + 1
        values = {"qpos": self.tosses.qpos[after], "qvel": self.tosses.qvel[after]}
        return TensorDict(values, state.batch_size)


def test_the_recording_itself_has_no_error(real_cube, tosses, generator):
    starts = tosses.starts(80)
    pick = starts[torch.randint(len(starts), (3,), generator=generator)]
    distance, angle = toss_errors(Replay(real_cube, tosses), tosses, pick)
    assert distance.shape == angle.shape == (3, 79)
    assert distance.max() == 0.0 and angle.max() < 1e-7


def test_errors_are_metres_and_radians(tosses):
    qpos = tosses.qpos[:5]
    half = math.sin(0.05)
    turn = torch.tensor([math.cos(0.05), half, 0.0, 0.0]).double()
    from torchrl_nerd.geometry.rotations import quat_multiply

    moved = torch.cat((qpos[:, :3] + 0.03, quat_multiply(qpos[:, 3:], turn)), 1)
    distance, angle = path_errors(moved, qpos)
    torch.testing.assert_close(distance, torch.full_like(distance, 0.03 * 3**0.5))
    torch.testing.assert_close(angle, torch.full_like(angle, 0.1), atol=1e-6, rtol=0)


def test_figures_agree_with_their_definitions(tosses):
    starts = tosses.starts(80)
    errors = no_motion(tosses, starts)
    for error, figures in zip(
        errors, summarize_both(errors, tosses, starts).values(), strict=True
    ):
        first = torch.isin(starts, tosses.offsets)
        assert math.isclose(figures.mean, error.mean(), rel_tol=1e-6)
        assert math.isclose(figures.final, error[:, -1].mean(), rel_tol=1e-6)
        assert math.isclose(figures.first, error[first].mean(), rel_tol=1e-6)
        assert figures.median <= figures.p95 and 0 < figures.interval < figures.mean


def test_intervals_come_from_tosses_not_from_windows(generator):
    """Of a hundred alike windows per toss only the tosses' number counts."""
    means = torch.randn(40, generator=generator).double()
    toss = torch.arange(40).repeat_interleave(100)
    drawn = resampled_means(means.repeat_interleave(100), toss, draws=4000)
    expected = means.std(correction=0) / 40**0.5
    assert 0.9 < drawn.std() / expected < 1.1
    low, high = paired_interval(means[toss, None], means[toss, None] + 1.0, toss)
    assert math.isclose(low, -1.0) and math.isclose(high, -1.0)


def test_a_cube_of_other_parameters_has_them(real_cube):
    other = {**PUBLISHED, "size": 0.04, "friction": 0.5, "inertia": 0.001}
    model = cube_with(real_cube, other).model
    assert abs(model.geom_size[1] - 0.04).max() < 1e-12
    assert model.geom_friction[1, 0] == 0.5 and model.body_inertia[1, 0] == 0.001
    assert real_cube.model.geom_size[1, 0] == 0.0524  # left as it was
    assert not model.body_ipos[1].any()
    assert (
        -model.geom_solref[1, 0] / model.body_invweight0[1, 0] - PUBLISHED["stiffness"]
        < 1e-6 * PUBLISHED["stiffness"]
    )


def test_mujocos_centre_of_mass_falls_freely(real_cube, generator):
    """As the cheap simulator's does, in flight, up to the error of MuJoCo's substeps."""
    centre = 0.01 * torch.randn(3, generator=generator).double()
    values = dict(zip(CENTRE, centre.tolist(), strict=True))
    truth = MujocoDynamics(cube_with(real_cube, {**PUBLISHED, **values}), num_threads=1)
    step = FreeBodyPenaltyStep(real_cube, substeps=SUBSTEPS)
    step.set_values(values)
    state = real_cube.sample_initial(8, generator)[0]
    real_cube.place_on_terrain(state, torch.ones(8, dtype=torch.float64))
    start = TensorDict(state, [8])
    truth.reset(start)
    expected = truth.step(start, start["qpos"][:, :0])
    qpos, qvel, _ = step(start["qpos"], start["qvel"])
    moved = (expected["qpos"] - start["qpos"]).abs().max()
    assert (qpos - expected["qpos"]).abs().max() < 1e-3 * moved
    changed = (expected["qvel"] - start["qvel"])[:, :3].abs().max()
    assert (qvel - expected["qvel"])[:, :3].abs().max() < 0.02 * changed
