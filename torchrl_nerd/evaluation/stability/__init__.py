"""Numerical stability on hard cases, in MuJoCo and in any other dynamics."""
