"""Compiled tests if many states lie in a box or an energy sublevel."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from typing import TYPE_CHECKING

import numpy as np

from sympflow.compiler.control import BOOL, INT, POINTER
from sympflow.compiler.machine import address
from sympflow.kernels.runs import Lanes, begun, finished, groups
from sympflow.lazy import kept

if TYPE_CHECKING:
    from sympflow.hamiltonian.domain import Box, EnergySublevel
    from sympflow.hamiltonian.symbolic import SymbolicHamiltonian
    from sympflow.hamiltonian.system import HamiltonianSystem

__all__ = ["all_within"]

LANES = 16
MOST_OPERATIONS = 2000  # of an H that is written out


def all_within(system: HamiltonianSystem, domain: Box | EnergySublevel, states: np.ndarray, slack: float) -> bool:
    """True if every one of the states (..., 2d) is in the domain, as its `contains` with this slack tells.

    A sublevel without an H is one of the system's. False says nothing where a sublevel has another H, or where the
    system cannot be compiled.
    """
    from sympflow.hamiltonian.domain import Box

    symbols, width = system.symbols, states.shape[-1]
    within: Callable[..., None] | None = None
    if isinstance(domain, Box):
        (low, high), within = domain.bounds, _box_function(width)
    else:
        low, high = domain.limits(slack)
        if symbols is not None and (domain.hamiltonian is None or domain.hamiltonian == system.hamiltonian):
            within = _sublevel_function(symbols)
    if within is None or states.dtype != np.float64 or len(low) != width + 2 * (not isinstance(domain, Box)):
        return False
    rows, inside = np.ascontiguousarray(states), np.zeros(1, dtype=np.int64)
    within(address(rows), rows.size // width, address(low), address(high), address(inside))
    return bool(inside[0])


@cache
def _box_function(width: int) -> Callable[..., None]:
    return _within_function(width, None)


@kept
def _sublevel_function(symbols: SymbolicHamiltonian) -> Callable[..., None] | None:
    """The test of an H; None if that cannot be recorded or is long."""
    import sympy as sp

    from sympflow.hamiltonian.recorded import can_be_recorded

    if not can_be_recorded(symbols.H) or sp.count_ops(symbols.H) > MOST_OPERATIONS:
        return None
    return _within_function(2 * symbols.ndof, symbols)


def _within_function(n: int, symbols: SymbolicHamiltonian | None) -> Callable[..., None]:
    """Compile the test of rows of n numbers, and of H and, in a plane, |L|, of (rows, n_rows, low, high, inside)."""
    code = begun("within", [POINTER, INT, POINTER, POINTER, POINTER])
    rows, n_rows, low, high, result = code.arguments
    lanes = Lanes(code, n, LANES)
    inside = code.variable(code.constant(1, BOOL))
    with code.over(groups(code, n_rows, LANES)) as group:
        x = lanes.loaded(rows, group * LANES, n_rows)
        least, most = ([code.load(bound, i) for i in range(n if symbols is None else n + 2)] for bound in (low, high))
        outside = [~((a <= value) & (value <= b)) for a, value, b in zip(least, x, most, strict=False)]
        if symbols is not None:
            from sympflow.hamiltonian.formulas import evaluator

            H = evaluator(dict(zip(symbols.q + symbols.p, x, strict=True)))(symbols.H)
            outside.append(~((least[n] < H) & (most[n] > H)))
        if symbols is not None and n == 4:
            L = abs(x[0] * x[3] - x[1] * x[2])
            outside.append(~((least[5] <= L) & (most[5] >= L)))
        any_out = outside[0]
        for each in outside[1:]:
            any_out = any_out | each
        inside.value = inside.value & ~code.any(any_out)
    code.store(code.convert("zext", inside.value, "i64"), result)
    return finished(code)
