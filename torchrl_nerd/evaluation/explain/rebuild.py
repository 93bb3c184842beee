"""Proof that the compact token loses nothing: the paper's full input, rebuilt from it.

From the token and constants of the scene alone, the state is recovered up to what the
robot cannot tell (where it stands, which way it faces, whole turns of a joint), and the
paper's input computed from that; distances and normals come from the token. What cannot
be rebuilt is named.
"""

from dataclasses import dataclass

import torch
from tensordict import TensorDict
from torch import Tensor

from torchrl_nerd.evaluation.explain.features import (
    ANGLE,
    ANGULAR,
    BALL,
    DISTANCE,
    GRAVITY,
    LINEAR,
    NORMAL,
    POSITION,
    SPEED,
    TORQUE,
    token_slices,
)
from torchrl_nerd.evaluation.explain.paper_input import (
    CLOSEST,
    DISTANCES,
    JOINT_POSITION,
    JOINT_VELOCITY,
    NORMALS,
    PaperInput,
    contact_pieces,
    see_ground,
)
from torchrl_nerd.geometry.rotations import rotate, wrap_angle
from torchrl_nerd.keys import JOINT_TORQUE, QPOS, QVEL, TERRAIN
from torchrl_nerd.modules.scene_tokens import SceneTokens
from torchrl_nerd.scenes import Scene


@dataclass(frozen=True)
class Piece:
    """One piece of the paper's input.

    | field | meaning |
    |---|---|
    | ``name``, ``width`` | as in `PaperInput` |
    | ``lost`` | how many of its numbers the compact token does not hold |
    | ``error`` | largest absolute error of the others, in the piece's unit |
    """

    name: str
    width: int
    lost: int
    error: float


def rebuild_errors(scene: Scene, states: TensorDict) -> tuple[Piece, ...]:
    """How well every piece of the paper's input follows from the compact token.

    Angles are compared modulo 2 pi, quaternions up to their sign.

    Args:
        scene: the robot.
        states: ``[rows]``, from `draw_states`.
    """
    paper, inputs = PaperInput(scene), _inputs(states)
    token = SceneTokens(scene)(*inputs)
    truth, found = paper.pieces(*inputs), rebuild(scene, paper, token)
    lost, pieces = lost_entries(scene, paper), []
    for name, width in paper.sizes.items():
        error = found[name] - truth[name]
        if name == JOINT_POSITION:
            error = _joint_errors(scene, paper, found[name], truth[name])
        is_kept = torch.ones(width, dtype=torch.bool)
        is_kept[lost.get(name, [])] = False
        worst = error[:, is_kept].abs().amax().item() if is_kept.any() else 0.0
        pieces.append(Piece(name, width, int((~is_kept).sum()), worst))
    return tuple(pieces)


def lost_entries(scene: Scene, paper: PaperInput) -> dict[str, list[int]]:
    """Indices, per piece, of what the token does not hold."""
    ignored, lost = scene.symmetries, {}
    q, v = paper.joint_qpos, paper.joint_dofs
    lost[JOINT_POSITION] = [i for i, at in enumerate(q) if at in ignored.positions]
    lost[JOINT_VELOCITY] = [i for i, at in enumerate(v) if at in ignored.velocities]
    if paper.count and not _is_ground_constant(scene):
        still = [i for i, kept in enumerate(scene.contacts.stands_for) if kept < 0]
        lost[DISTANCES] = still
        lost[NORMALS] = lost[CLOSEST] = [3 * i + k for i in still for k in range(3)]
    return lost


def rebuild(scene: Scene, paper: PaperInput, token: Tensor) -> dict[str, Tensor]:
    """The paper's pieces from raw tokens ``(rows, F)``; lost entries are arbitrary."""
    slices = token_slices(SceneTokens(scene))
    part = {name: token[:, at] for name, at in slices.items()}
    qpos, qvel = recover_state(scene, part)
    torque = part.get(TORQUE, token[:, :0])
    found = paper.pieces(qpos, qvel, torque, None)
    if paper.count and not _is_ground_constant(scene):
        distance, normal = _seen(scene, part, qpos)
        index = scene.contacts.stands_for
        points, _ = paper.kinematics(qpos, qvel)
        seen = points, distance[:, index], normal[:, index]
        found |= contact_pieces(*seen, paper.margins, *paper.frame(qpos))
    return found


