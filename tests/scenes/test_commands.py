"""Commands: torques of motors and of the paper's controllers, controls of servos."""

import pytest
import torch
from servo_helpers import arm_scene
from tensordict import TensorDict

from torchrl_nerd.evaluation.explain import explain
from torchrl_nerd.keys import CTRL, JOINT_TORQUE, QPOS, QVEL
from torchrl_nerd.robots import load_scene, make_task
from torchrl_nerd.scenes import Scene
from torchrl_nerd.scenes.commands import actuate, command_of, drive, held, idle

CART = """<mujoco><worldbody><body><joint name="x" type="slide" axis="1 0 0"/>
  <geom size="0.1"/><body><joint name="pole" axis="0 1 0"/>
  <geom type="capsule" fromto="0 0 0 0 0 0.5" size="0.05"/></body></body></worldbody>
  <actuator>{}</actuator></mujoco>"""


def states(scene, generator):
    state, _ = scene.sample_initial(5, generator)
    return state[QPOS], state[QVEL]


@pytest.mark.parametrize("name", ["cartpole", "gymnasium/Ant-v5"])
def test_a_command_of_motors_is_a_torque(name, generator):
    scene = load_scene(name)
    here = states(scene, generator)
    command = torch.rand(5, len(scene.actuated), generator=generator).double()
    torque, ctrl = drive(scene, command, *here)
    assert (
        torque is command and ctrl is None and held(scene, command) == (command, None)
    )
    assert not idle(scene, 5).any() and idle(scene, 5).shape == command.shape
    data = TensorDict({JOINT_TORQUE: command, CTRL: command[:, :0]}, [5])
    assert torch.equal(command_of(scene, data), command)


def test_a_command_of_servos_is_their_control(tmp_path, generator):
    scene = arm_scene(tmp_path, ctrl=((-1.0, 0.0), (1.0, 0.5)))
    here = states(scene, generator)
    command = torch.rand(5, 2, generator=generator).double()
    torque, ctrl = drive(scene, command, *here)
    assert torch.equal(ctrl, command) and held(scene, command) == (None, command)
    assert torch.equal(torque, scene.servos.torque(command, *here))
    assert torch.equal(idle(scene, 1), torch.tensor([[0.0, 0.25]]).double())
    data = TensorDict({JOINT_TORQUE: torque, CTRL: command}, [5])
    assert torch.equal(command_of(scene, data), command)
    low, high = (scene.controller.ctrl(x * torch.ones(2)) for x in (-1.0, 1.0))
    assert torch.equal(low, -high) and (high == 2.0).all()


@pytest.mark.parametrize("task", ["cartpole/swingup", "franka/reach", "anymal/forward"])
def test_controllers_of_the_paper_give_no_control(task, generator):
    controller, scene = make_task(task).controller, make_task(task).scene
    action = torch.rand(5, controller.num_actions, generator=generator).double()
    here = states(scene, generator)
    torque, ctrl = actuate(controller, action, *here)
    assert ctrl is None and torch.equal(torque, controller(action, *here))


@pytest.mark.parametrize(
    ("actuator", "is_servo", "is_seen"),
    [
        ('<motor joint="x"/>', False, False),
        ('<velocity joint="x" kv="3"/>', True, False),
        ('<position joint="x" kp="30"/>', True, True),
    ],
)
def test_where_a_servo_is_matters_where_it_reads_it(
    actuator, is_servo, is_seen, tmp_path
):
    """On rails the position matters to a position servo alone; `explain` says so."""
    path = tmp_path / "cart.xml"
    path.write_text(CART.format(actuator))
    scene = Scene.from_mjcf(path)
    assert (scene.servos is not None) == is_servo
    assert (0 not in scene.symmetries.positions) == is_seen
    text = str(explain(scene))
    assert ("robot_ctrl" in text) == ("in every substep" in text) == is_servo
