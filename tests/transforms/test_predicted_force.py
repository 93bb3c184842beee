"""Predicted penalty forces: MuJoCo's own where nothing moves, or hardly."""

import copy
from dataclasses import replace

import mujoco
import numpy as np
import pytest
import torch
from helpers import HANDMADE, in_ground, make_scene

from torchrl_nerd.configs import FeatureConfig
from torchrl_nerd.geometry.rotations import rotate_inverse
from torchrl_nerd.keys import CONTACT_FORCE, QPOS, QVEL, TERRAIN
from torchrl_nerd.robots import SCENES, load_scene
from torchrl_nerd.transforms import ContactFeatures, RobotCentric

ROWS, FORCES = 60, FeatureConfig(predicted_force=True)
PENALTY = [load_scene(name) for name in SCENES]
PENALTY = [scene for scene in PENALTY if scene.terrain is not None]
penalty_scene = pytest.mark.parametrize("scene", PENALTY, ids=lambda s: s.name)


def predicted(scene, rows):
    """Forces of contacts and of limits on every dof, ``(rows, nv)``, in B_t."""
    contact, robot = ContactFeatures(scene, FORCES), RobotCentric(scene, FORCES)
    values = contact.contact_features(rows[QPOS], rows[QVEL], rows.get(TERRAIN, None))
    force = dict(zip(contact.out_keys, values, strict=True))[CONTACT_FORCE].clone()
    limited = robot.joints.predicted
    if limited:
        state = robot.state_features(rows[QPOS], rows[QVEL])
        force[:, limited] += state[:, -len(limited) :]
    return force


def mujoco_force(scene, rows):
    """What MuJoCo's constraints push every dof with, the base's part in B_t.

    Without gravity: a soft constraint gives a thousandth of it back.
    """
    model, forces = copy.copy(scene.model), []
    model.opt.gravity[:] = 0.0
    data = mujoco.MjData(model)
    for row in rows:
        mujoco.mj_resetData(model, data)
        data.qpos, data.qvel = row[QPOS].numpy(), row[QVEL].numpy()
        if scene.terrain.is_per_env:
            pose = scene.terrain.mocap_pose(row[TERRAIN]).reshape(-1, 7).numpy()
            data.mocap_pos, data.mocap_quat = pose[:, :3], pose[:, 3:]
        mujoco.mj_forward(model, data)
        forces.append(data.qfrc_constraint.copy())
    force = torch.from_numpy(np.array(forces))
    if scene.base.is_floating:
        linear = rotate_inverse(rows[QPOS][:, 3:7], force[:, :3])
        force = torch.cat((linear, force[:, 3:]), -1)
    return force


def expect_near(scene, got, want):
    """Within what MuJoCo's small impedance leaves of the law.

    A percent of the force; more where a point gives way much more easily than it does in
    the model's reference pose, as the pendulum's tip.
    """
    scale = torch.linalg.vector_norm(want, dim=-1, keepdim=True) + 30.0  # N
    off = ((got - want).abs() / scale).amax(-1)
    allowed = 0.02 if scene.base.is_floating else 0.1
    assert off.median() < allowed and off.quantile(0.9) < 5.0 * allowed
    assert (want.abs().amax(-1) > 10.0).any(), "nothing touched"


@penalty_scene
def test_at_rest_they_are_what_mujoco_pushes_with(scene, generator):
    rows = in_ground(scene, ROWS, generator)
    rows[QVEL].zero_()
    expect_near(scene, predicted(scene, rows), mujoco_force(scene, rows))


@penalty_scene
def test_a_moment_of_motion_is_damped_and_held_back_as_by_mujoco(scene, generator):
    """In a control step so short that the way along it is nothing."""
    rows = in_ground(scene, ROWS, generator)
    rows[QVEL] *= 1e-3  # slow enough for friction to hold
    model = copy.copy(scene.model)
    model.opt.timestep = 1e-9
    short = replace(scene, model=model, substeps=5)
    expect_near(scene, predicted(short, rows), mujoco_force(scene, rows))


def test_what_cannot_be_predicted_is_refused():
    several = HANDMADE["floater"]
    with pytest.raises(ValueError, match="one to a body, for the equation of motion"):
        ContactFeatures(several, FORCES)
    hard = make_scene("""<mujoco><worldbody><geom type="plane" size="0 0 1"/>
      <body pos="0 0 1"><freejoint/><geom size="0.1"/></body></worldbody></mujoco>""")
    with pytest.raises(ValueError, match="springs and dampers"):
        ContactFeatures(hard, FORCES)
