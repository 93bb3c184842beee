"""Figures that compare learned with true dynamics, alone and under a policy."""
