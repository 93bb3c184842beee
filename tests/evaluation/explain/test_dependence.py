"""What is kept matters to MuJoCo, and what does not matter is found out."""

import pytest
import torch
from helpers import FLOATER, every_scene, make_scene

from torchrl_nerd.evaluation.explain import features as kinds
from torchrl_nerd.evaluation.explain.dependence import (
    CONTACT,
    carried,
    dependences,
    step,
)
from torchrl_nerd.evaluation.explain.features import feature_kinds, token_slices
from torchrl_nerd.evaluation.explain.states import draw_states
from torchrl_nerd.geometry.rotations import quat_exp
from torchrl_nerd.keys import JOINT_TORQUE, QPOS, QVEL, TERRAIN
from torchrl_nerd.modules.scene_tokens import SceneTokens

ROWS = 400
IN_SPACE = "\n".join(
    line for line in FLOATER.splitlines() if 'name="floor"' not in line
)


@every_scene
def test_states_are_sound_and_meet_the_ground(scene, generator):
    states = draw_states(scene, ROWS, generator)
    assert 0.9 * ROWS <= len(states) <= ROWS
    assert states[QPOS].isfinite().all() and states[QVEL].isfinite().all()
    for q, _ in scene.layout.rotations:
        norm = torch.linalg.vector_norm(states[QPOS][:, q : q + 4], dim=-1)
        torch.testing.assert_close(norm, torch.ones_like(norm))
    if scene.terrain is not None:
        gap = scene.clearances(states[QPOS], states.get(TERRAIN, None)).amin(-1)
        assert (gap < 0.0).any() and (gap > 0.0).any()


@every_scene
def test_every_kind_that_is_kept_matters(scene, generator):
    found = dependences(scene, draw_states(scene, ROWS, generator), generator)
    assert {d.kind for d in found} == set(token_slices(SceneTokens(scene)))
    assert all(d.is_used for d in found), found


def test_a_velocity_that_does_not_matter_is_found_out(generator):
    scene = make_scene(IN_SPACE, "in space")
    found = dependences(scene, draw_states(scene, ROWS, generator), generator)
    assert [d.kind for d in found if not d.is_used] == [kinds.LINEAR]


@every_scene
def test_kinds_lie_where_they_are_said_to(scene, generator):
    states, tokens = draw_states(scene, 20, generator), SceneTokens(scene)
    inputs = states[QPOS], states[QVEL], states[JOINT_TORQUE], states.get(TERRAIN, None)
    token, slices = tokens(*inputs), token_slices(tokens)
    assert sum(at.stop - at.start for at in slices.values()) == tokens.size
    speed = states[QVEL][:, tokens.robot.joints.velocities]
    assert torch.equal(token[:, slices.get(kinds.SPEED, slice(0))], speed)
    if kinds.TORQUE in slices:
        assert torch.equal(token[:, slices[kinds.TORQUE]], states[JOINT_TORQUE])
    if kinds.DISTANCE in slices:
        gap = scene.clearances(states[QPOS], states.get(TERRAIN, None))
        margin = torch.as_tensor(scene.contacts.margins - scene.contacts.radii)
        want = (gap - margin).clamp_max(0.0)
        torch.testing.assert_close(token[:, slices[kinds.DISTANCE]], want)


@every_scene
def test_helpers_are_told_from_what_is_needed(scene, generator):
    found = feature_kinds(scene, draw_states(scene, 60, generator)[:20])
    adds = {kind.name: kind.adds for kind in found}
    assert all(0 <= kind.adds <= kind.width for kind in found)
    assert adds.get(kinds.SPEED, 0) == len(SceneTokens(scene).robot.joints.velocities)
    assert adds.get(kinds.GRAVITY, 2) == 2
    assert adds.get(kinds.ANGLE, 0) == len(SceneTokens(scene).robot.joints.angles)
    assert not adds.get(kinds.VELOCITY) and not adds.get(kinds.DEPTH)


@every_scene
def test_without_contact_it_does_not_matter_where_robot_and_gravity_are(
    scene, generator
):
    states = draw_states(scene, 20, generator)[:3]
    numbers = torch.randn(3, 3, dtype=torch.float64, generator=generator)
    for row in range(3):
        state = states[row : row + 1]
        moved, after = carried(scene, state, quat_exp(numbers[0]), *numbers[1:])
        want, found = step(scene, state, CONTACT), step(moved, after, CONTACT)
        assert (found - want).abs().max() <= 1e-9 * want.abs().max()


@pytest.mark.parametrize("turn", [0.0, 1.0])
def test_a_robot_carried_to_where_it_is_steps_as_before(turn, generator):
    """About a vertical axis and with a level ground, contact included."""
    scene = make_scene(FLOATER)
    state = draw_states(scene, 20, generator)[:1]
    quat = quat_exp(torch.tensor([0.0, 0.0, turn], dtype=torch.float64))
    pivot = state[QPOS][0, :3]
    moved, after = carried(scene, state, quat, pivot, pivot)
    want, found = step(scene, state, 0), step(moved, after, 0)
    assert (found - want).abs().max() <= 1e-6 * want.abs().max()
