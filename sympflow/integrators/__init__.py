"""Integrators: the contracts, the registry, and the built-in methods, one family a file."""
