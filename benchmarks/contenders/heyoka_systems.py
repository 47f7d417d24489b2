"""heyoka on any symbolic system: adaptive Taylor series, scalar or in SIMD lanes."""

from __future__ import annotations

from functools import cache
from typing import Any

import heyoka as hy
import numpy as np
import sympy as sp

from sympflow.hamiltonian.system import HamiltonianSystem

WIDTH = 2 * hy.recommended_simd_size()  # as in heyoka_taylor


class Taylor:
    """The Taylor integrators of a system, compiled once for each tolerance."""

    def __init__(self, system: HamiltonianSystem) -> None:
        symbols = system.symbols
        if symbols is None:
            raise ValueError(f"`system` {system.name!r} has no symbols: leave heyoka out.")
        names = [s.name for s in (*symbols.q, *symbols.p)]
        variables = hy.make_vars(*names)
        table = dict(zip((*symbols.q, *symbols.p), variables, strict=True))
        right = [symbols.H.diff(s) for s in symbols.p] + [-symbols.H.diff(s) for s in symbols.q]
        self.field = [(x, hy.from_sympy(_binary(f), table)) for x, f in zip(variables, right, strict=True)]
        self.size = 2 * symbols.ndof
        self.scalar, self.lanes = cache(self._scalar), cache(self._lanes)

    def _scalar(self, tol: float) -> Any:
        return hy.taylor_adaptive(self.field, np.zeros(self.size), tol=tol)

    def _lanes(self, tol: float) -> Any:
        return hy.taylor_adaptive_batch(self.field, np.zeros((self.size, WIDTH)), tol=tol)

    def run(self, tol: float, y0: np.ndarray, t_end: float) -> np.ndarray:
        """The state at t_end from one state."""
        integrator = self.scalar(tol)
        integrator.time = 0.0
        integrator.state[:] = y0
        integrator.propagate_until(t_end)
        return integrator.state.copy()

    def grid(self, tol: float, y0: np.ndarray, times: np.ndarray) -> np.ndarray:
        """The states (n, 2d) at the times, the first of which is 0."""
        integrator = self.scalar(tol)
        integrator.time = 0.0
        integrator.state[:] = y0
        return integrator.propagate_grid(times)[-1]

    def run_lanes(self, tol: float, y0: np.ndarray, t_end: float) -> np.ndarray:
        """The states at t_end from many, WIDTH at a time."""
        integrator = self.lanes(tol)
        columns = np.concatenate([y0, np.repeat(y0[-1:], -len(y0) % WIDTH, axis=0)]).T
        final = np.empty_like(columns)
        for start in range(0, columns.shape[1], WIDTH):
            integrator.set_time(0.0)
            integrator.state[:] = columns[:, start : start + WIDTH]
            integrator.propagate_until(t_end)
            final[:, start : start + WIDTH] = integrator.state
        return final.T[: len(y0)]


def _binary(f: sp.Expr) -> sp.Expr:
    """f with floating-point numbers for the fractions that heyoka does not take: those of no power of 2."""
    fractions = {r for r in f.atoms(sp.Rational) if int(r.q) & (int(r.q) - 1)}
    return f.xreplace({r: sp.Float(float(r), precision=53) for r in fractions})
