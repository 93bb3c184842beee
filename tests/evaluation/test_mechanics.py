"""What MuJoCo computes of a state."""

import torch
from helpers import make_scene
from tensordict import TensorDict

from torchrl_nerd.evaluation.stability.states import mechanics

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
