"""Speed against error: who steps a scene how fast, and how far from the truth."""
