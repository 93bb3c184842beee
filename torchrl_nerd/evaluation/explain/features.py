"""The compact token by kind: where each kind lies in it, why it is there, what it adds.

What a kind adds is counted, not argued: the rank of the Jacobian of the token with
respect to state, torques and ground, with the kind and without it. A kind of rank 0 says
nothing that the kinds before it do not say already.
"""

from dataclasses import dataclass

import torch
from tensordict import TensorDict
from torch import Tensor
from torch.autograd.functional import jacobian

from torchrl_nerd.geometry.manifold import integrate_pos
from torchrl_nerd.keys import (
    CONTACT_DEPTH,
    CONTACT_DISTANCE,
    CONTACT_FORCE,
    CONTACT_NORMAL,
    CONTACT_VELOCITY,
    JOINT_TORQUE,
    QPOS,
    QVEL,
    ROBOT_TORQUE,
    TERRAIN,
)
from torchrl_nerd.modules.scene_tokens import SceneTokens
from torchrl_nerd.scenes import Scene

LINEAR, ANGULAR = "base linear velocity", "base angular velocity"
GRAVITY, ANGLE, POSITION = "gravity", "joint angle", "joint position"
BALL, SPEED = "ball orientation", "joint velocity"
GAPS, GATED = "gaps to limits", "velocity near limits"
TORQUE, DISTANCE, NORMAL = "joint torque", "contact distance", "contact normal"
VELOCITY, DEPTH = "contact velocity", "contact depth"
PRESSED, FORCE = "torque of limits", "force of contacts"

WHY = {
    LINEAR: "floating base: what drag and friction act on",
    ANGULAR: "floating base: turns its axes",
    GRAVITY: "floating base: how it is tilted",
    ANGLE: "hinge without limits: sine, cosine",
    POSITION: "slide, or hinge with limits",
    BALL: "ball joint: two columns of its rotation matrix",
    SPEED: "the other half of the state",
    GAPS: "limited joint; zero far from its limits",
    GATED: "ignored by the free dynamics, but damped at a limit",
    TORQUE: "actuated joint",
    DISTANCE: "point the ground can reach; zero beyond the margin",
    NORMAL: "ground varies, or tilts under a floating base",
    VELOCITY: "along and across the normal: decides an impact",
    DEPTH: "penetration in the coming step, a threshold",
    PRESSED: "spring of a limited joint, in the coming step",
    FORCE: "springs of all points on each dof, in the coming step",
}

# Kinds in the order in which they are asked what they add: helpers come last.
ORDER = (
    *(LINEAR, ANGULAR, GRAVITY, ANGLE, POSITION, BALL, SPEED, TORQUE),
    *(DISTANCE, NORMAL, GAPS, GATED, VELOCITY, DEPTH, PRESSED, FORCE),
)
RANK_TOLERANCE = 1e-7  # of the largest singular value of a matrix of unit rows


@dataclass(frozen=True)
class Kind:
    """One kind of feature in the token.

    | field | meaning |
    |---|---|
    | ``name`` | such as ``contact distance`` |
    | ``width`` | numbers in the token |
    | ``adds`` | directions of state, torque and ground seen by no kind before it, |
    | | at the state where they are most |
    | ``why`` | in short |
    """

    name: str
    width: int
    adds: int
    why: str

    @property
    def is_derived(self) -> bool:
        """True where it is a function of the kinds before it."""
        return self.adds == 0


def token_slices(tokens: SceneTokens) -> dict[str, slice]:
    """Where each kind lies in the token; kinds that the scene lacks are left out.

    Raises:
        ValueError: the kinds do not fill the token.
    """
    joints, contact = tokens.robot.joints, tokens.contact.sizes
    base = 3 * tokens.robot.base.is_floating
    widths = {
        **{LINEAR: base, ANGULAR: base, GRAVITY: base},
        **{ANGLE: 2 * len(joints.angles), POSITION: len(joints.positions)},
        **{BALL: 6 * len(joints.balls), SPEED: len(joints.velocities)},
        **{GAPS: 2 * len(joints.limited), GATED: len(joints.gated)},
        PRESSED: len(joints.pressed),
        TORQUE: tokens.robot.sizes.get(ROBOT_TORQUE, 0),
        DISTANCE: contact.get(CONTACT_DISTANCE, 0),
        VELOCITY: contact.get(CONTACT_VELOCITY, 0),
        DEPTH: contact.get(CONTACT_DEPTH, 0),
        FORCE: contact.get(CONTACT_FORCE, 0),
        NORMAL: contact.get(CONTACT_NORMAL, 0),
    }
    slices, start = {}, 0
    for name, width in widths.items():
        if width:
            slices[name] = slice(start, start + width)
        start += width
    if start != tokens.size:
        raise ValueError(f"expected kinds of {tokens.size} numbers in all, got {start}")
    return slices


def feature_kinds(scene: Scene, states: TensorDict) -> tuple[Kind, ...]:
    """Every kind of the token, in `ORDER`, and what it adds at the best of ``states``.

    Args:
        scene: the robot.
        states: ``[rows]`` of ``qpos``, ``qvel``, (``terrain``) and
            ``("next", "joint_torque")``, some of them near limits and ground.
    """
    tokens = SceneTokens(scene)
    slices = token_slices(tokens)
    gradients = _gradients(scene, tokens, states)
    kinds, known, before = [], gradients[:, :0], 0
    for name in (name for name in ORDER if name in slices):
        part = gradients[:, slices[name]]
        known = torch.cat((known, part), 1)
        rank = _ranks(known)
        gained = rank - before
        kinds.append(Kind(name, part.shape[1], int(gained.max()), WHY[name]))
        before = rank
    return tuple(kinds)


def _gradients(scene: Scene, tokens: SceneTokens, states: TensorDict) -> Tensor:
    """Jacobians ``(rows, F, directions)`` of the token."""
    torque, ground = states[JOINT_TORQUE], states.get(TERRAIN, None)
    sizes = [scene.layout.nv, scene.layout.nv, torque.shape[-1]]
    sizes.append(0 if ground is None else ground.shape[-1])

    def summed(change: Tensor) -> Tensor:
        turn, speed, push, shift = change.split(sizes, -1)
        qpos = integrate_pos(scene.layout, states[QPOS], turn)
        terrain = None if ground is None else ground + shift
        return tokens(qpos, states[QVEL] + speed, torque + push, terrain).sum(0)

    # each row of the sum depends on its own row of the change only
    zero = torch.zeros(len(states), sum(sizes), dtype=torch.float64)
    found = jacobian(summed, zero, vectorize=True)
    assert isinstance(found, Tensor)
    return found.transpose(0, 1)


def _ranks(matrices: Tensor) -> Tensor:
    """Rank of each of ``(rows, m, n)``, rows of the matrices scaled to unit length."""
    length = torch.linalg.vector_norm(matrices, dim=-1, keepdim=True)
    unit = matrices / torch.where(length > 1e-12, length, torch.ones_like(length))
    return torch.linalg.matrix_rank(unit, rtol=RANK_TOLERANCE)
