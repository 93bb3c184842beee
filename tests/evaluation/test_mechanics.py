"""What MuJoCo computes of a state."""

import pytest
import torch
from helpers import make_scene
from tensordict import TensorDict

from torchrl_nerd.evaluation.stability.states import mechanics, robot_mass

PENDULUM = """
<mujoco><worldbody><body pos="0 0 2"><joint name="hinge" axis="0 1 0"/>
  <inertial pos="0 0 -0.7" mass="1.3" diaginertia="0.02 0.05 0.03"/></body></worldbody>
  <actuator><motor joint="hinge"/></actuator></mujoco>"""


def test_energy_of_a_pendulum_is_the_textbooks(generator):
    scene = make_scene(PENDULUM)
    angle, speed = torch.randn(2, 20, 1, dtype=torch.float64, generator=generator)
    inertia = 0.05 + 1.3 * 0.7**2
    height = 2.0 - 0.7 * angle.cos()
    expected = 0.5 * inertia * speed**2 + 1.3 * 9.81 * height
    states = TensorDict({"qpos": angle, "qvel": speed}, [20])
    assert torch.allclose(mechanics(scene, states)["energy"], expected[:, 0])


def test_energy_of_a_state_that_is_not_finite_is_nan():
    scene = make_scene(PENDULUM)
    angle = torch.tensor([[0.0], [torch.nan]], dtype=torch.float64)
    states = TensorDict({"qpos": angle, "qvel": torch.zeros_like(angle)}, [2])
    assert mechanics(scene, states)["energy"].isnan().tolist() == [False, True]


FREE = """<mujoco><option timestep="0.005"/><worldbody>{}
<geom type="plane" size="9 9 .1"/><body pos="0 0 1"><freejoint/>
<geom type="box" size=".1 .05 .05" mass="1"/><body pos=".15 0 0">
<joint name="k" axis="0 1 0" damping=".1"/>
<geom type="capsule" size=".03" fromto="0 0 0 .2 0 0" mass=".3"/></body></body>
</worldbody><actuator><motor joint="k"/></actuator></mujoco>"""
TABLE = '<body pos="4 4 .2"><geom type="box" size=".3 .3 .2"/></body>'


def test_what_does_not_fall_with_the_robot_is_no_part_of_it():
    alone, beside = (make_scene(FREE.format(x)) for x in ("", TABLE))
    assert robot_mass(alone) == robot_mass(beside) == pytest.approx(1.3)
    qpos = torch.tensor([[0.0, 0, 2, 1, 0, 0, 0, 0.3]]).double()
    qvel = torch.arange(7).double()[None]
    states = TensorDict({"qpos": qpos, "qvel": qvel}, [1])
    both = [mechanics(scene, states) for scene in (alone, beside)]
    for name in ("com", "momentum", "angular_momentum"):
        torch.testing.assert_close(both[0][name], both[1][name])
