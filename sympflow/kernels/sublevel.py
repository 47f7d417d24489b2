"""Whether many states lie in an energy sublevel, in one compiled pass."""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache
from weakref import WeakKeyDictionary

import numpy as np
import sympy as sp

from sympflow.domain import EnergySublevel
from sympflow.kernels.codegen import printed
from sympflow.kernels.modules import OPTIONS, load_module, template
from sympflow.symbolic import SymbolicHamiltonian, printable
from sympflow.system import HamiltonianSystem

__all__ = ["all_within"]

_KERNELS: WeakKeyDictionary[SymbolicHamiltonian, Callable[..., bool] | None] = WeakKeyDictionary()


def all_within(system: HamiltonianSystem, domain: EnergySublevel, states: np.ndarray, slack: float) -> bool:
    """Whether every one of the states (N, 2d) is in the domain, as its `contains` with this slack.

    False says nothing where the system cannot be compiled, or H of the domain is not its own.
    """
    symbols = system.symbols
    if symbols is None or domain.hamiltonian != system.hamiltonian or states.dtype != np.float64:
        return False
    if symbols not in _KERNELS:
        _KERNELS[symbols] = _compiled(symbols)
    kernel = _KERNELS[symbols]
    if kernel is None:
        return False
    return kernel(np.ascontiguousarray(states), _limits(domain, slack))


@lru_cache(maxsize=64)
def _limits(domain: EnergySublevel, slack: float) -> np.ndarray:
    """Lower bounds of the state, of H and of |L|, and the upper ones: (2, 2d + 2)."""
    low, high = domain.bounds(slack)
    least = -np.inf if domain.above is None else domain.above - slack
    slowest, fastest = domain.angular_momentum or (0.0, np.inf)
    return np.array([[*low, least, slowest], [*high, domain.energy + slack, fastest]])


def _compiled(symbols: SymbolicHamiltonian) -> Callable[..., bool] | None:
    try:
        source = sublevel_source(symbols)
    except ValueError:  # a function in H has no compiled form
        return None
    header = f"import math\n\nfrom numba import njit\n\nOPTIONS = {OPTIONS | {'cache': True}}"
    before = ["elementary"] if "fast_" in source else []
    return load_module("\n\n\n".join([header, *map(template, before), source])).all_within


def sublevel_source(symbols: SymbolicHamiltonian) -> str:
    """``all_within(y, limits)``: whether the states, H and, where d = 2, |L| keep to `_limits`.

    Raises
    ------
    ValueError
        If a function in H has no counterpart in compiled code.
    """
    variables = symbols.q + symbols.p
    shared, (H,) = sp.cse([printable(symbols.H)], symbols=sp.numbered_symbols("s_", real=True), list=True)
    n = len(variables)
    box = " & ".join(f"({v} >= limits[0, {i}]) & ({v} <= limits[1, {i}])" for i, v in enumerate(variables))
    lines = [f"{v} = y[i, {i}]" for i, v in enumerate(variables)]
    lines += [f"{name} = {printed(f)}" for name, f in shared]
    lines += [f"H = {printed(H)}", f"inside &= {box} & (H > limits[0, {n}]) & (H < limits[1, {n}])"]
    if symbols.ndof == 2:
        lines += ["L = abs(q1*p2 - q2*p1)", "inside &= (L >= limits[0, 5]) & (L <= limits[1, 5])"]
    body = "\n        ".join(lines)
    return f"""@njit(**OPTIONS)
def all_within(y, limits):
    inside = True
    for i in range(y.shape[0]):
        {body}
    return inside
"""
