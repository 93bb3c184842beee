"""Cubes: the paper's on level ground, over slopes, and the measured one."""
