"""A compiled pass that tells if many states lie in a box or an energy sublevel."""

from __future__ import annotations

from collections.abc import Callable
from weakref import WeakKeyDictionary

import numpy as np

from sympflow.hamiltonian.domain import Box, EnergySublevel
from sympflow.hamiltonian.symbolic import SymbolicHamiltonian
from sympflow.hamiltonian.system import HamiltonianSystem
from sympflow.kernels.codegen import statements
from sympflow.kernels.modules import load_algebra
from sympflow.kernels.output_loops import all_between
from sympflow.kernels.terms import energy_source, is_large

__all__ = ["all_within"]

_KERNELS: WeakKeyDictionary[SymbolicHamiltonian, Callable[..., bool]] = WeakKeyDictionary()


def all_within(system: HamiltonianSystem, domain: Box | EnergySublevel, states: np.ndarray, slack: float) -> bool:
    """True if every one of the states (..., 2d) is in the domain, as its `contains` with this slack tells.

    A sublevel without an H is one of the system's. False says nothing where a sublevel has another H, or where the
    system cannot be compiled.
    """
    low, high = domain.bounds if isinstance(domain, Box) else domain.limits(slack)
    width = states.shape[-1]
    if states.dtype != np.float64 or len(low) != (width if isinstance(domain, Box) else width + 2):
        return False
    x = np.ascontiguousarray(states.reshape(-1, width).T)  # loops along the states are vector instructions
    if isinstance(domain, Box):
        return all_between(x, low, high)
    symbols = system.symbols
    if symbols is None or (domain.hamiltonian is not None and domain.hamiltonian != system.hamiltonian):
        return False
    kernel = _KERNELS.get(symbols)
    if kernel is None:
        kernel = _KERNELS[symbols] = _compiled(symbols)
    return kernel(x, low, high)


def _compiled(symbols: SymbolicHamiltonian) -> Callable[..., bool]:
    try:
        source = sublevel_source(symbols)
    except ValueError:  # a function in H has no compiled form
        return lambda states, limits: False
    return load_algebra(source).all_within


def sublevel_source(symbols: SymbolicHamiltonian) -> str:
    """``all_within(x, low, high)``: True if the states x (2d, N), H and, where d = 2, |L| keep to these limits.

    Raises
    ------
    ValueError
        If a function in H has no counterpart in compiled code.
    """
    variables = symbols.q + symbols.p
    n = len(variables)
    box = " & ".join(f"({v} >= low[{i}]) & ({v} <= high[{i}])" for i, v in enumerate(variables))
    lines = [f"{v} = x[{i}, n]" for i, v in enumerate(variables)]
    energy = ""
    if is_large(symbols):
        energy, value = f"{energy_source(symbols.H, variables, 'energy')}\n\n\n", ["H = energy(x[:, n])"]
    else:
        value = statements(["H"], [symbols.H])
    lines += [*value, f"inside &= {box} & (H > low[{n}]) & (H < high[{n}])"]
    if symbols.ndof == 2:
        lines += ["L = abs(q1*p2 - q2*p1)", "inside &= (L >= low[5]) & (L <= high[5])"]
    body = "\n        ".join(lines)
    return f"""{energy}@njit(**OPTIONS)
def all_within(x, low, high):
    inside = True
    for n in range(x.shape[1]):
        {body}
    return inside
"""
