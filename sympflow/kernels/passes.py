"""Compiled tests if many states lie in a box or an energy sublevel."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from typing import TYPE_CHECKING

import numpy as np

from sympflow.compiler import NotCompiled
from sympflow.compiler.control import BOOL, INT, POINTER
from sympflow.compiler.machine import address
from sympflow.compiler.program import Program
from sympflow.hamiltonian.formulas import TracedHamiltonian, recorded
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

    form, width = system.form, states.shape[-1]
    within: Callable[..., None] | None = None
    if isinstance(domain, Box):
        (low, high), within = domain.bounds, _box_function(width)
    else:
        low, high = domain.limits(slack)
        if form is not None and (domain.hamiltonian is None or domain.hamiltonian == system.hamiltonian):
            within = _sublevel_function(form)
    if within is None or states.dtype != np.float64 or len(low) != width + 2 * (not isinstance(domain, Box)):
        return False
    rows, inside = np.ascontiguousarray(states), np.zeros(1, dtype=np.int64)
    within(address(rows), rows.size // width, address(low), address(high), address(inside))
    return bool(inside[0])


@cache
def _box_function(width: int) -> Callable[..., None]:
    return _within_function(width, None)


@kept
def _sublevel_function(form: SymbolicHamiltonian | TracedHamiltonian) -> Callable[..., None] | None:
    """The test of an H; None if that cannot be recorded or is long."""
    try:
        H = recorded([form.H], (*form.q, *form.p))
    except NotCompiled:
        return None
    return None if len(H) > MOST_OPERATIONS else _within_function(2 * form.ndof, H)


def _within_function(n: int, H: Program | None) -> Callable[..., None]:
    """Compile the test of rows of n numbers, and of H and, in a plane, |L|, of (rows, n_rows, low, high, inside)."""
    code = begun("within", [POINTER, INT, POINTER, POINTER, POINTER])
    rows, n_rows, low, high, result = code.arguments
    lanes = Lanes(code, n, LANES)
    inside = code.variable(code.constant(1, BOOL))
    with code.over(groups(code, n_rows, LANES)) as group:
        x = lanes.loaded(rows, group * LANES, n_rows)
        least, most = ([code.load(bound, i) for i in range(n if H is None else n + 2)] for bound in (low, high))
        outside = [~((a <= value) & (value <= b)) for a, value, b in zip(least, x, most, strict=False)]
        if H is not None:
            (energy,) = H(*x)
            outside.append(~((least[n] < energy) & (most[n] > energy)))
        if H is not None and n == 4:
            L = abs(x[0] * x[3] - x[1] * x[2])
            outside.append(~((least[5] <= L) & (most[5] >= L)))
        any_out = outside[0]
        for each in outside[1:]:
            any_out = any_out | each
        inside.value = inside.value & ~code.any(any_out)
    code.store(code.convert("zext", inside.value, "i64"), result)
    return finished(code)
