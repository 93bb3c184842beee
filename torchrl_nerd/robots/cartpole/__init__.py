"""Cartpole of the NeRD paper."""
