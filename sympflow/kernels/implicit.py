"""The kernel of the implicit Gauss methods: Newton with the Hessian of a symbolic H, compiled."""

from __future__ import annotations

from functools import lru_cache
from types import ModuleType
from weakref import WeakKeyDictionary

import numpy as np
import sympy as sp

from sympflow.hamiltonian.symbolic import SymbolicHamiltonian
from sympflow.hamiltonian.system import HamiltonianSystem
from sympflow.kernels.codegen import statements
from sympflow.kernels.modules import load_algebra, run_rows

__all__ = ["ImplicitKernel", "implicit_kernel"]

Tableau = tuple[tuple[tuple[float, ...], ...], tuple[float, ...]]


def implicit_kernel(system: HamiltonianSystem, tableau: Tableau) -> ImplicitKernel:
    """The compiled loops of a method on a symbolic system, built once.

    Raises
    ------
    ValueError
        If the system cannot be compiled, with the reason.
    """
    kernels = _KERNELS.setdefault(system, {})
    if tableau not in kernels:
        kernels[tableau] = ImplicitKernel(system, tableau)
    return kernels[tableau]


_KERNELS: WeakKeyDictionary[HamiltonianSystem, dict[Tableau, ImplicitKernel]] = WeakKeyDictionary()


class ImplicitKernel:
    """Compiled loops of an implicit Runge–Kutta method on one system; states are [q, p], float64.

    Parameters
    ----------
    system : HamiltonianSystem
        Symbolic.
    tableau : (A, b)
        As tuples of numbers.
    """

    def __init__(self, system: HamiltonianSystem, tableau: Tableau) -> None:
        if system.symbols is None:
            raise ValueError(
                "`system` cannot be compiled: its Hessian is not symbolic. Use HamiltonianSystem.from_sympy, "
                "or use backend='array'."
            )
        self.ndof, self._tableau = system.ndof, tableau
        self._algebra = gradient_and_hessian_source(system.symbols)

    def _loops(self, compensated: bool) -> ModuleType:
        return _load(self._algebra, self._tableau, compensated)

    def run_batch(
        self, h: float, y0: np.ndarray, n_steps: int, save: np.ndarray, compensated: bool = False
    ) -> tuple[np.ndarray, np.ndarray, int]:
        """`n_steps` steps of length `h` from every row of `y0` (N, 2d).

        Returns
        -------
        Y : ndarray of shape (N, len(save), 2d)
            The states after the steps `save` (sorted counts); NaN after the last one that was solved.
        n_finite : ndarray of int64, shape (N,)
            Index of the last step that was solved.
        iterations : int
            Newton iterations of all rows together.
        """
        loops = self._loops(compensated)
        y0, save = np.ascontiguousarray(y0, dtype=np.float64), np.ascontiguousarray(save, dtype=np.int64)
        out = np.empty((len(y0), len(save), 2 * self.ndof))
        n_finite, iterations = np.empty(len(y0), dtype=np.int64), np.empty(len(y0), dtype=np.int64)

        def rows(i: slice, stop: np.ndarray) -> None:
            loops.rollout_each(h, y0[i], n_steps, save, out[i], n_finite[i], iterations[i], stop)

        size = 2 * self.ndof * len(self._tableau[1])
        run_rows(rows, len(y0), n_steps * 4 * size**3, None)
        return out, n_finite, int(iterations.sum())

    def step(self, h: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, int]:
        """One step from each row of `y` (N, 2d), each of its own length `h` (N,); and the iterations taken."""
        y = np.ascontiguousarray(y, dtype=np.float64)
        h = np.ascontiguousarray(h, dtype=np.float64)
        out, iterations = np.empty_like(y), np.empty(len(y), dtype=np.int64)
        self._loops(False).step_each(h, y, out, iterations)
        return out, int(iterations.sum())


@lru_cache(maxsize=256)
def _load(algebra: str, tableau: Tableau, compensated: bool) -> ModuleType:
    A, b = tableau
    return load_algebra(algebra, ["implicit_loops"], COMPENSATED=compensated, STAGES=len(b), A=A, B=b)


def gradient_and_hessian_source(symbols: SymbolicHamiltonian) -> str:
    """``gradient_and_hessian(y, g, S)``: ∇H into g and ∇²H into S, as statements; zeros of S are not written.

    Raises
    ------
    ValueError
        If a function in H has no counterpart in compiled code.
    """
    variables = symbols.q + symbols.p
    slopes = [sp.diff(symbols.H, s) for s in variables]
    triangle = [(i, j) for i in range(len(variables)) for j in range(i, len(variables))]
    entries = {ij: sp.diff(slopes[ij[0]], variables[ij[1]]) for ij in triangle}
    entries = {ij: entry for ij, entry in entries.items() if entry != 0}
    targets = [f"g[{i}]" for i in range(len(variables))]
    targets += [f"S[{i}, {j}] = S[{j}, {i}]" if i != j else f"S[{i}, {i}]" for i, j in entries]
    lines = [f"NDOF = {symbols.ndof}\n\n", "@njit(**OPTIONS)", "def gradient_and_hessian(y, g, S):"]
    lines += [f"    {s.name} = y[{i}]" for i, s in enumerate(variables)]
    lines += [f"    {statement}" for statement in statements(targets, [*slopes, *entries.values()])]
    return "\n".join(lines) + "\n"
