"""What a scene's network sees, what the paper's saw, and proofs that nothing is missing."""
