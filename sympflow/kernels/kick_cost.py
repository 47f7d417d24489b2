"""What a kick of a symbolic system costs, without compiling it."""

from __future__ import annotations

from sympflow.kernels.kick_shapes import shapes
from sympflow.kernels.kicks import _scheduled
from sympflow.symbolic import SymbolicHamiltonian

__all__ = ["kick_cycles"]


def kick_cycles(symbols: SymbolicHamiltonian, level: int) -> float:
    """Cycles of a kick and the drift before it in a single trajectory, as its terms are first written down.

    That is not the fastest way to write them, for which the compiler looks much longer (`sympflow.kernels.kicks`); but
    kicks of one system with more or fewer terms compare alike.

    Parameters
    ----------
    symbols : SymbolicHamiltonian
    level : int
        0 for the force alone, 1 with a force gradient, 2 with a curvature term too.

    Raises
    ------
    ValueError
        If a function in H has no counterpart in compiled code.
    """
    shape = next(iter(shapes(symbols, level + 1)))
    return min(_scheduled(symbols, shape, "kick_", common).cycles for common in (True, False))
