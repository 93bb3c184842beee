"""Ant of the NeRD paper."""
