"""Parameters are found again in tosses that were made with them."""

import pytest
import torch

from torchrl_nerd.analytic.free_body import PARAMETERS, FreeBodyPenaltyStep
from torchrl_nerd.data.recorded import Recording
from torchrl_nerd.evaluation.position_error import position_errors
from torchrl_nerd.training.finetune import weighted_error
from torchrl_nerd.training.physics_fit import CENTRE, fit_flight, fit_parameters, moved

TOSSES, STATES = 12, 16


def made(scene, step, generator, height, is_turning=True):
    """Tosses of a cube whose lowest corner starts that high, m."""
    state = scene.sample_initial(TOSSES, generator)[0]
    state["qvel"][:, 3:] *= is_turning
    scene.place_on_terrain(state, torch.full((TOSSES,), height, dtype=torch.float64))
    path = [(state["qpos"], state["qvel"])]
    with torch.no_grad():
        for _ in range(STATES - 1):
            path.append(step(*path[-1])[:2])
    qpos, qvel = (torch.stack(x, 1).flatten(0, 1) for x in zip(*path, strict=True))
    offsets = STATES * torch.arange(TOSSES + 1)
    return Recording(qpos, qvel, qpos[:, :0], offsets, scene.control_step)


def test_flight_tells_gravity_and_the_centre_of_mass(real_cube, generator):
    step = FreeBodyPenaltyStep(real_cube)
    drawn = 0.01 * torch.randn(3, generator=generator).double()
    ground_truth = {"gravity": 9.7, **dict(zip(CENTRE, drawn.tolist(), strict=True))}
    step.set_values(ground_truth)
    tosses = made(real_cube, step, generator, height=1.0)
    assert fit_flight(real_cube, tosses) == pytest.approx(
        ground_truth, abs=1e-5, rel=1e-4
    )


def test_a_centre_that_no_turn_shows_stays_in_the_middle(real_cube, generator):
    """Drops that do not turn tell of gravity alone."""
    step = FreeBodyPenaltyStep(real_cube)
    tosses = made(real_cube, step, generator, height=1.0, is_turning=False)
    found = fit_flight(real_cube, tosses)
    assert found["gravity"] == pytest.approx(step.values()["gravity"], rel=1e-4)
    assert [found[name] for name in CENTRE] == pytest.approx([0.0] * 3, abs=1e-6)


def test_tosses_without_flight_tell_nothing(real_cube, generator):
    tosses = made(real_cube, FreeBodyPenaltyStep(real_cube), generator, height=-0.01)
    assert fit_flight(real_cube, tosses) == {}


def test_a_fit_lowers_the_error(real_cube, generator):
    step = FreeBodyPenaltyStep(real_cube, num_substeps=2)
    tosses = made(real_cube, step, generator, height=0.0)
    ground_truth, rows = step.values(), tosses.starts(STATES)

    def error_of(values, rows):
        step.set_values(values)
        window = tosses.windows(rows, STATES)
        qpos, qvel, path = window["qpos"][:, 0], window["qvel"][:, 0], []
        with torch.no_grad():
            for _ in range(STATES - 1):
                qpos, qvel, _ = step(qpos, qvel)
                path.append(qpos)
        errors = position_errors(real_cube, window["qpos"][:, 1:], torch.stack(path, 1))
        return float(weighted_error(real_cube, errors).mean())

    names = ("friction", "gravity")
    wrong = {**ground_truth, "gravity": 1.02 * ground_truth["gravity"], "friction": 0.2}
    *_, found = fit_parameters(error_of, wrong, names, rows, evaluations=25)
    before, after = (error_of(x, rows) for x in (wrong, found))
    assert after < 0.2 * before
    assert {k: found[k] for k in PARAMETERS if k not in names} == {
        k: ground_truth[k] for k in PARAMETERS if k not in names
    }


def test_parameters_move_by_their_own_units(rng):
    values = {"friction": 0.2, "centre_z": 0.0}
    after = moved(values, ("friction", "centre_z"), rng.uniform(0.1, 1.0, 2))
    assert after["friction"] > 0.2 and 0.0 < after["centre_z"] < 0.005
