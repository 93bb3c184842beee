"""Parameters are found again in tosses that were made with them."""

import pytest
import torch

from torchrl_nerd.analytic.free_body import PARAMETERS, FreeBodyPenaltyStep
from torchrl_nerd.data.cube_tosses import Tosses
from torchrl_nerd.evaluation.parameter_fit import (
    CENTRE,
    fit_flight,
    fit_parameters,
    moved,
)
from torchrl_nerd.evaluation.toss_error import path_errors

TOSSES, STATES = 12, 16


def made(scene, step, generator, height):
    """Tosses of a cube whose lowest corner starts that high, m."""
    state = scene.sample_initial(TOSSES, generator)[0]
    scene.place_on_terrain(state, torch.full((TOSSES,), height, dtype=torch.float64))
    path = [(state["qpos"], state["qvel"])]
    with torch.no_grad():
        for _ in range(STATES - 1):
            path.append(step(*path[-1])[:2])
    qpos, qvel = (torch.stack(x, 1).flatten(0, 1) for x in zip(*path, strict=True))
    return Tosses(qpos, qvel, STATES * torch.arange(TOSSES + 1))


def test_flight_tells_gravity_and_the_centre_of_mass(real_cube, generator):
    step = FreeBodyPenaltyStep(real_cube)
    drawn = 0.01 * torch.randn(3, generator=generator).double()
    truth = {"gravity": 9.7, **dict(zip(CENTRE, drawn.tolist(), strict=True))}
    step.set_values(truth)
    tosses = made(real_cube, step, generator, height=1.0)
    for every in (1, 3):
        found = fit_flight(real_cube, tosses, every)
        assert found == pytest.approx(truth, abs=1e-5, rel=1e-4)


def test_tosses_without_flight_tell_nothing(real_cube, generator):
    tosses = made(real_cube, FreeBodyPenaltyStep(real_cube), generator, height=-0.01)
    assert fit_flight(real_cube, tosses) == {}


def test_a_fit_lowers_the_error(real_cube, generator):
    step = FreeBodyPenaltyStep(real_cube, substeps=2)
    tosses = made(real_cube, step, generator, height=0.0)
    truth, rows = step.values(), tosses.starts(STATES)

    def errors_of(values, rows):
        step.set_values(values)
        window = tosses.windows(rows, STATES)
        qpos, qvel, path = window["qpos"][:, 0], window["qvel"][:, 0], []
        with torch.no_grad():
            for _ in range(STATES - 1):
                qpos, qvel, _ = step(qpos, qvel)
                path.append(qpos)
        return path_errors(torch.stack(path, 1), window["qpos"][:, 1:])

    names = ("friction", "gravity")
    wrong = {**truth, "gravity": 1.02 * truth["gravity"], "friction": 0.2}
    *_, found = fit_parameters(errors_of, wrong, names, rows, evaluations=25)
    before, after = (errors_of(x, rows)[0].mean() for x in (wrong, found))
    assert after < 0.2 * before
    assert {k: found[k] for k in PARAMETERS if k not in names} == {
        k: truth[k] for k in PARAMETERS if k not in names
    }


def test_parameters_move_by_their_own_units(rng):
    values = {"friction": 0.2, "centre_z": 0.0}
    after = moved(values, ("friction", "centre_z"), rng.uniform(0.1, 1.0, 2))
    assert after["friction"] > 0.2 and 0.0 < after["centre_z"] < 0.005
