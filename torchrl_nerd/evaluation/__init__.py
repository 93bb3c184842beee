"""Metrics and plots that compare dynamics, alone and under a policy."""
