"""Data sets of true trajectories."""
