"""The neural part: SympFlow, the unconstrained baseline, and their files."""
