"""The paper's input against MuJoCo, and its widths against the released networks'."""

from itertools import product

import mujoco
import numpy as np
import pytest
import torch
from ablations import paper_input as paper
from helpers import HANDMADE, random_transitions

from torchrl_nerd.geometry.manifold import FREE
from torchrl_nerd.keys import JOINT_TORQUE, QPOS, QVEL, TERRAIN
from torchrl_nerd.robots import SCENES, load_scene

ROWS = 40
PLAIN = [*map(load_scene, SCENES), HANDMADE["floater"], HANDMADE["arm"]]
each_robot = pytest.mark.parametrize("scene", PLAIN, ids=lambda scene: scene.name)
"""Robots alone: the paper has no props."""
CORNERS = np.array(list(product((-1.0, 1.0), repeat=3)))


def shape_points(model, data):
    """World points and radii of every colliding shape of the robot."""
    points, radii = [], []
    for geom in range(model.ngeom):
        touches = model.geom_contype[geom] or model.geom_conaffinity[geom]
        root = model.body_weldid[model.geom_bodyid[geom]]
        if not model.body_dofnum[root] or not touches:
            continue
        size, kind = model.geom_size[geom], mujoco.mjtGeom(model.geom_type[geom])
        local, radius = {
            mujoco.mjtGeom.mjGEOM_SPHERE: (np.zeros((1, 3)), size[0]),
            mujoco.mjtGeom.mjGEOM_CAPSULE: (
                np.array([[0, 0, size[1]], [0, 0, -size[1]]]),
                size[0],
            ),
            mujoco.mjtGeom.mjGEOM_BOX: (CORNERS * size, 0.0),
        }[kind]
        points.append(
            data.geom_xpos[geom] + local @ data.geom_xmat[geom].reshape(3, 3).T
        )
        radii += [radius] * len(local)
    return np.concatenate(points), np.array(radii)


def seen_by_mujoco(scene, row):
    """The pieces that depend on poses, by MuJoCo's kinematics."""
    model, data = scene.model, mujoco.MjData(scene.model)
    data.qpos, data.qvel = row[QPOS].numpy(), row[QVEL].numpy()
    mujoco.mj_kinematics(model, data)
    body = scene.base.body
    axes, origin = data.xmat[body].reshape(3, 3), data.xpos[body]
    found = {paper.GRAVITY_B: -axes[2]}
    if scene.base.is_floating:
        v = scene.base.dof_address
        linear = axes.T @ data.qvel[v : v + 3]
        found[paper.BASE_VELOCITY] = np.append(data.qvel[v + 3 : v + 6], linear)
    if scene.terrain is not None:
        points, radii = shape_points(model, data)
        world = torch.zeros(3).double(), torch.eye(3).double()
        ground = row.get(TERRAIN, None)
        seen = paper.see_ground(scene, torch.from_numpy(points), ground, *world)
        distance, normal = (x.numpy() for x in seen)
        near = distance < np.maximum(4.0 * radii, 0.1)
        closest = points - distance[:, None] * normal
        found[paper.NORMALS] = (near[:, None] * (normal @ axes)).ravel()
        found[paper.CLOSEST] = (near[:, None] * ((closest - origin) @ axes)).ravel()
        found[paper.DISTANCES] = near * distance
    return found


@each_robot
def test_the_papers_input_is_what_mujoco_sees(scene, generator):
    states = random_transitions(scene, ROWS, generator)
    module, ground = paper.PaperInput(scene), states.get(TERRAIN, None)
    inputs = states[QPOS], states[QVEL], states[JOINT_TORQUE], ground
    pieces = module.pieces(*inputs)
    assert {name: x.shape[-1] for name, x in pieces.items()} == module.sizes
    assert module(*inputs).shape == (len(states), module.size)
    for i in range(len(states)):
        want = seen_by_mujoco(scene, states[i])
        for name in want.keys() & pieces.keys():
            np.testing.assert_allclose(
                pieces[name][i], want[name], 0.0, 1e-7, str(name)
            )


@each_robot
def test_torques_stand_at_their_joints_and_passive_ones_are_zero(scene, generator):
    states, module = random_transitions(scene, ROWS, generator), paper.PaperInput(scene)
    inputs = states[QPOS], states[QVEL], states[JOINT_TORQUE], states.get(TERRAIN, None)
    nothing = torch.zeros(len(states), 0).double()  # of a body without joints
    torque = module.pieces(*inputs).get(paper.TORQUES, nothing)
    by_dof = torch.zeros(len(states), scene.model.nv).double()
    by_dof[:, scene.actuated] = states[JOINT_TORQUE]
    free = [v for v in range(scene.model.nv) if is_free(scene.model, v)]
    assert torch.equal(
        torque, by_dof[:, [v for v in range(scene.model.nv) if v not in free]]
    )


def is_free(model, dof):
    return model.jnt_type[model.dof_jntid[dof]] == FREE


@pytest.mark.parametrize("name", paper.PUBLISHED)
def test_widths_are_those_of_the_released_networks(name):
    assert paper.PaperInput(load_scene(name)).size == paper.PUBLISHED[name]
