"""Isometries of a robot that commute with MuJoCo's step.

An ant turned by 90 degrees is the same ant with its legs renumbered. Candidates are put to
trial on steps of MuJoCo, in contact and beyond limits.
"""

import torch
from tensordict import TensorDictBase
from torch import Tensor

from torchrl_nerd.dynamics import MujocoDynamics
from torchrl_nerd.keys import CTRL, JOINT_TORQUE, QPOS, QVEL
from torchrl_nerd.scenes import Scene
from torchrl_nerd.scenes.contact_points import own_contacts
from torchrl_nerd.scenes.penetration import touching_bodies
from torchrl_nerd.training.contact_states import states_in_contact
from torchrl_nerd.training.isometry import Isometry
from torchrl_nerd.training.isometry_candidates import candidates

STEP_RTOL = 1e-6  # the solver's own tolerance is 1e-8
TRIALS = 128
MAX_DEPTH = 0.01  # m that the trials reach into the ground
# MuJoCo's contacts of two shapes may depend on which way up they are: of states in which
# the robot does not touch itself, before or after the step, so many are let pass
MAX_STRAYED = 1 / 16
NEAR = 0.05  # of a step's change, in the median: less than what networks are off by


def find_isometries(scene: Scene, is_near: bool = False) -> list[Isometry]:
    """The symmetry group of a robot on its ground, the identity first.

    Of a varied scene they are those that every robot has. ``is_near``: with those of a
    robot that is a little heavier on one side, and the like; see `NEAR`.

    Raises:
        ValueError: a ball joint, props, a servo on neither a joint nor a fixed tendon, or
            a ground that varies.
    """
    model, ground, servos = scene.model, scene.terrain, scene.servos
    has_hinges = model.nv == model.njnt + 5 * scene.base.is_floating  # and slides
    is_varied = ground is not None and ground.is_per_env
    is_known = servos is None or all(map(any, servos.moment))
    if not has_hinges or is_varied or not is_known:
        raise ValueError(
            "expected hinges or slides, actuators on them and one ground for "
            f"use_symmetry or symmetries, got '{scene.name}'"
        )
    identity, *others = candidates(scene, NEAR) if is_near else candidates(scene)
    trial = Trial(scene)
    holds = trial.nearly_agrees if is_near else trial.agrees
    return [identity, *filter(holds, others)]


class Trial:
    """Steps of MuJoCo on the ground and beyond limits, that an isometry commutes with."""

    def __init__(self, scene: Scene) -> None:
        self.dynamics = MujocoDynamics(scene, num_threads=1)
        self.start = states_in_contact(scene, TRIALS, MAX_DEPTH)
        self.end = self._step(self.start)
        self.has_own_contacts = bool(own_contacts(scene.model))
        touching = (_touch_themselves(scene, x) for x in (self.start, self.end))
        self.is_alone = ~torch.stack(list(touching)).any(0)  # (TRIALS,)

    def agrees(self, isometry: Isometry) -> bool:
        """Whether it commutes with the step; see `MAX_STRAYED`."""
        apart, change = self.apart(isometry)
        strays = apart > STEP_RTOL * (1.0 + change.amax())  # (TRIALS,)
        if not self.has_own_contacts:
            return not strays.any()
        return bool(strays[self.is_alone].double().mean() <= MAX_STRAYED)

    def nearly_agrees(self, isometry: Isometry) -> bool:
        """Whether it commutes with the step but for a few percent; see `NEAR`."""
        apart, change = self.apart(isometry)
        return bool((apart <= NEAR * change).double().mean() > 0.5)

    def apart(self, isometry: Isometry) -> tuple[Tensor, Tensor]:
        """How far the copy of a step is from the step of the copy, and the change.

        Both ``(TRIALS,)``, the largest of all dofs.
        """
        start, expected = isometry(self.start), isometry.qvel(self.end[QVEL])
        change = (expected - start[QVEL]).abs().amax(1)
        return (expected - self._step(start)[QVEL]).abs().amax(1), change

    def _step(self, start: TensorDictBase) -> TensorDictBase:
        self.dynamics.reset(start)
        return self.dynamics.step(
            start, start[JOINT_TORQUE], None, start.get(CTRL, None)
        )


def _touch_themselves(scene: Scene, state: TensorDictBase) -> Tensor:
    """Whether two of the robot's own bodies touch, ``(n,)``."""
    pairs = touching_bodies(scene.model, state[QPOS])
    return torch.tensor([any(low > 0 for low, _ in some) for some in pairs])
