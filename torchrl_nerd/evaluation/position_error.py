"""Errors of poses and joint positions, by quantity and unit."""

import torch
from torch import Tensor

from torchrl_nerd.geometry.manifold import BALL, FREE, SLIDE, joint_label
from torchrl_nerd.geometry.rotations import orientation_error, wrap_angle
from torchrl_nerd.scenes import Scene
from torchrl_nerd.scenes.symmetries import periodic_hinges

Errors = dict[str, Tensor]
"""Quantity of `position_errors` -> ``(n, steps)``, m or rad."""


def position_errors(scene: Scene, ground_truth: Tensor, other: Tensor) -> Errors:
    """Error of every quantity at every step, ``(n, steps)``, from ``(n, steps, nq)``.

    A floating base gives ``base_position`` (m), ``base_orientation`` (rad) and the mean
    over ``joints`` (rad) and over ``slides`` (m); a fixed base gives one entry per joint,
    see `joint_label`. Another free body gives its position (m) and orientation (rad).
    """
    model, both = scene.model, (ground_truth, other)
    joints, slides = {}, {}
    base, bodies = {}, {}  # of free joints: the base's, and all others
    periodic = periodic_hinges(model, scene.servos is not None)
    for joint in range(model.njnt):
        q, kind = int(model.jnt_qposadr[joint]), int(model.jnt_type[joint])
        label = joint_label(model, joint)
        if kind == FREE and scene.base.is_floating and q == scene.base.qpos_address:
            base = _pose_errors("base_", q, *both)
        elif kind == FREE:
            body = model.body(model.jnt_bodyid[joint]).name
            label = model.joint(joint).name or body or label
            bodies |= _pose_errors(f"{label} ", q, *both)
        elif kind == BALL:
            joints[label] = orientation_error(*(x[..., q : q + 4] for x in both))
        else:
            error = ground_truth[..., q] - other[..., q]  # (n, steps)
            error = (wrap_angle(error) if q in periodic else error).abs()
            own = slides if kind == SLIDE and scene.base.is_floating else joints
            own[label] = error
    if scene.base.is_floating:
        groups = {"joints": joints, "slides": slides}
        joints = {
            name: torch.stack(list(own.values())).mean(0)  # (n, steps)
            for name, own in groups.items()
            if own
        }
    return base | joints | bodies


def _pose_errors(label: str, q: int, one: Tensor, other: Tensor) -> Errors:
    """Errors of the free joint at ``q`` in qpos: position, m, and orientation, rad."""
    offset = one[..., q : q + 3] - other[..., q : q + 3]
    turn = orientation_error(*(x[..., q + 3 : q + 7] for x in (one, other)))
    place = torch.linalg.vector_norm(offset, dim=-1)
    return {f"{label}position": place, f"{label}orientation": turn}


def unit_of(scene: Scene, quantity: str) -> str:
    """Unit of a quantity of `position_errors`: m or rad."""
    model = scene.model
    kinds = {joint_label(model, i): model.jnt_type[i] for i in range(model.njnt)}
    if quantity in kinds and not scene.base.is_floating:
        return "m" if kinds[quantity] == SLIDE else "rad"
    return "m" if quantity.endswith(("position", "slides")) else "rad"
