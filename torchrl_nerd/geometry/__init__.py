"""Rotations, manifolds, kinematics and surfaces, batched and differentiable."""
