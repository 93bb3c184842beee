"""The compact token holds the paper's input, but for what is named as lost."""

import pytest
import torch
from helpers import every_scene, random_quats

from torchrl_nerd.evaluation.explain.paper_input import (
    DISTANCES,
    JOINT_POSITION,
    JOINT_VELOCITY,
    PaperInput,
)
from torchrl_nerd.evaluation.explain.rebuild import (
    lost_entries,
    quat_from_matrix,
    rebuild,
    rebuild_errors,
)
from torchrl_nerd.evaluation.explain.states import draw_states
from torchrl_nerd.geometry.rotations import matrix_from_quat
from torchrl_nerd.keys import JOINT_TORQUE, QPOS, QVEL, TERRAIN
from torchrl_nerd.modules.scene_tokens import SceneTokens

ROWS = 200


@every_scene
def test_all_that_is_not_lost_is_rebuilt(scene, generator):
    pieces = rebuild_errors(scene, draw_states(scene, ROWS, generator))
    paper = PaperInput(scene)
    assert {piece.name: piece.width for piece in pieces} == paper.sizes
    assert all(piece.error < 1e-9 for piece in pieces), pieces


@every_scene
def test_only_ignored_coordinates_and_still_points_are_lost(scene):
    lost = lost_entries(scene, PaperInput(scene))
    assert len(lost[JOINT_POSITION]) == len(scene.symmetries.positions)
    assert len(lost[JOINT_VELOCITY]) == len(scene.symmetries.velocities)
    still = scene.contacts.stands_for.count(-1)
    assert len(lost.get(DISTANCES, [])) in (0, still)


@every_scene
def test_what_is_rebuilt_comes_from_the_token(scene, generator):
    states, paper = draw_states(scene, ROWS, generator), PaperInput(scene)
    inputs = states[QPOS], states[QVEL], states[JOINT_TORQUE], states.get(TERRAIN, None)
    token = SceneTokens(scene)(*inputs)
    found, others = (rebuild(scene, paper, x) for x in (token, token.flip(0)))
    for name, value in found.items():
        assert torch.equal(value.flip(0), others[name]), name


@pytest.mark.parametrize("count", [1000])
def test_quaternions_come_back_from_matrices_up_to_sign(count, generator):
    quat = random_quats(count, generator)
    quat[: count // 2, 0] = 0.0  # half turns, where the trace tells nothing
    quat = quat / torch.linalg.vector_norm(quat, dim=-1, keepdim=True)
    found = quat_from_matrix(matrix_from_quat(quat))
    sign = (found * quat).sum(-1, keepdim=True).sign()
    torch.testing.assert_close(sign * found, quat, rtol=0.0, atol=1e-12)
