"""Training of flows without data: losses, points, the trainer, and the command that rebuilds the shipped flows."""
