"""The reference solver: the same scene to a model, a smaller error of integration."""

import warnings

import pytest
import torch
from dynamics_helpers import edit_card, random_drive, random_model, roll
from helpers import every_scene

from torchrl_nerd import load_scene, make_env
from torchrl_nerd.checkpoint import (
    load_checkpoint,
    make_card,
    read_checkpoint,
    save_checkpoint,
)
from torchrl_nerd.configs import NO_PREDICTIONS, DataConfig
from torchrl_nerd.data.generate import generate, load_data
from torchrl_nerd.dynamics import MujocoDynamics, NeRDDynamics
from torchrl_nerd.keys import QPOS, QVEL
from torchrl_nerd.modules.nerd import NeRD
from torchrl_nerd.modules.networks import network_config


@every_scene
def test_it_is_another_solver_of_the_same_scene(scene):
    reference = scene.reference
    assert reference.reference is reference and reference.hash != scene.hash
    assert reference.control_step == pytest.approx(scene.control_step, rel=1e-12)
    network = network_config("transformer-2x64")
    models = [NeRD(s, NO_PREDICTIONS, network) for s in (scene, reference)]
    shapes = [{key: x.shape for key, x in m.state_dict().items()} for m in models]
    assert shapes[0] == shapes[1]


@pytest.mark.parametrize("name", ["cartpole", "double_pendulum"])
def test_it_is_a_hundred_times_nearer_to_the_limit(name, generator):
    """Of ever smaller steps, to which RK4 converges with the fourth power."""
    scene = load_scene(name)
    start, torque, terrain = random_drive(scene, 8, 10, generator)
    if terrain is not None:
        terrain = terrain - torch.tensor([0.0, 0.0, 0.0, 100.0])  # deep below
    limit = scene.reference.with_substeps(8 * scene.reference.substeps)
    ends = [
        roll(MujocoDynamics(s, num_threads=1), start, torque, terrain)[QPOS][:, -1]
        for s in (scene, scene.reference, limit)
    ]
    error, least = ((end - ends[2]).abs().max() for end in ends[:2])
    assert 100 * least < error


@every_scene
def test_its_model_serves_the_scene(scene, generator, tmp_path):
    model = random_model(scene.reference, generator)
    save_checkpoint(model, tmp_path, make_card(model))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        mine = load_checkpoint(tmp_path, scene)
    assert mine.scene is scene
    check = read_checkpoint(tmp_path, scene)[1]
    assert check is not None and check.mujoco == 0.0 and check.model < 1e-5
    drive = random_drive(scene, 4, 3, generator)
    torch.testing.assert_close(
        *(roll(NeRDDynamics(m), *drive)[QVEL] for m in (model, mine)), rtol=0, atol=0
    )
    edit_card(tmp_path, reference_ratio=1)
    with pytest.warns(UserWarning, match="scene_hash is"):
        load_checkpoint(tmp_path, scene)


def test_its_model_runs_in_an_env(generator, tmp_path):
    model = random_model(load_scene("cartpole").reference, generator)
    save_checkpoint(model, tmp_path, make_card(model))
    env = make_env("cartpole/swingup", tmp_path, num_envs=2)
    assert env.rollout(3)["next", QPOS].isfinite().all()


def test_its_data_are_not_taken_for_the_scenes_own(tmp_path):
    scene, config = load_scene("cartpole"), DataConfig(trajectories=4, steps=3)
    generate(scene.reference, config, tmp_path, quiet=True)
    assert len(load_data(scene.reference, tmp_path)) == 4
    with pytest.raises(ValueError, match="are of scene 'cartpole'"):
        load_data(scene, tmp_path)
