"""Energy and distances over time, and the figure that shows them."""

import pytest
import torch
from helpers import make_scene
from tensordict import TensorDict

from torchrl_nerd.dynamics import MujocoDynamics
from torchrl_nerd.evaluation.plots import plot_traces
from torchrl_nerd.evaluation.traces import compare_traces, mechanics
from torchrl_nerd.robots import load_scene, protocol_of

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


@pytest.mark.parametrize("name", ["cartpole", "double_pendulum", "ant"])
def test_equal_dynamics_have_equal_traces(name, tmp_path, seed):
    scene = load_scene(name)
    source = next(iter(protocol_of(scene).cases.values()))
    ground_truth, same = (MujocoDynamics(scene, num_threads=1) for _ in range(2))
    traces = compare_traces(source, (same, ground_truth), 6, 5, seed)
    assert all(float(error.max()) < 1e-7 for error in traces.errors.values())
    assert all(error.shape == (5, 7) for error in traces.errors.values())
    learned, true = traces.energies
    assert torch.equal(learned, true) and true.shape == (7,) and true.isfinite().all()
    assert (traces.distances is None) == (scene.terrain is None)
    assert float(traces.seconds[-1]) == pytest.approx(6 * scene.control_step)
    plot_traces(traces, ("nerd", "MuJoCo"), name, tmp_path / "traces.png")
    assert (tmp_path / "traces.png").read_bytes()[:4] == b"\x89PNG"


def test_unconstrained_motion_keeps_its_energy(seed):
    """Cartpole without torque and friction, but for what the steps' size costs."""
    scene = load_scene("cartpole")
    assert scene.model.dof_damping.max() == 0.0
    source = next(iter(protocol_of(scene).cases.values()))
    ground_truth = MujocoDynamics(scene, num_threads=1)
    kept = compare_traces(source, (ground_truth, ground_truth), 20, 4, seed).energies[1]
    assert float(kept.max() - kept.min()) < 0.02 * float(kept.abs().max() + 25.0)
