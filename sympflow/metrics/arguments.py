"""The check that the metrics make of their argument."""

from __future__ import annotations

from sympflow.solution import Solution


def check_solution(sol: object, name: str = "sol") -> None:
    """Raise a TypeError unless `sol` is a Solution."""
    if not isinstance(sol, Solution):
        raise TypeError(f"`{name}` must be a Solution; got {type(sol).__name__}. Pass what solve() returns.")
