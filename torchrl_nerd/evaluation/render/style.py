"""Colours and measures that every picture shares."""

from math import floor, log10

from torchrl_nerd.evaluation.render.camera import Camera

PAPER = (1.0, 1.0, 1.0)
GHOST = (0.55, 0.55, 0.55, 0.35)
GROUND = (0.8, 0.85, 0.8, 1.0)
BONE = (0.45, 0.45, 0.45, 1.0)
INK, FAINT = (30, 30, 30), (120, 120, 120)
STEPS = (1.0, 2.0, 5.0)


def grid_spacing(camera: Camera) -> float:
    """Between lines on the ground, m: 1, 2 or 5 times a power of ten."""
    least = camera.half_height / 4.0
    power = 10.0 ** floor(log10(least))
    return next(s * power for s in (*STEPS, 10.0) if s * power >= least)
