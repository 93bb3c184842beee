"""Everything that needs a GPU, in one prepared command: see docs/howto/gpu.md."""
