"""Franka Panda: that of the NeRD paper, and the real arm under gravity."""
