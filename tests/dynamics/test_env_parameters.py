"""A varied env moves as a MuJoCo model of its own would, one `mj_step` after the other."""

import mujoco
import numpy as np
import pytest
import torch
from dynamics_helpers import random_drive
from helpers import varied_model
from servo_helpers import ARM
from tensordict import TensorDict

from torchrl_nerd.dynamics import MujocoDynamics
from torchrl_nerd.dynamics.mujoco import engine_model
from torchrl_nerd.keys import PARAMETERS, QPOS, QVEL
from torchrl_nerd.robots import load_scene
from torchrl_nerd.scenes import Scene

ROWS, STEPS = 6, 12
PLANE = "terrain"
LINKS = {"com_y:link2": (-0.2, 0.2), "com_x:link2": (-0.2, 0.2)}
PLACE = {f"payload_{axis}:torso": (-0.3, 0.3) for axis in "xyz"}
CASES = [
    ("cartpole", {"mass:pole": (0.3, 3.0), "mass:cart": (0.5, 2.0)}),
    ("cartpole", {"mass": (0.5, 2.0)}),
    ("cartpole", {"damping:slider": (0.0, 20.0), "damping:hinge": (0.0, 1.0)}),
    ("cartpole", {"frictionloss": (0.0, 20.0)}),
    ("cartpole", {"armature:hinge": (0.0, 1.0)}),
    ("cartpole", {"motor:slider": (0.6, 1.4)}),
    ("cartpole", {"delay": (0, 3)}),
    ("cartpole", {"motor": (0.6, 1.4), "delay": (2, 2), "slope:x": (-0.3, 0.3)}),
    ("double_pendulum", LINKS),
    ("ant", {"payload:torso": (0.0, 20.0)}),
    ("ant", {"payload:torso": (0.0, 20.0), **PLACE}),
    ("ant", {"friction": (0.1, 2.0), "stiffness": (0.5, 2.0)}),
    ("ant", {"friction:front_left_foot": (0.01, 0.1)}),
    ("ant", {"slope:x": (-0.3, 0.3), "slope:y": (-0.3, 0.3)}),
    ("ant", {"motor:hip_1": (0.3, 1.0), "delay": (0, 2)}),
    ("cube", {"mass": (0.5, 2.0), "friction": (0.2, 4.0)}),
]
IDS = [f"{name}: {', '.join(ranges)}" for name, ranges in CASES]


def alone(scene: Scene, start, torques, parameters) -> np.ndarray:
    """States ``(steps, nq + nv)`` of one env, with a model of its own."""
    variation = scene.variation
    model = varied_model(variation, parameters)
    model.opt.disableflags = engine_model(scene, False).opt.disableflags
    data = mujoco.MjData(model)
    data.qpos[:], data.qvel[:] = start[QPOS], start[QVEL]
    if PLANE in start.keys():
        plane = start[PLANE].numpy()
        data.mocap_pos[0] = plane[:3] * plane[3]
        mujoco.mju_quatZ2Vec(data.mocap_quat[0], plane[:3])
    [strength] = variation.strength(parameters[None].numpy())
    [late] = variation.delay(parameters[None].numpy())
    given = torch.cat((torch.zeros(late, torques.shape[1]), torques)).numpy()
    states = []
    for torque in given[: len(torques)]:
        data.qfrc_applied[scene.actuated] = strength * torque
        mujoco.mj_step(model, data, scene.substeps)
        states.append(np.concatenate((data.qpos, data.qvel)))
    return np.array(states)


@pytest.mark.parametrize(("name", "ranges"), CASES, ids=IDS)
def test_a_row_is_a_model_of_its_own_bit_for_bit(name, ranges, generator):
    scene = load_scene(name).vary(ranges)
    start, torques, terrain = random_drive(scene, ROWS, STEPS, generator)
    start[PARAMETERS] = scene.variation.draw(ROWS, generator)
    dynamics, state, path = MujocoDynamics(scene), start, []
    dynamics.reset(state)
    for torque in torques:
        state = dynamics.step(state, torque, terrain)
        path.append(torch.cat((state[QPOS], state[QVEL]), -1))
    path = torch.stack(path, 1).numpy()
    nominal, state = MujocoDynamics(load_scene(name)), start.select(QPOS, QVEL)
    for torque in torques:
        state = nominal.step(state, torque, terrain)
    for row in range(ROWS):
        first = start[row].clone()
        if terrain is not None:
            first[PLANE] = terrain[row]
        expected = alone(scene, first, torques[:, row], first[PARAMETERS])
        # the ground's orientation is rounded otherwise, see test_mujoco.py
        atol = 0.0 if terrain is None else 1e-12 * np.abs(expected).max()
        np.testing.assert_allclose(path[row], expected, rtol=0, atol=atol)
    assert (np.abs(path[:, -1, : state[QPOS].shape[1]] - state[QPOS].numpy()) > 0).any()


