"""Training runs: the loop, their folders, their checkpoints and what they show."""
