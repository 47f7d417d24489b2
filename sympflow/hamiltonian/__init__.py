"""H, its structure and its derivatives."""
