"""Side-by-side videos of a rollout in two dynamics, drawn by `mujoco.Renderer`."""