def test_servos_of_a_row_are_as_strong_and_late_as_it_says(tmp_path, generator):
    """With ``ctrl`` MuJoCo's own law acts in every substep, that of the env's model."""
    ranges = {"motor:a": (0.5, 1.5), "damping": (0.1, 2.0), "delay": (0, 2)}
    path = tmp_path / "arm.xml"
    path.write_text(ARM)
    scene = Scene.from_mjcf(path).vary(ranges)
    state = TensorDict(scene.sample_initial(ROWS, generator)[0], [ROWS])
    state[PARAMETERS] = own = scene.variation.draw(ROWS, generator)
    commands = torch.rand(STEPS, ROWS, 2, generator=generator).double()
    dynamics, start, idle = MujocoDynamics(scene), state, torch.zeros(ROWS, 2).double()
    dynamics.reset(state)
    for ctrl in commands:
        state = dynamics.step(state, idle, None, ctrl)
    for row in range(ROWS):
        model = varied_model(scene.variation, own[row])
        assert model.actuator_gainprm[0, 0] == pytest.approx(4500 * float(own[row, 0]))
        data = mujoco.MjData(model)
        data.qpos[:], data.qvel[:] = start[row][QPOS], start[row][QVEL]
        late = int(own[row, 2])
        given = torch.cat((torch.zeros(late, 2), commands[:, row]))[:STEPS].numpy()
        for ctrl in given:
            data.ctrl[:] = ctrl
            mujoco.mj_step(model, data, scene.substeps)
        assert np.array_equal(state[row][QPOS], data.qpos)
        assert np.array_equal(state[row][QVEL], data.qvel)


def test_without_parameters_all_envs_are_the_scenes_own_again(generator):
    scene = load_scene("cartpole").vary({"mass:pole": (3.0, 3.0), "delay": (1, 1)})
    start, torques, _ = random_drive(scene, ROWS, STEPS, generator)
    plain = start.select(QPOS, QVEL)
    varied = plain.clone().set(
        PARAMETERS, torch.tensor([3.0, 1.0]).double().expand(ROWS, 2)
    )
    nominal = MujocoDynamics(load_scene("cartpole"))
    used = MujocoDynamics(scene)
    nominal.reset(plain)
    used.reset(plain)
    expected = nominal.step(plain, torques[0])
    moved = used.step(varied, torques[0])
    assert not torch.equal(moved[QVEL], expected[QVEL])
    used.reset(plain)
    again = used.step(plain, torques[0])
    assert torch.equal(again[QVEL], expected[QVEL])


@pytest.mark.parametrize(
    ("parameters", "words"),
    [
        ([1.0, 2.0], "expected a possible 'delay', got 2"),  # beyond the range's end
        ([1.0, 0.5], "expected a possible 'delay', got 0.5"),
        ([0.0, 1.0], "expected a possible 'mass:pole', got 0"),
        ([np.nan, 1.0], "expected a possible 'mass:pole', got nan"),
        ([np.inf, 1.0], "expected a possible 'mass:pole', got inf"),
        ([1.0], "expected parameters of shape .*2.*, got .*1"),
    ],
)
def test_parameters_of_no_robot_are_refused_and_change_nothing(
    parameters, words, generator
):
    """By a step, as by ``reset(set_state=True)``."""
    scene = load_scene("cartpole").vary({"mass:pole": (0.3, 3.0), "delay": (0, 1)})
    start, torques, _ = random_drive(scene, ROWS, STEPS, generator)
    good = start.clone().set(PARAMETERS, scene.variation.draw(ROWS, generator))
    wrong = good.clone()
    wrong[PARAMETERS] = torch.tensor(parameters).double().expand(ROWS, len(parameters))
    used, fresh = MujocoDynamics(scene), MujocoDynamics(scene)
    for dynamics in (used, fresh):
        dynamics.reset(good)
        dynamics.step(good, torques[0])
    with pytest.raises(ValueError, match=words) as refused:
        used.step(wrong, torques[1])
    assert "\n" not in str(refused.value)
    expected = fresh.step(good, torques[1])
    assert torch.equal(used.step(good, torques[1])[QVEL], expected[QVEL])
