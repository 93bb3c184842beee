"""Trajectories of third-party robots do not start inside the robot or the ground."""

from dataclasses import replace

import mujoco
import pytest
import torch

from torchrl_nerd.robots import load_scene
from torchrl_nerd.scenes import Scene
from torchrl_nerd.scenes.penetration import deepest_contacts
from torchrl_nerd.tasks import SceneTask

ROWS = 100
STRICT = 1e-3  # m
TOUCHING = (
    *(f"dm_control/{x}" for x in ("cheetah-run", "hopper-hop", "humanoid-run")),
    *(f"gymnasium/{x}-v5" for x in ("Hopper", "Humanoid", "HumanoidStandup")),
)
"""Robots whose ranges hold poses in which they stand in themselves."""
OTHERS = (
    *(f"dm_control/{x}" for x in ("acrobot-swingup", "point_mass-easy", "walker-walk")),
    *(f"gymnasium/{x}-v5" for x in ("Ant", "HalfCheetah", "Swimmer", "Walker2d")),
)

OVERLAPPING = """<mujoco><worldbody><body><joint name="a" axis="0 1 0"/>
  <geom type="capsule" fromto="0 0 0 0.3 0 0" size="0.05"/>
  <body pos="0.3 0 0"><joint name="b" axis="0 1 0" range="-2 2" limited="true"/>
    <geom type="capsule" fromto="0 0 0 0.1 0 0" size="0.05"/>
    <body pos="0.1 0 0"><joint name="c" axis="1 0 0"/>
      <geom type="capsule" fromto="0 0 0 0.3 0 0" size="0.08"/>
</body></body></body></worldbody></mujoco>"""
"""The outer links, of radii 0.05 and 0.08 m, are at most 0.1 m apart: always 3 cm deep."""


def depths(model, qpos):
    """Of the deepest contact in each state, after a full forward pass."""
    data, found = mujoco.MjData(model), []
    for place in qpos:
        data.qpos[:] = place
        mujoco.mj_forward(model, data)
        found.append(max((-contact.dist for contact in data.contact), default=0.0))
    return torch.tensor(found).clamp_min(0.0).double()


@pytest.mark.parametrize("name", TOUCHING + OTHERS)
def test_no_start_is_deeper_in_a_contact_than_a_resting_robot(name, generator):
    scene = load_scene(name)
    qpos = scene.sample_initial(ROWS, generator)[0]["qpos"]
    assert depths(scene.model, qpos).max() <= STRICT
    anywhere = replace(scene, sampling=replace(scene.sampling, penetration=None))
    qpos = anywhere.sample_initial(ROWS, generator)[0]["qpos"]
    deep = depths(scene.model, qpos)
    assert bool((deep > STRICT).any()) == (name in TOUCHING)
    torch.testing.assert_close(deepest_contacts(scene.model, qpos), deep)


def test_episodes_of_a_robot_alone_start_outside_it():
    scene = load_scene("gymnasium/Humanoid-v5")
    starts = SceneTask(scene).starts["qpos"][:ROWS]
    assert depths(scene.model, starts).max() <= STRICT


def test_the_least_deep_draw_stays_where_all_are_deep(tmp_path, generator):
    path = tmp_path / "robot.xml"
    path.write_text(OVERLAPPING)
    scene = Scene.from_mjcf(path)
    anywhere = replace(scene, sampling=replace(scene.sampling, penetration=None))
    deep, any_deep = (
        deepest_contacts(each.model, each.sample_initial(ROWS, generator)[0]["qpos"])
        for each in (scene, anywhere)
    )
    assert (deep >= 0.03 - 1e-9).all() and deep.max() < any_deep.median()
    state, _ = Scene.from_mjcf(path, penetration=1.0).sample_initial(
        ROWS, generator.manual_seed(0)
    )
    same, _ = anywhere.sample_initial(ROWS, generator.manual_seed(0))
    assert torch.equal(state["qpos"], same["qpos"])


def test_bodies_whose_place_is_not_in_the_state_do_not_count():
    spec = mujoco.MjSpec.from_string(OVERLAPPING)
    ground = spec.worldbody.add_body(name="ground", mocap=True, pos=(0.0, 0.0, 9.0))
    ground.add_geom(type=mujoco.mjtGeom.mjGEOM_PLANE, size=(1.0, 1.0, 1.0))
    qpos = torch.zeros(1, 3, dtype=torch.float64)
    torch.testing.assert_close(
        deepest_contacts(spec.compile(), qpos),
        deepest_contacts(mujoco.MjModel.from_xml_string(OVERLAPPING), qpos),
    )
