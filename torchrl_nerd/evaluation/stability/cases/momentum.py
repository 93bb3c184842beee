"""Momentum of a free robot in the air, however its joints swing.

With gravity off it would stay. A network that knows no other gravity cannot be asked so:
what gravity adds, the same in any motion, is taken off instead.
"""

import numpy as np
from torch import Generator

from torchrl_nerd.evaluation.stability.case import Case, Figures, has_floating_base
from torchrl_nerd.evaluation.stability.flight import quiet_flight
from torchrl_nerd.evaluation.stability.measures import largest
from torchrl_nerd.evaluation.stability.world import World

LINEAR, SPIN = (
    "momentum without gravity's, share",
    "spin about the centre of mass, share",
)


def _run(world: World, generator: Generator, scale: float) -> Figures:
    scene = world.scene
    found = quiet_flight(world, generator)
    push, spin = found["momentum"], found["spin"]
    time = scene.control_step * np.arange(push.shape[1])[:, None]
    weight = scene.model.body_mass.sum() * scene.model.opt.gravity
    gained = np.linalg.norm(push - push[:, :1] - time * weight, axis=-1)
    turned = np.linalg.norm(spin - spin[:, :1], axis=-1)
    mass, extent = scene.model.body_mass.sum(), scene.model.stat.extent
    speed = 1.0  # m/s: what such a robot moves at
    return {
        LINEAR: largest(gained.mean(0) / (mass * speed)),
        SPIN: largest(turned.mean(0) / (mass * speed * extent)),
    }


CASE = Case(
    "momentum",
    "in the air only gravity acts from outside: momentum, less what gravity adds, and the "
    "spin about the centre of mass stay, however the joints swing",
    _run,
    has_floating_base,
    true_lines={LINEAR: 5e-4, SPIN: 5e-4},
    lines={LINEAR: 0.02, SPIN: 0.02},
)
