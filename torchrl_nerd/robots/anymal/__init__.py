"""ANYmal C of the NeRD paper."""
