"""Contacts foreseen along the free motion: where MuJoCo goes if nothing touches."""

import copy
from dataclasses import replace

import mujoco
import pytest
import torch
from helpers import in_ground

from torchrl_nerd.dynamics import MujocoDynamics
from torchrl_nerd.keys import CONTACT_DEPTH, JOINT_TORQUE, QPOS, QVEL, TERRAIN
from torchrl_nerd.robots import SCENES, load_scene
from torchrl_nerd.transforms import ContactFeatures

ROWS, GLANCES = 200, 5
ALL = [load_scene(name) for name in SCENES]
touching_scene = pytest.mark.parametrize(
    "scene", [s for s in ALL if s.terrain is not None], ids=lambda s: s.name
)


def depths(scene, rows, torque):
    """Foreseen, ``(rows, points, glances)``."""
    features = ContactFeatures(scene)
    values = features.contact_features(
        rows[QPOS], rows[QVEL], rows.get(TERRAIN, None), torque
    )
    found = dict(zip(features.out_keys, values, strict=True))[CONTACT_DEPTH]
    return found.unflatten(-1, (-1, GLANCES))


def untouched(scene, rows):
    """Depths on the way that MuJoCo takes with neither contacts nor limits."""
    model = copy.copy(scene.model)
    model.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_CONSTRAINT)
    one = replace(scene, model=model, substeps=1)
    dynamics, state, found = MujocoDynamics(one), rows.select(QPOS, QVEL), []
    terrain = rows.get(TERRAIN, None)
    dynamics.reset(state)
    for _ in range(GLANCES):
        found.append(-scene.clearances(state[QPOS], terrain))
        state = dynamics.step(state, rows[JOINT_TORQUE], terrain)
    return torch.stack(found, -1).clamp_min(0.0)


@touching_scene
def test_depths_are_those_of_the_untouched_robot(scene, generator):
    """With as many substeps as glances, for points that touch from the beginning on."""
    model = copy.copy(scene.model)
    model.opt.timestep = scene.control_step / GLANCES
    scene = replace(scene, model=model, substeps=GLANCES, reference_ratio=1)
    rows = in_ground(scene, ROWS, generator)
    want, errors = untouched(scene, rows), {}
    touches = want[..., 0] > 0.0
    assert touches.any()
    for free_motion in (False, True):
        foreseeing = scene.foreseeing(scene.foresees_forces, free_motion)
        got = depths(foreseeing, rows, rows[JOINT_TORQUE])
        errors[free_motion] = (got - want).abs().amax(-1)[touches].mean()
    assert errors[True] < 0.1 * errors[False]


@touching_scene
def test_without_a_torque_the_robot_is_let_go(scene, generator):
    rows = in_ground(scene, ROWS, generator)
    scene = scene.foreseeing(True, True)
    idle = torch.zeros_like(rows[JOINT_TORQUE])
    values = [
        ContactFeatures(scene).contact_features(
            rows[QPOS], rows[QVEL], rows.get(TERRAIN, None), torque
        )
        for torque in (None, idle)
    ]
    for let_go, no_torque in zip(*values, strict=True):
        assert torch.equal(let_go, no_torque)
