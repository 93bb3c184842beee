"""Double pendulum of the NeRD paper, over planes."""
