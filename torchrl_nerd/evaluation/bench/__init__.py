"""Error and speed of every way to step a scene, at equal protocol."""