def recover_state(scene: Scene, part: dict[str, Tensor]) -> tuple[Tensor, Tensor]:
    """State up to place, heading and whole turns, from parts of tokens.

    Args:
        scene: the robot.
        part: ``(rows, width)`` of each kind, see `token_slices`.

    Returns:
        ``qpos (rows, nq)`` and ``qvel (rows, nv)``.
    """
    any_part, joints = next(iter(part.values())), SceneTokens(scene).robot.joints
    rows = len(any_part)
    qpos = any_part.new_tensor(scene.model.qpos0).repeat(rows, 1)
    qvel = any_part.new_zeros(rows, scene.layout.nv)
    if ANGLE in part:
        sine, cosine = part[ANGLE].chunk(2, -1)
        qpos[:, joints.angles] = torch.atan2(sine, cosine)
    if POSITION in part:
        qpos[:, joints.positions] = part[POSITION]
    for i, q in enumerate(joints.balls):
        columns = part[BALL][:, 6 * i : 6 * i + 6].unflatten(-1, (3, 2))
        third = torch.linalg.cross(columns[..., 0], columns[..., 1])
        matrix = torch.cat((columns, third[..., None]), -1)
        qpos[:, q : q + 4] = quat_from_matrix(matrix)
    if SPEED in part:
        qvel[:, joints.velocities] = part[SPEED]
    if GRAVITY in part:
        q, v = scene.base.qpos_address, scene.base.dof_address
        down = part[GRAVITY].new_tensor(scene.gravity_direction)
        matrix = _upright(down).mT @ _upright(part[GRAVITY])
        quat = quat_from_matrix(matrix)
        qpos[:, q : q + 3], qpos[:, q + 3 : q + 7] = 0.0, quat
        qvel[:, v : v + 3] = rotate(quat, part[LINEAR])
        qvel[:, v + 3 : v + 6] = part[ANGULAR]
    return qpos, qvel


def quat_from_matrix(matrix: Tensor) -> Tensor:
    """Unit quaternions ``(*batch, 4)``, wxyz, of rotation matrices; either sign."""
    r = [[matrix[..., i, j] for j in range(3)] for i in range(3)]
    x, y, z = r[0][0], r[1][1], r[2][2]
    a, b, c = r[2][1] - r[1][2], r[0][2] - r[2][0], r[1][0] - r[0][1]
    d, e, f = r[0][1] + r[1][0], r[0][2] + r[2][0], r[1][2] + r[2][1]
    # 4 q q^T: its longest column is the most precise
    rows = (*(1 + x + y + z, a, b, c), *(a, 1 + x - y - z, d, e))
    rows = (*rows, *(b, d, 1 - x + y - z, f), *(c, e, f, 1 - x - y + z))
    outer = torch.stack(rows, -1).unflatten(-1, (4, 4))
    best = outer.diagonal(dim1=-2, dim2=-1).argmax(-1)
    column = outer.gather(-2, best[..., None, None].expand(*best.shape, 1, 4))[
        ..., 0, :
    ]
    return column / torch.linalg.vector_norm(column, dim=-1, keepdim=True)


def _inputs(states: TensorDict) -> tuple[Tensor, Tensor, Tensor, Tensor | None]:
    ground = states.get(TERRAIN, None)
    return states[QPOS], states[QVEL], states[JOINT_TORQUE], ground


def _is_ground_constant(scene: Scene) -> bool:
    """True where joint positions alone tell all about the ground."""
    is_per_row = scene.terrain is not None and scene.terrain.is_per_row
    return not scene.base.is_floating and not is_per_row


def _seen(scene: Scene, part: dict[str, Tensor], qpos: Tensor) -> tuple[Tensor, Tensor]:
    """Distance ``(rows, P)`` and normal ``(rows, P, 3)`` of the kept points."""
    distance = part[DISTANCE] + torch.as_tensor(scene.contacts.margins)
    if NORMAL in part:
        normal = part[NORMAL].unflatten(-1, (-1, 3))
        length = torch.linalg.vector_norm(normal, dim=-1, keepdim=True)
        return distance, normal / length.clamp_min(1e-300)
    # a level plane: its normal is the same everywhere and follows from gravity
    points = qpos.new_zeros(*distance.shape, 3)
    position, rotation = scene.base_pose(qpos)
    return distance, see_ground(scene, points, None, position, rotation)[1]


def _upright(up: Tensor) -> Tensor:
    """A rotation ``(*rows, 3, 3)`` that turns these unit vectors into z."""
    side = torch.eye(3).to(up)[up.abs().argmin(-1)]
    x = torch.linalg.cross(side, up)
    x = x / torch.linalg.vector_norm(x, dim=-1, keepdim=True)
    return torch.stack((x, torch.linalg.cross(up, x), up), -2)


def _joint_errors(
    scene: Scene, paper: PaperInput, found: Tensor, truth: Tensor
) -> Tensor:
    """Differences of joint positions: whole turns and signs of quaternions taken off."""
    error = found - truth
    joints = SceneTokens(scene).robot.joints
    for q in joints.angles:
        i = paper.joint_qpos.index(q)
        error[:, i] = wrap_angle(error[:, i])
    for q in joints.balls:
        i = paper.joint_qpos.index(q)
        a, b = found[:, i : i + 4], truth[:, i : i + 4]
        error[:, i : i + 4] = torch.where((a * b).sum(-1, True) < 0.0, -a - b, a - b)
    return error
