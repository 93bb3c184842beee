"""Numerical stability on hard cases, in true and in learned dynamics."""
