"""Contacts predicted along unconstrained motion: MuJoCo's without constraints."""

import copy
from dataclasses import replace

import mujoco
import pytest
import torch
from helpers import in_ground

from torchrl_nerd.configs import NO_PREDICTIONS, FeatureConfig
from torchrl_nerd.dynamics import MujocoDynamics
from torchrl_nerd.keys import CONTACT_DEPTH, JOINT_TORQUE, QPOS, QVEL, TERRAIN
from torchrl_nerd.robots import SCENES, load_scene
from torchrl_nerd.transforms import ContactFeatures

ROWS, TIMES = 200, 5
ALL = [load_scene(name) for name in SCENES]
touching_scene = pytest.mark.parametrize(
    "scene", [s for s in ALL if s.terrain is not None], ids=lambda s: s.name
)


def depths(scene, rows, torque, config=NO_PREDICTIONS):
    """Predicted, ``(rows, points, times)``."""
    features = ContactFeatures(scene, config)
    values = features.contact_features(
        rows[QPOS], rows[QVEL], rows.get(TERRAIN, None), torque
    )
    found = dict(zip(features.out_keys, values, strict=True))[CONTACT_DEPTH]
    return found.unflatten(-1, (-1, TIMES))


def untouched(scene, rows):
    """Depths on the way that MuJoCo takes with neither contacts nor limits."""
    model = copy.copy(scene.model)
    model.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_CONSTRAINT)
    one = replace(scene, model=model, substeps=1)
    dynamics, state, found = MujocoDynamics(one), rows.select(QPOS, QVEL), []
    terrain = rows.get(TERRAIN, None)
    dynamics.reset(state)
    for _ in range(TIMES):
        found.append(-scene.clearances(state[QPOS], terrain))
        state = dynamics.step(state, rows[JOINT_TORQUE], terrain)
    return torch.stack(found, -1).clamp_min(0.0)


@touching_scene
def test_depths_are_those_of_the_untouched_robot(scene, generator):
    """With as many substeps as times, for points that touch from the beginning on."""
    model = copy.copy(scene.model)
    model.opt.timestep = scene.control_step / TIMES
    scene = replace(scene, model=model, substeps=TIMES, reference_ratio=1)
    rows = in_ground(scene, ROWS, generator)
    want, errors = untouched(scene, rows), {}
    touches = want[..., 0] > 0.0
    assert touches.any()
    for unconstrained in (False, True):
        config = FeatureConfig(unconstrained_motion=unconstrained)
        got = depths(scene, rows, rows[JOINT_TORQUE], config)
        errors[unconstrained] = (got - want).abs().amax(-1)[touches].mean()
    assert errors[True] < 0.1 * errors[False]


@touching_scene
def test_no_torque_is_zero_torque(scene, generator):
    rows = in_ground(scene, ROWS, generator)
    config = FeatureConfig(True, True)
    idle = torch.zeros_like(rows[JOINT_TORQUE])
    values = [
        ContactFeatures(scene, config).contact_features(
            rows[QPOS], rows[QVEL], rows.get(TERRAIN, None), torque
        )
        for torque in (None, idle)
    ]
    for none, zero in zip(*values, strict=True):
        assert torch.equal(none, zero)
