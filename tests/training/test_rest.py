"""What a model moves at rest is its noise, and stays; whatever moves is left alone."""

import pytest
import torch
from dynamics_helpers import random_model, roll
from helpers import slow_but
from tensordict import TensorDict

from torchrl_nerd import load_scene
from torchrl_nerd.configs import NO_PREDICTIONS, FeatureConfig
from torchrl_nerd.dynamics import NeRDDynamics
from torchrl_nerd.keys import JOINT_TORQUE, NEXT_QVEL, PARAMETERS, QPOS, QVEL, TERRAIN
from torchrl_nerd.modules.nerd import NeRD
from torchrl_nerd.modules.networks import network_config
from torchrl_nerd.robots import SCENES
from torchrl_nerd.training.rest import (
    MAX_SPEED,
    MAX_STATES,
    REST_SPEED,
    find_rest,
    resting,
    slow_velocities,
)

ON_GROUND = [name for name in SCENES if load_scene(name).terrain is not None]
each_on_ground = pytest.mark.parametrize("name", ON_GROUND)


def states_at_rest(scene, generator, rows=32):
    """States that a perfect model would leave as they are."""
    start, _ = scene.sample_initial(rows, generator)
    state = TensorDict(start, [rows])
    state[QVEL] = torch.zeros_like(state[QVEL])
    state[JOINT_TORQUE] = torch.zeros(rows, len(scene.actuated), dtype=torch.float64)
    return state


def slow_at_rest(states):
    """Velocities before and after, of transitions that stay at rest."""
    return torch.zeros(len(states), 2, states[QVEL].shape[-1], dtype=torch.float64)


def sluggish_model(scene, generator, size, features=NO_PREDICTIONS):
    """Keeps every velocity but for noise of a size, in m/s and rad/s."""
    model = NeRD(scene, features, network_config("mlp-1x32")).eval()
    with torch.no_grad():
        for weight in model.network.head.parameters():
            weight.copy_(size * torch.randn(weight.shape, generator=generator))
    return model


def sluggish_and_at_rest(scene, generator):
    """Such a model of little noise, and states for it."""
    return sluggish_model(scene, generator, 1e-5), states_at_rest(scene, generator)


@pytest.mark.parametrize("name", slow_but(ON_GROUND[:2], ON_GROUND))
def test_noise_at_rest_no_longer_carries_a_robot_away(name, generator):
    model, states = sluggish_and_at_rest(load_scene(name), generator)
    assert not torch.equal(after(model, states, 50)[QPOS], states[QPOS])
    find_rest(model, states, slow_at_rest(states))
    found = model.sleep.sleep_speed.clone()
    find_rest(model, states, slow_at_rest(states))
    assert (found > 0.0).all() and torch.equal(model.sleep.sleep_speed, found)
    end = after(model, states, 50)
    assert torch.equal(end[QPOS], states[QPOS]) and not end[QVEL].any()


def test_a_model_that_is_told_the_parameters_finds_them_at_rest(generator):
    scene = load_scene("double_pendulum").vary({"mass:link1": (0.5, 2.0)})
    model = sluggish_model(scene, generator, 1e-5, FeatureConfig(parameters=True))
    states = states_at_rest(scene, generator)
    states[PARAMETERS] = scene.variation.draw(len(states), generator)
    find_rest(model, states, slow_at_rest(states))
    assert (model.sleep.sleep_speed > 0.0).all()


def test_a_robot_that_creeps_in_the_data_never_sleeps(generator):
    """Soft ground gives way under a load: what is slow there moves on."""
    model, states = sluggish_and_at_rest(load_scene("ant"), generator)
    still = slow_at_rest(states)
    find_rest(model, states, still)
    creeping = 0.5 * model.sleep.sleep_speed.expand(200 * len(still), 2, -1)
    assert (creeping.abs().amax((-2, -1)) > REST_SPEED).all()
    find_rest(model, states, torch.cat((still, creeping)))
    assert not model.sleep.sleep_speed.any() and not model.sleep.sleep_gain.any()
    find_rest(model, states, torch.cat((still, creeping[: len(still)])))
    assert model.sleep.sleep_speed.all()


def test_slow_transitions_are_slow_before_and_after(generator):
    qvel, after = torch.zeros(2, 4, 3, 5, dtype=torch.float64)
    qvel[1, 2, 0], after[2, 1, 4] = -2 * MAX_SPEED, 2 * MAX_SPEED
    data = TensorDict({QVEL: qvel, NEXT_QVEL: after}, [4, 3])
    found = slow_velocities(data)
    assert found.shape == (10, 2, 5) and found.abs().max() < MAX_SPEED


@each_on_ground
def test_what_moves_is_left_alone(name, generator):
    scene = load_scene(name)
    model, states = sluggish_and_at_rest(scene, generator)
    states[QVEL] += 2 * MAX_SPEED
    before = after(model, states, 3)
    at_rest = states_at_rest(scene, generator)
    find_rest(model, at_rest, slow_at_rest(at_rest))
    assert torch.equal(after(model, states, 3)[QPOS], before[QPOS])


@each_on_ground
def test_what_gains_more_speed_than_at_rest_is_awake(name, generator):
    model, states = sluggish_and_at_rest(load_scene(name), generator)
    find_rest(model, states, slow_at_rest(states))
    sleep, qpos, asleep = model.sleep, states[QPOS], states[QVEL]
    assert (sleep.sleep_gain < sleep.sleep_speed).all()  # one step of it, not twenty
    for share in (0.5, 2.0):
        push = torch.zeros_like(asleep)
        push[:, 0] = share * sleep.sleep_gain[0]
        assert (push < sleep.sleep_speed).all()
        is_awake = share > 1.0
        moved, speed = sleep.apply_sleep((qpos, asleep), (qpos + 1.0, push))
        assert torch.equal(speed, push if is_awake else asleep)
        assert torch.equal(moved, qpos + 1.0 if is_awake else qpos)
        moved, speed = sleep.apply_sleep((qpos, push), (qpos + 1.0, 0.5 * push))
        assert torch.equal(moved, qpos) and not speed.any()  # it was slowing down


@pytest.mark.parametrize("name", SCENES)
def test_a_model_that_does_not_rest_stays_as_it_is(name, generator):
    scene = load_scene(name)
    model = random_model(scene, generator)
    at_rest = states_at_rest(scene, generator)
    find_rest(model, at_rest, slow_at_rest(at_rest))
    assert not model.sleep.sleep_speed.any()
    few = sluggish_model(scene, generator, 1e-5)
    three = states_at_rest(scene, generator, 3)
    find_rest(few, three, slow_at_rest(three))
    assert not few.sleep.sleep_speed.any()


def test_states_at_rest_are_found(generator):
    rows, steps = 30, 40
    speed = torch.rand(rows, steps, 1, generator=generator).double() * 10.0 * REST_SPEED
    data = TensorDict(
        {QVEL: speed, ("next", QVEL): speed.roll(-1, 1)}, batch_size=[rows, steps]
    )
    found = resting(data)
    assert 0 < len(found) <= MAX_STATES
    for key in (QVEL, ("next", QVEL)):
        assert (found[key] < REST_SPEED).all()
    assert len(resting(data[:, :0])) == 0


def after(model, states, steps):
    """States after so many steps without torque."""
    dynamics, start = NeRDDynamics(model), states.select(QPOS, QVEL)
    torque = states[JOINT_TORQUE].expand(steps, -1, -1)
    return roll(dynamics, start, torque, states.get(TERRAIN, None))[:, -1]
