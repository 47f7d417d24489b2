"""Traced numbers → a small program → LLVM IR → machine code. It does not depend on Hamiltonian systems.

Read in this order: `numbers` (what arithmetic is done with), `functions` (one table of what may be done), `program`
(operations recorded, differentiated, evaluated with arrays), `arrange` (the order of operations), `control` (loops,
conditions, memory), `elementary` (exp, log, sin and their kin by arithmetic alone) and `machine` (from text to code).
"""

__all__ = ["NotCompiled", "arrays_only"]


class NotCompiled(ValueError):
    """The reason why code cannot be compiled; array operations may serve instead."""


def arrays_only(reason: str) -> NotCompiled:
    """Return the refusal of what array operations alone can do."""
    return NotCompiled(f"{reason}: use backend='array'.")
