"""The cheap simulator step obeys the physics that it stands for."""

import math
from dataclasses import replace

import pytest
import torch
from helpers import make_scene
from tensordict import TensorDict

from torchrl_nerd import load_scene
from torchrl_nerd.analytic.free_body import PARAMETERS, FreeBodyPenaltyStep
from torchrl_nerd.dynamics import MujocoDynamics
from torchrl_nerd.geometry.rotations import quat_multiply, rotate
from torchrl_nerd.scenes.penalty_law import set_penalty_contact

ROWS = 32


def falling(scene, generator, height=0.0):
    """Random states whose lowest corner is that high, m."""
    state = scene.sample_initial(ROWS, generator)[0]
    gap = torch.full((ROWS,), height, dtype=torch.float64)
    scene.place_on_terrain(state, gap)
    return state["qpos"], state["qvel"]


def test_flight_is_mujocos(real_cube, generator):
    qpos, qvel = falling(real_cube, generator, height=1.0)
    step = FreeBodyPenaltyStep(real_cube, real_cube.substeps)
    state = TensorDict(qpos=qpos, qvel=qvel, batch_size=[ROWS])
    ground_truth = MujocoDynamics(real_cube, num_threads=1)
    ground_truth.reset(state)
    expected = ground_truth.step(state, qpos[:, :0])
    found_qpos, found_qvel, defect = step(qpos, qvel)
    torch.testing.assert_close(found_qpos[:, :3], expected["qpos"][:, :3])
    torch.testing.assert_close(found_qvel, expected["qvel"])
    # one turns by half angles, the other by their sine and cosine
    assert (found_qpos[:, 3:] - expected["qpos"][:, 3:]).abs().max() < 1e-6
    assert not defect.any()


def test_where_it_is_and_faces_does_not_matter(real_cube, generator):
    step = FreeBodyPenaltyStep(real_cube)
    qpos, qvel = falling(real_cube, generator, height=-0.001)
    angle, x, y = torch.randn(3, generator=generator).double()
    turn = torch.stack(((0.5 * angle).cos(), *angle.new_zeros(2), (0.5 * angle).sin()))
    turn = turn.expand(ROWS, 4)
    shift = torch.stack((x, y, x.new_zeros(())))

    def moved(qpos, qvel):
        position = rotate(turn, qpos[:, :3]) + shift
        quat = quat_multiply(turn, qpos[:, 3:])
        linear = rotate(turn, qvel[:, :3])
        return torch.cat((position, quat), 1), torch.cat((linear, qvel[:, 3:]), 1)

    for a, b in zip(
        step(*moved(qpos, qvel))[:2], moved(*step(qpos, qvel)[:2]), strict=True
    ):
        torch.testing.assert_close(a, b)


def test_rows_are_worlds_of_their_own(real_cube, generator):
    step = FreeBodyPenaltyStep(real_cube)
    qpos, qvel = falling(real_cube, generator)
    together = step(qpos, qvel)
    alone = step(qpos[:1], qvel[:1])
    for a, b in zip(alone, together, strict=True):
        torch.testing.assert_close(a, b[:1])
    broken = qpos.clone()
    broken[0] = float("nan")
    after = step(broken, qvel)
    assert after[0][0].isnan().any() and after[0][1:].isfinite().all()


@pytest.mark.parametrize("harder", [1.0, 100.0])
def test_it_comes_to_rest_on_the_ground_at_any_stiffness(real_cube, generator, harder):
    step = FreeBodyPenaltyStep(real_cube)
    values = step.values()
    stiffness, damping = harder * values["stiffness"], harder * values["damping"]
    step.set_values({**values, "stiffness": stiffness, "damping": damping})
    qpos, qvel = falling(real_cube, generator, height=0.02)
    with torch.no_grad():
        for number in range(700):
            qpos, qvel, _ = step(qpos, qvel)
            if number % 50 == 0 and qvel.abs().max() < 0.05:
                break
        for _ in range(20):  # and stays there
            qpos, qvel, _ = step(qpos, qvel)
    assert qvel.abs().max() < 0.05
    lowest = real_cube.clearances(qpos).amin(-1)
    # a quarter of the weight on each of four springs, and what damping adds to it
    weight = 0.25 * step.mass * values["gravity"]
    assert lowest.max() < 0.0 and lowest.min() > -2.0 * weight / values["stiffness"]


def test_a_centre_of_mass_falls_freely(real_cube, generator):
    """In flight it draws a parabola, whatever the frame does."""
    step = FreeBodyPenaltyStep(real_cube)
    centre = 0.01 * torch.randn(3, generator=generator).double()
    step.set_values(
        dict(zip(("centre_x", "centre_y", "centre_z"), centre.tolist(), strict=True))
    )
    qpos, qvel = falling(real_cube, generator, height=1.0)

    def place(qpos):
        return qpos[:, :3] + rotate(qpos[:, 3:], centre.expand(ROWS, 3))

    seen = [place(qpos)]
    for _ in range(4):
        qpos, qvel, _ = step(qpos, qvel)
        seen.append(place(qpos))
    bend = torch.stack(seen).diff(dim=0).diff(dim=0)
    fall = torch.tensor((0.0, 0.0, -step.values()["gravity"])).double()
    expected = (fall * real_cube.control_step**2).expand_as(bend)
    torch.testing.assert_close(bend, expected, atol=1e-9, rtol=1e-6)


