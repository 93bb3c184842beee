"""Moving along tangents as mj_integratePos and mj_differentiatePos do."""

from math import pi

import mujoco
import numpy as np
import pytest
import torch
from helpers import every_scene, random_states, random_tree

from torchrl_nerd import load_scene
from torchrl_nerd.geometry.manifold import (
    JointLayout,
    differentiate_pos,
    integrate_pos,
)

ROWS = 60


def random_tangents(model, rows, rng):
    """Log-uniform from 1e-12 to pi / 2 in every direction: no turn reaches pi."""
    size = 0.5 * pi * 10.0 ** rng.uniform(-12, 0, size=(rows, model.nv))
    return torch.from_numpy(rng.choice([-1, 1], size=size.shape) * size)


def mujoco_integrates(model, qpos, tangent):
    moved = qpos.numpy().copy()
    for q, v in zip(moved, tangent.numpy(), strict=True):
        mujoco.mj_integratePos(model, q, v, 1.0)
    return torch.from_numpy(moved)


def mujoco_differentiates(model, start, end):
    tangent = np.empty((len(start), model.nv))
    for v, a, b in zip(tangent, start.numpy(), end.numpy(), strict=True):
        mujoco.mj_differentiatePos(model, v, 1.0, a, b)
    return torch.from_numpy(tangent)


@pytest.fixture(params=[True, False], ids=["floating", "fixed"])
def tree(request, rng):
    """A random robot."""
    return random_tree(rng, request.param)


def test_integrating_is_mujocos(tree, rng):
    layout = JointLayout.from_model(tree)
    qpos, _ = random_states(tree, ROWS, rng)
    tangent = random_tangents(tree, ROWS, rng)
    got = integrate_pos(layout, qpos, tangent)
    want = mujoco_integrates(tree, qpos, tangent)
    torch.testing.assert_close(got, want, rtol=0.0, atol=1e-14)


def test_differentiating_is_mujocos(tree, rng):
    layout = JointLayout.from_model(tree)
    start, _ = random_states(tree, ROWS, rng)
    end, _ = random_states(tree, ROWS, rng)
    got = differentiate_pos(layout, start, end)
    want = mujoco_differentiates(tree, start, end)
    torch.testing.assert_close(got, want, rtol=1e-12, atol=1e-12)


def test_each_undoes_the_other(tree, rng):
    layout = JointLayout.from_model(tree)
    qpos, _ = random_states(tree, ROWS, rng)
    tangent = random_tangents(tree, ROWS, rng)
    moved = integrate_pos(layout, qpos, tangent)
    back = differentiate_pos(layout, qpos, moved)
    torch.testing.assert_close(back, tangent, rtol=0.0, atol=1e-14)
    returned = integrate_pos(layout, moved, -tangent)
    same = differentiate_pos(layout, qpos, returned)
    assert same.abs().max() < 1e-14


def test_both_signs_of_a_quaternion_are_one_pose(rng):
    tree = random_tree(rng, is_floating=True)
    layout = JointLayout.from_model(tree)
    start, _ = random_states(tree, ROWS, rng)
    end, _ = random_states(tree, ROWS, rng)
    other = end.clone()
    for q, _ in layout.rotations:
        other[:, q : q + 4] *= -1.0
    first, second = (differentiate_pos(layout, start, x) for x in (end, other))
    assert torch.equal(first, second)


def test_leading_dimensions_are_kept(tree, rng):
    layout = JointLayout.from_model(tree)
    qpos, qvel = random_states(tree, 6, rng)
    flat = integrate_pos(layout, qpos, qvel)
    batch = integrate_pos(layout, qpos.reshape(2, 3, -1), qvel.reshape(2, 3, -1))
    assert torch.equal(batch.reshape(6, -1), flat)


@every_scene
def test_layout_covers_every_joint_once(scene, rng):
    model, layout = scene.model, scene.layout
    assert (layout.nq, layout.nv) == (model.nq, model.nv)
    positions = [q for q, _ in layout.linear]
    positions += [q + i for q, _ in layout.rotations for i in range(4)]
    velocities = [v for _, v in layout.linear]
    velocities += [v + i for _, v in layout.rotations for i in range(3)]
    assert sorted(positions) == list(range(model.nq))
    assert sorted(velocities) == list(range(model.nv))
    qpos, qvel = random_states(model, ROWS, rng)
    got = integrate_pos(layout, qpos, scene.control_step * qvel)
    want = mujoco_integrates(model, qpos, scene.control_step * qvel)
    torch.testing.assert_close(got, want, rtol=0.0, atol=1e-14)


def test_a_quaternion_keeps_its_norm_over_many_integrations(rng):
    model = random_tree(rng, is_floating=True)
    layout, (qpos, qvel) = JointLayout.from_model(model), random_states(model, 4, rng)
    for _ in range(3000):
        qpos = integrate_pos(layout, qpos, 0.01 * qvel)
    for q, _ in layout.rotations:
        norm = torch.linalg.vector_norm(qpos[:, q : q + 4], dim=-1)
        assert (norm - 1.0).abs().max() < 1e-12


def test_many_velocities_of_one_pose_by_vmap(generator):
    layout = load_scene("ant").layout
    state, _ = load_scene("ant").sample_initial(1, generator)
    start = state["qpos"][0]
    many = torch.randn(5, layout.nv, dtype=torch.float64, generator=generator)
    moved = integrate_pos(layout, start.expand(5, -1), many)
    move = torch.func.vmap(lambda v: integrate_pos(layout, start, v))
    torch.testing.assert_close(move(many), moved, rtol=0, atol=0)
    back = differentiate_pos(layout, start.expand(5, -1), moved)
    apart = torch.func.vmap(lambda q: differentiate_pos(layout, start, q))
    torch.testing.assert_close(apart(moved), back, rtol=0, atol=0)
