"""Spring-damper (penalty) forces at contacts and joint limits: the law, written once.

The law of the paper's engine, which MuJoCo's soft constraints become at small impedance,
see `scenes.penalty_law`.
"""

import torch
from torch import Tensor


def normal_force(
    stiffness: Tensor, damping: Tensor, depth: Tensor, speed: Tensor
) -> Tensor:
    """``max(k depth - d speed, 0)`` where a point is in the ground, else 0; N.

    Args:
        stiffness: k, N/m.
        damping: d, N s/m.
        depth: of the point in the ground, m.
        speed: of the point along the normal, m/s; positive leaves the ground.
    """
    force = (stiffness * depth - damping * speed).clamp_min(0.0)
    return torch.where(depth > 0.0, force, 0.0)


def friction_force(
    slip_damping: Tensor, friction: Tensor, normal: Tensor, slip_speed: Tensor
) -> Tensor:
    """``min(kf v, mu N)``: its size, N, against the direction of slip.

    Args:
        slip_damping: kf, N s/m.
        friction: Coulomb coefficient mu.
        normal: normal force N, N.
        slip_speed: v, tangential speed of the point, m/s.
    """
    return torch.minimum(slip_damping * slip_speed, friction * normal)


def limit_forces(
    stiffness: Tensor,
    damping: Tensor,
    low: Tensor,
    high: Tensor,
    position: Tensor,
    velocity: Tensor,
) -> tuple[Tensor, Tensor]:
    """``k (low - q) - d v`` below a range and ``k (high - q) - d v`` above it, else 0.

    The damper may outweigh the spring; a limit that never pulls is the first of both
    clamped to at least zero and the second to at most zero.

    Args:
        stiffness: k, N m/rad or N/m.
        damping: d, N m s/rad or N s/m.
        low: lower end of the range, rad or m.
        high: upper end.
        position: q of the joint.
        velocity: v of the joint.

    Returns:
        Torques, N m or N, of the lower and of the upper limit.
    """
    below = stiffness * (low - position) - damping * velocity
    above = stiffness * (high - position) - damping * velocity
    return (
        torch.where(position < low, below, 0.0),
        torch.where(position > high, above, 0.0),
    )
