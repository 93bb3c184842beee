"""Unit quaternions (``wxyz``) and the rotations they stand for, batched and differentiable.

Every function broadcasts over leading dimensions and keeps the input's dtype. Source:
Sola, "Quaternion kinematics for the error-state Kalman filter", sections 1 and 4
(https://arxiv.org/abs/1711.02508); the sign and order conventions are MuJoCo's.
"""

import mujoco
import numpy as np
import torch
from torch import Tensor

SMALL_ANGLE = 1e-3
"""rad; below it the series replaces the quotient, its error being under 1e-16."""


def quat_multiply(a: Tensor, b: Tensor) -> Tensor:
    """Hamilton product a b, ``(*batch, 4)``: the rotation b followed by a."""
    a, b = torch.broadcast_tensors(a, b)
    aw, av = a[..., :1], a[..., 1:]
    bw, bv = b[..., :1], b[..., 1:]
    real = aw * bw - (av * bv).sum(-1, keepdim=True)
    imaginary = aw * bv + bw * av + torch.linalg.cross(av, bv)
    return torch.cat((real, imaginary), -1)


def quat_conjugate(q: Tensor) -> Tensor:
    """Inverse of a unit quaternion, ``(*batch, 4)``."""
    return torch.cat((q[..., :1], -q[..., 1:]), -1)


def quat_normalize(q: Tensor) -> Tensor:
    """Nearest unit quaternion, ``(*batch, 4)``; a zero quaternion becomes the identity."""
    norm = torch.linalg.vector_norm(q, dim=-1, keepdim=True)
    identity = torch.zeros_like(q)
    identity[..., 0] = 1.0
    # what is no number stays so: a fault of its env
    return torch.where(norm <= 1e-15, identity, q / norm.clamp_min(1e-15))


def rotate(q: Tensor, v: Tensor) -> Tensor:
    """R(q) v: from the frame of ``q`` to its parent; ``(*batch, 4), (*batch, 3)``."""
    w, u = q[..., :1], q[..., 1:]
    u, v = torch.broadcast_tensors(u, v)
    along, square = torch.linalg.vecdot(u, v), torch.linalg.vecdot(u, u)
    turned = w * torch.linalg.cross(u, v) + along[..., None] * u - square[..., None] * v
    return v + 2.0 * turned


def rotate_inverse(q: Tensor, v: Tensor) -> Tensor:
    """R(q)^T v: from the parent into the frame of ``q``."""
    return rotate(quat_conjugate(q), v)


def quat_exp(rotation_vector: Tensor) -> Tensor:
    """Unit quaternion of a rotation vector (rad), ``(*batch, 3) -> (*batch, 4)``.

    Exact at zero and differentiable there: sin(a/2)/a is replaced by its series.
    """
    squared = (rotation_vector * rotation_vector).sum(-1, keepdim=True)
    is_small = squared < SMALL_ANGLE**2
    angle = torch.where(is_small, torch.ones_like(squared), squared).sqrt()
    half_sinc, real = (0.5 * angle).sin() / angle, (0.5 * angle).cos()
    series = 0.5 - squared / 48.0 + squared**2 / 3840.0
    half_sinc = torch.where(is_small, series, half_sinc)
    series = 1.0 - squared / 8.0 + squared**2 / 384.0
    real = torch.where(is_small, series, real)
    return torch.cat((real, half_sinc * rotation_vector), -1)


def random_tilt(u: Tensor, largest: float) -> Tensor:
    """Orientation ``(*batch, 4)`` from uniform numbers ``(*batch, 4)`` in [0, 1).

    Upright, then turned by U(-1, 1) times ``largest`` (rad) about a random axis, a
    normalised U(-1, 1)^3, as in the paper's reference code.
    """
    v = 2.0 * u - 1.0
    length = torch.linalg.vector_norm(v[..., :3], dim=-1, keepdim=True)
    return quat_exp(v[..., :3] / length.clamp_min(1e-12) * (v[..., 3:] * largest))


def quat_log(q: Tensor) -> Tensor:
    """Rotation vector (rad, length at most pi) of a unit quaternion, ``(*batch, 3)``.

    ``q`` and ``-q`` give the same vector, so the double cover never reaches a network.
    """
    q = torch.where(q[..., :1] < 0.0, -q, q)
    real, imaginary = q[..., :1], q[..., 1:]
    squared = (imaginary * imaginary).sum(-1, keepdim=True)
    is_small = squared < SMALL_ANGLE**2
    sine = torch.where(is_small, torch.ones_like(squared), squared).sqrt()
    ratio = 2.0 * torch.atan2(sine, real) / sine
    series = 2.0 + squared / 3.0 + 3.0 * squared**2 / 20.0
    return torch.where(is_small, series, ratio) * imaginary


def wrap_angle(angle: Tensor) -> Tensor:
    """The same angle in [-pi, pi), ``(*batch,)``, rad."""
    wrapped = torch.remainder(angle + torch.pi, 2.0 * torch.pi) - torch.pi
    # an angle just below the border may have been rounded up to it
    return torch.where(wrapped >= torch.pi, -torch.pi, wrapped)


def orientation_error(a: Tensor, b: Tensor) -> Tensor:
    """Geodesic angle between two unit quaternions, rad, ``(*batch,)``."""
    between = quat_multiply(quat_conjugate(a), b)
    return torch.linalg.vector_norm(quat_log(between), dim=-1)


def matrix_from_quat(q: Tensor) -> Tensor:
    """Rotation matrices ``(*batch, 3, 3)`` of unit quaternions ``(*batch, 4)``."""
    w, x, y, z = q.unbind(-1)
    rows = (
        *(1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)),
        *(2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)),
        *(2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)),
    )
    return torch.stack(rows, -1).unflatten(-1, (3, 3))  # (*batch, 9) -> (*batch, 3, 3)


def quat_matrix(quat: np.ndarray) -> np.ndarray:
    """Rotation matrix ``(3, 3)`` of one quaternion ``wxyz``."""
    matrix = np.empty(9)
    mujoco.mju_quat2Mat(matrix, quat)
    return matrix.reshape(3, 3)
