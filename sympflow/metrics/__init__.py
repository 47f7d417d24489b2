"""Metrics: how well a run keeps energy, volume and symplectic structure, and how near it is to the truth."""
