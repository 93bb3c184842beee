"""Learned and true motion side by side, as a film or in MuJoCo's viewer."""