def test_friction_fades_under_load(real_cube, generator):
    """A cube that is pressed into the ground loses less speed."""
    step = FreeBodyPenaltyStep(real_cube)
    qpos, qvel = falling(real_cube, generator, height=-0.002)
    qvel = qvel.clone()
    qvel[:, :2] += 1.0
    lost = []
    for fading in (0.0, 0.01):
        step.set_values({"fading": fading})
        after = step(qpos, qvel)[1]
        lost.append((qvel - after)[:, :2].norm(dim=-1).mean())
    assert 0.0 < lost[1] < lost[0]


def test_parameters_are_taken_over(real_cube, generator):
    step = FreeBodyPenaltyStep(real_cube)
    factors = torch.rand(len(PARAMETERS), generator=generator).double() + 0.5
    wanted = {
        key: (value or 0.001) * factor
        for (key, value), factor in zip(
            step.values().items(), factors.tolist(), strict=True
        )
    }
    step.set_values(wanted)
    assert step.values() == pytest.approx(wanted)
    before = step.raw.clone()
    step.set_values({"size": 1.01})
    assert (step.raw != before).sum() == 1  # the others stay, to the bit


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"frction": 0.2}, "expected parameters of gravity, .*, got 'frction'"),
        ({"friction": -1.0}, "expected a finite friction above 0, got -1"),
        ({"centre_x": math.inf}, "expected a finite centre_x, got inf"),
    ],
)
def test_parameters_that_are_none_are_refused(real_cube, values, message):
    step = FreeBodyPenaltyStep(real_cube)
    with pytest.raises(ValueError, match=message):
        step.set_values(values)
    assert step.raw.isfinite().all()


def test_gradients_are_those_of_the_motion(real_cube, generator):
    step = FreeBodyPenaltyStep(real_cube, num_substeps=2)
    qpos, qvel = falling(real_cube, generator, height=-0.002)

    def end(raw):
        parameters = {"raw": raw}
        return torch.func.functional_call(step, parameters, (qpos, qvel))[1].sum()

    raw = 0.1 * torch.randn(len(step.raw), generator=generator).double()
    gradient = torch.func.grad(end)(raw)
    change = 1e-6 * torch.randn(len(step.raw), generator=generator).double()
    slope = (end(raw + change) - end(raw - change)) / 2.0
    torch.testing.assert_close(slope, gradient @ change, rtol=1e-3, atol=1e-9)


def test_it_has_a_substep_at_least(real_cube):
    with pytest.raises(ValueError, match="num_substeps, a whole number .* got 0"):
        FreeBodyPenaltyStep(real_cube, 0)


def test_other_robots_and_contacts_are_refused(real_cube):
    with pytest.raises(ValueError, match="single free body"):
        FreeBodyPenaltyStep(load_scene("cartpole"))
    model = real_cube.model.__copy__()
    model.geom_solref[:] = (0.02, 1.0)
    with pytest.raises(ValueError, match="contacts that are springs and dampers"):
        FreeBodyPenaltyStep(replace(real_cube, model=model))


TOSSED = """<mujoco><option cone="{cone}" timestep="0.001" gravity="{gravity}"/>
  <worldbody><geom type="plane" size="1 1 1" {plane}/><body pos="0 0 1">
  <joint type="free" damping="{damping}"/><geom type="{shape}" {pose} mass="1"/></body>
  </worldbody></mujoco>"""
BOX = {
    "gravity": "0 0 -9.81",
    "plane": "",
    "damping": "0",
    "cone": "elliptic",
    "shape": "box",
    "pose": 'size="0.1 0.2 0.1"',
}


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"plane": 'pos="0 0 -0.3"'}, "another ground"),
        ({"plane": 'euler="20 0 0"'}, "another ground"),
        ({"shape": "sphere"}, "round shapes"),
        ({"pose": 'size="0.1 0.2 0.1" pos="0.1 0 0"'}, "axes of inertia"),
        ({"pose": 'size="0.1 0.2 0.1" euler="30 0 0"'}, "axes of inertia"),
        ({"gravity": "1 0 -9.81"}, "gravity to the side"),
        ({"damping": "0.1"}, "damping"),
        ({"cone": "pyramidal"}, "pyramidal friction cones"),
    ],
)
def test_a_free_body_with_more_than_it_knows_is_refused(changes, said):
    def step(**parts):
        scene = make_scene(TOSSED.format(**{**BOX, **parts}))
        set_penalty_contact(scene.model, ke=1e4, kd=100.0, kf=100.0, mu=0.5)
        return FreeBodyPenaltyStep(scene)

    step()
    with pytest.raises(ValueError, match=f"expected a free body of corners.*{said}"):
        step(**changes)


def test_fitted_parameters_stay_over_another_ground(real_cube):
    step = FreeBodyPenaltyStep(real_cube)
    step.set_values({"friction": 0.3, "centre_z": 0.004})
    assert step.with_terrain(real_cube).values() == step.values()
