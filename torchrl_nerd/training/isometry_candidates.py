"""Isometries that put a robot's joints, shapes and servos on such ones.

They are among the 48 that map the axes of the base frame to themselves, or those of the
world where the base is fixed.
"""

from collections.abc import Iterator
from itertools import permutations, product

import mujoco
import numpy as np

from torchrl_nerd.geometry.manifold import FREE, SLIDE
from torchrl_nerd.scenes import Scene
from torchrl_nerd.scenes.contact_points import collision_filter
from torchrl_nerd.scenes.controllers import ActuatorController, ctrl_range
from torchrl_nerd.training.isometry import Isometry, Permutation

PLACE_TOL = 1e-6  # m, and of a unit vector
# of a shape: what its contacts are computed with, and the radius about its center
LAW = ("condim", "priority", "friction", "solref", "solimp", "margin", "gap", "rbound")


def candidates(scene: Scene, law_rtol: float = PLACE_TOL) -> Iterator[Isometry]:
    """Isometries that put joints on joints, shapes on shapes and the ground on itself.

    Joints at one place, such as the hips of a planar walker, are mapped to themselves or to
    each other. Numbers of shapes' contacts may differ by ``law_rtol`` of themselves.
    """
    actuated, model = list(scene.actuated), scene.model
    data, is_floating = mujoco.MjData(model), scene.base.is_floating
    data.qpos[:] = 0.0
    if is_floating:  # the base at the origin, not turned
        data.qpos[3] = 1.0
    mujoco.mj_kinematics(model, data)
    # what permutes joints leaves the mean of their places
    center = np.zeros(3) if is_floating else data.xanchor.mean(0)
    shapes = Shapes(model, data, center)
    known: list[list[float]] = []
    for order, sign in product(permutations(range(3)), product((1.0, -1.0), repeat=3)):
        body = np.eye(3)[list(order)] * np.array(sign)[:, None]
        if not shapes.are_mapped(body, law_rtol):
            continue
        for is_swapped in (False, True):
            matched = _match_joints(model, data, center, body, is_swapped)
            if matched is None or not set(matched[0][actuated]) <= set(actuated):
                continue
            controls = None
            if scene.servos is not None:
                controls = _match_servos(scene, scene.servos, *matched)
                if controls is None:
                    continue
            effect = [*matched[0], *matched[1], *(body.flat if is_floating else ())]
            if effect not in known:  # of a fixed base what joints do is all
                known.append(effect)
                given = body if is_floating else None, *matched, actuated, controls
                yield Isometry(*given)


def _match_joints(
    model: mujoco.MjModel,
    data: mujoco.MjData,
    center: np.ndarray,
    body: np.ndarray,
    is_swapped: bool,
) -> Permutation | None:
    """For each dof the one it is mapped from, and the sign; None if one has none.

    Of several at one place it is the dof itself last where ``is_swapped``, else first.
    """
    sources, signs = np.arange(model.nv), np.ones(model.nv)
    scalar = [j for j in range(model.njnt) if model.jnt_type[j] != FREE]
    places = data.xanchor - center
    for joint in scalar:
        axial = 1.0 if model.jnt_type[joint] == SLIDE else np.linalg.det(body)
        anchor, axis = body @ places[joint], axial * body @ data.xaxis[joint]
        for other in sorted(scalar, key=lambda j: (j == joint) == is_swapped):
            along = float(axis @ data.xaxis[other])
            if (
                model.jnt_type[other] == model.jnt_type[joint]
                and np.linalg.norm(anchor - places[other]) < PLACE_TOL
                and abs(abs(along) - 1.0) < PLACE_TOL
            ):
                dof = model.jnt_dofadr[other]
                sources[dof], signs[dof] = model.jnt_dofadr[joint], np.sign(along)
                break
        else:
            return None
    is_permutation = len(set(sources.tolist())) == model.nv
    return (sources, signs) if is_permutation else None


def _match_servos(
    scene: Scene, servos: ActuatorController, sources: np.ndarray, signs: np.ndarray
) -> Permutation | None:
    """For each servo the one whose control it takes, and the sign; None if one has none.

    ``sources (nv,)`` and ``signs (nv,)`` are of the dofs. Whether laws commute with the
    signs is left to the trial of steps, which seldom comes to the ends of ranges.
    """
    dofs, moment = list(servos.dof_addresses), np.array(servos.moment)  # (nu, actuated)
    motors = [dofs.index(source) for source in sources[dofs]]
    copies = moment[:, motors] * signs[dofs]
    law = np.abs(np.concatenate((servos.gain, servos.bias), 1))  # (nu, 6)
    ranges = ctrl_range(scene.model), (servos.force_low, servos.force_high)
    ends = np.array(ranges).transpose(2, 0, 1)  # (nu, 2, 2)
    limits = np.array((servos.torque_low, servos.torque_high)).T  # (actuated, 2)
    of_copies = [
        _flipped(limits[m], signs[v]) for m, v in zip(motors, dofs, strict=True)
    ]
    if not np.allclose(limits, of_copies):
        return None
    taken: list[int] = []
    flips = np.ones(len(moment))
    for own in range(len(moment)):
        for other in set(range(len(moment))) - set(taken):
            sign = np.sign(moment[own] @ copies[other])
            if (
                np.allclose(moment[own], sign * copies[other])
                and np.allclose(law[own], law[other])
                and np.allclose(ends[own], _flipped(ends[other], sign))
            ):
                flips[len(taken)] = sign
                taken.append(other)
                break
        else:
            return None
    return np.array(taken), flips


def _flipped(ends: np.ndarray, sign: float) -> np.ndarray:
    """Lower and upper ends ``(..., 2)`` of what changes its sign, where it does."""
    return ends if sign > 0.0 else -ends[..., ::-1]


class Shapes:
    """Shapes of a robot that touch something, at the place of its joints in ``data``."""

    def __init__(
        self, model: mujoco.MjModel, data: mujoco.MjData, center: np.ndarray
    ) -> None:
        touches = collision_filter(model)
        is_own = model.body_weldid[model.geom_bodyid] > 0
        own = np.flatnonzero(is_own & touches.any(1))
        laws = [getattr(model, f"geom_{name}").reshape(model.ngeom, -1) for name in LAW]
        self.laws = np.concatenate([model.geom_type[:, None], *laws], 1)[own]
        self.places = data.geom_xpos[own] - center
        self.mutual = touches[np.ix_(own, own)]
        self.ground = np.asarray(touches[own][:, ~is_own].any(1))

    def are_mapped(self, body: np.ndarray, law_rtol: float) -> bool:
        """Whether they lie on such shapes, which touch the same.

        How they are turned, and what they weigh, is left to the trial of steps.
        """
        onto: list[int] = []
        for place, law in zip(self.places @ body.T, self.laws, strict=True):
            near = np.abs(self.places - place).max(1) < PLACE_TOL
            alike = np.isclose(self.laws, law, rtol=law_rtol).all(1)
            free = [i for i in np.flatnonzero(near & alike) if i not in onto]
            if not free:
                return False
            onto.append(int(free[0]))
        is_same = np.array_equal(self.mutual, self.mutual[np.ix_(onto, onto)])
        return is_same and np.array_equal(self.ground, self.ground[onto])
