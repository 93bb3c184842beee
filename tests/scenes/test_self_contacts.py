"""Pairs of a robot's own shapes and the capsules that stand for them, against MuJoCo."""

import mujoco
import numpy as np
import pytest
import torch

from torchrl_nerd.geometry.segments import between_segments
from torchrl_nerd.robots import load_scene
from torchrl_nerd.scenes.contact_points import own_contacts
from torchrl_nerd.scenes.self_contacts import MAX_PAIRS, CapsulePairs, capsule_pairs

POSES = 60
NAMES = ("dm_control/hopper-hop", "dm_control/humanoid-run", "gymnasium/Humanoid-v5")
SHAPES = {  # a shape's size, and how far its capsule may be off, m
    "sphere": ("0.1", 1e-9),
    "capsule": ("0.05 0.2", 1e-9),
    "cylinder": ("0.05 0.2", 0.415 * 0.05),
    "box": ("0.05 0.05 0.2", 0.7321 * 0.05),
    "ellipsoid": ("0.05 0.05 0.2", 0.05),
}


def differences(model, pairs, qpos):
    """Distance of the capsules and, by MuJoCo, of the shapes, ``(poses * pairs,)``, m."""
    data, found, want = mujoco.MjData(model), [], []
    for place in qpos:
        ends = pairs.placed(data, place)
        way, *_ = between_segments(*torch.from_numpy(ends).flatten(0, 1))
        found.append(way.norm(dim=-1).numpy() - pairs.radii)
        both = ((int(a), int(b)) for a, b in pairs.geoms)
        want.append([mujoco.mj_geomDistance(model, data, *x, 10.0, None) for x in both])
    return np.concatenate(found), np.concatenate(want)


@pytest.mark.parametrize("name", NAMES)
def test_spheres_and_capsules_are_exact(name, generator):
    scene = load_scene(name)
    pairs = capsule_pairs(scene.model)
    assert 0 < len(pairs) <= MAX_PAIRS
    assert {tuple(pair) for pair in pairs.geoms.tolist()} <= set(
        own_contacts(scene.model)
    )
    qpos = scene.sample_initial(POSES, generator)[0]["qpos"]
    found, want = differences(scene.model, pairs, qpos)
    np.testing.assert_allclose(found, want, 0.0, 1e-9)


@pytest.mark.parametrize("shape", SHAPES)
def test_other_shapes_are_off_by_no_more_than_is_said(shape, generator):
    size, most = SHAPES[shape]
    model = mujoco.MjModel.from_xml_string(
        f"""<mujoco><worldbody><body><freejoint/>
        <geom type="{shape}" size="{size}" euler="20 30 40" pos="0.1 0 0"/></body>
        <body><freejoint/><geom size="0.03"/></body></worldbody></mujoco>"""
    )
    pairs = CapsulePairs.of(model, np.array([[0, 1]]))
    qpos = torch.randn(300, 14, generator=generator).double().numpy()
    qpos[:, :3], qpos[:, 7:10] = 0.05 * qpos[:, :3], 0.5 * qpos[:, 7:10]
    found, want = differences(model, pairs, qpos)
    outside = want > 0.0
    assert outside.sum() > 100
    assert np.abs(found - want)[outside].max() <= most


def test_pairs_that_never_come_near_are_left_out():
    """The tip reaches the first link only by a fold that the limits forbid."""
    xml = """<mujoco><worldbody><body><joint axis="0 1 0"/>
      <geom type="capsule" fromto="0 0 0 0.3 0 0" size="0.02"/>
      <body pos="0.3 0 0"><joint axis="0 1 0" range="-1 1"/>
        <geom type="capsule" fromto="0.1 0 0 0.3 0 0" size="0.02"/>
        <body pos="0.3 0 0"><joint axis="0 1 0" range="-{0} {0}"/>
          <geom type="capsule" fromto="0.1 0 0 0.3 0 0" size="0.02"/>
      </body></body></body></worldbody></mujoco>"""
    for limit, count in ((1, 0), (170, 1)):
        model = mujoco.MjModel.from_xml_string(xml.format(limit))
        assert len(own_contacts(model)) == 1
        assert len(capsule_pairs(model)) == count
    free = load_scene("gymnasium/Ant-v5").model
    assert len(capsule_pairs(free)) == len(own_contacts(free)) == 0
