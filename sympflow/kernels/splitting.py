"""The splitting kernel: any scheme on one system, compiled."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from types import ModuleType
from typing import TYPE_CHECKING, Any
from weakref import WeakKeyDictionary

import numpy as np
from numpy.typing import ArrayLike

from sympflow.hamiltonian.monomials import Monomials
from sympflow.hamiltonian.system import HamiltonianSystem
from sympflow.kernels.modules import OPTIONS, load_module, run_one, run_rows, template
from sympflow.kernels.tables import Table, scaled_run_table, step_table
from sympflow.schemes import CURVATURE, FORCE_GRADIENT, POLYNOMIAL, Scheme

if TYPE_CHECKING:
    from sympflow.hamiltonian.symbolic import SymbolicHamiltonian

__all__ = ["SplittingKernel", "splitting_kernel"]


def splitting_kernel(system: HamiltonianSystem) -> SplittingKernel:
    """The compiled splitting loops of a separable system, built once per system.

    Raises
    ------
    ValueError
        If the system cannot be compiled, with the reason.
    """
    kernel = _KERNELS.get(system)
    if kernel is None:
        kernel = _KERNELS[system] = SplittingKernel(system)
    return kernel


_KERNELS: WeakKeyDictionary[HamiltonianSystem, SplittingKernel] = WeakKeyDictionary()


class SplittingKernel:
    """Compiled loops that run any `Scheme` on one system; states are [q, p], float64.

    Force gradients and compensated sums are compiled when first used. A symbolic system's code is kept on disk for
    the next process; that of a system given by Numba functions is not.

    Parameters
    ----------
    system : HamiltonianSystem
        Separable, and symbolic or given by Numba functions.
    """

    def __init__(self, system: HamiltonianSystem) -> None:
        self.ndof = system.ndof
        if not system.separable:
            raise ValueError("`system` is not separable, so no splitting method applies: use a Runge–Kutta method.")
        if system.symbols is not None:
            from sympflow.kernels.codegen import algebra_source

            self._has_force_gradient = system.quadratic_kinetic
            self._compile = partial(_symbolic_loops, system.symbols, algebra_source(system.symbols))
        elif system.numba_functions is not None:
            _, gradient, hessian_vector = system.numba_functions
            self._has_force_gradient = hessian_vector is not None
            self._compile = partial(_array_loops, system.ndof, gradient, hessian_vector, system.inverse_mass)
        else:
            raise ValueError(
                "`system` cannot be compiled: it is given by plain functions. Define it with "
                "HamiltonianSystem.from_sympy or by Numba functions, or use backend='array'."
            )
        self._has_curvature = system.symbols is not None
        self._variants: dict[tuple[int, bool, Monomials], _Loops] = {}

    def _loops(self, level: int, compensated: bool, monomials: Monomials = ()) -> _Loops:
        variant = (level, compensated, monomials)
        if variant not in self._variants:
            if level in (FORCE_GRADIENT, CURVATURE) and not self._has_force_gradient:
                raise ValueError(
                    "`scheme` has force gradients, which need a kinetic energy quadratic in p and, for a system of "
                    "Numba functions, `hessian_vector`: take a scheme without them, for instance 'kahan_li8'."
                )
            if level > FORCE_GRADIENT and not self._has_curvature:
                what = "curvature terms" if level == CURVATURE else "polynomials"
                raise ValueError(f"`scheme` has {what}, which need a symbolic system: take one without them.")
            self._variants[variant] = self._compile(*variant)
        return self._variants[variant]

    def run(
        self,
        scheme: Scheme,
        h: float,
        y0: np.ndarray,
        n_steps: int,
        save: np.ndarray,
        compensated: bool = False,
    ) -> tuple[np.ndarray, int]:
        """`n_steps` steps of length `h` from one state.

        Parameters
        ----------
        scheme : Scheme
        h : float
            Step, negative to go back.
        y0 : ndarray of shape (2d,)
        n_steps : int
        save : ndarray of int64, sorted, in 0 … n_steps
            The steps whose states are kept.
        compensated : bool
            Whether to sum with Kahan's compensation, which lowers the growth of round-off.

        Returns
        -------
        Y : ndarray of shape (len(save), 2d)
            NaN after the last finite state.
        n_finite : int
            Index of the last step that ends in a finite state, `n_steps` if all do; the run stops there.
        """
        table = scaled_run_table(scheme, h)
        loops = self._loops(scheme.level, compensated, scheme.monomials)
        y0, save = np.ascontiguousarray(y0, dtype=np.float64), np.ascontiguousarray(save, dtype=np.int64)
        out = np.empty((len(save), 2 * self.ndof))
        n_finite = run_one(
            lambda stop: loops.rollout(*table, y0, n_steps, save, out, stop), n_steps * len(table[0]) * self.ndof
        )
        return out, n_finite

    def run_batch(
        self,
        scheme: Scheme,
        h: float,
        y0: np.ndarray,
        n_steps: int,
        save: np.ndarray,
        compensated: bool = False,
        threads: int | None = None,
    ) -> tuple[np.ndarray, np.ndarray]:
        """`run` for every row of `y0` (N, 2d), in vector lanes and, where it pays, on several threads.

        Returns
        -------
        Y : ndarray of shape (N, len(save), 2d)
        n_finite : ndarray of int64, shape (N,)
        """
        loops = self._loops(scheme.level, compensated, scheme.monomials)
        table = scaled_run_table(scheme, h)
        y0, save = np.ascontiguousarray(y0, dtype=np.float64), np.ascontiguousarray(save, dtype=np.int64)
        out = np.empty((len(y0), len(save), 2 * self.ndof))
        n_finite = np.empty(len(y0), dtype=np.int64)

        def rows(i: slice, stop: np.ndarray) -> None:
            loops.rollout_batch(*table, y0[i], n_steps, save, out[i], n_finite[i], stop)

        run_rows(rows, len(y0), n_steps * len(table[0]) * self.ndof, threads)
        return out, n_finite

    def step(self, scheme: Scheme, h: ArrayLike, y: np.ndarray) -> np.ndarray:
        """One step from each row of `y` (N, 2d), each of its own length `h` (N,)."""
        h = np.asarray(h, dtype=np.float64)
        h = h.repeat(len(y)) if h.ndim == 0 else h
        return self.step_rows(step_table(scheme), scheme.level, h, h, y, scheme.monomials)

    def step_rows(
        self, table: Table, level: int, x: np.ndarray, h: np.ndarray, y: np.ndarray, monomials: Monomials = ()
    ) -> np.ndarray:
        """One step from each row of `y` (N, 2d), each of its own length `h` (N,) and by its own numbers.

        Parameters
        ----------
        table : kicks, drifts, gradients, curvatures, ndarrays of shape (m, K)
            Of the stages, a kick and a drift each, for h = 1: those of row i are Σ_k kicks[:, k] x[i]^k. In a batch K
            is 1 or at least 3. In place of curvatures may stand polynomials, (m, M, K).
        level, monomials
            What the kicks have: see `Scheme`.
        """
        y = np.ascontiguousarray(y, dtype=np.float64)
        out = np.empty(y.shape)
        x, h = np.ascontiguousarray(x), np.ascontiguousarray(h)
        self._loops(level, False, monomials).step_rows(*table, x, h, y, out)
        return out


@dataclass(frozen=True)
class _Loops:
    """The compiled functions of one variant (what kicks have, with or without compensated sums)."""

    rollout: Callable[..., int]
    rollout_batch: Callable[..., None]
    rollout_processed: Callable[..., int]
    rollout_processed_batch: Callable[..., None]
    step_rows: Callable[..., None]


def _header(level: int, compensated: bool, cache: bool, scheduled: bool) -> str:
    return (
        f"import math\n\nfrom numba import njit\n\nOPTIONS = {OPTIONS | {'cache': cache}}\n"
        f"FORCE_GRADIENTS = {level in (FORCE_GRADIENT, CURVATURE)}\nCURVATURES = {level == CURVATURE}\n"
        f"POLYNOMIALS = {level == POLYNOMIAL}\nCOMPENSATED = {compensated}\nSCHEDULED = {scheduled}"
    )


def _symbolic_loops(
    symbols: SymbolicHamiltonian, algebra: str, level: int, compensated: bool, monomials: Monomials
) -> _Loops:
    after = ("loops", "aligned", "lanes", "processed_loops")
    loops = symbolic_module(symbols, algebra, level, compensated, after, monomials)
    processed = loops.rollout_processed, loops.rollout_processed_rows
    return _Loops(loops.rollout, loops.rollout_lanes, *processed, loops.step_lanes)


def symbolic_module(
    symbols: SymbolicHamiltonian,
    algebra: str,
    level: int,
    compensated: bool,
    after: Sequence[str],
    monomials: Monomials = (),
) -> ModuleType:
    """The algebra of a symbolic system, the texts of loops `after` it, as a module."""
    from sympflow.kernels.codegen import (
        coefficients_source,
        curvature_kick_source,
        gradient_kick_source,
        polynomial_kick_source,
    )
    from sympflow.kernels.kicks import kicks_source

    algebra = f"{algebra}\n\n{coefficients_source(symbols.ndof, len(monomials))}"
    if not compensated:
        algebra = f"{algebra}\n\n{kicks_source(symbols, level, monomials)}"
    elif level == POLYNOMIAL:
        algebra = f"{algebra}\n\n{polynomial_kick_source(symbols, monomials)}"
    elif level == CURVATURE:
        algebra = f"{algebra}\n\n{gradient_kick_source(symbols)}\n\n{curvature_kick_source(symbols)}"
    elif level:
        algebra = f"{algebra}\n\n{gradient_kick_source(symbols)}"
    header = _header(level, compensated, cache=True, scheduled=not compensated)
    before = ["elementary"] if "fast_" in algebra or "fused_multiply_add" in algebra else []
    return load_module("\n\n\n".join([header, *map(template, before), algebra, *map(template, after)]))


_INVERSE_MASS_TIMES_V = {
    0: "out[i] = v[i]",
    1: "out[i] = INVERSE_MASS[i] * v[i]",
    2: "out[i] = 0.0\n        for j in range(NDOF):\n            out[i] += INVERSE_MASS[i, j] * v[j]",
}


def _array_loops(
    ndof: int,
    gradient: Any,
    hessian_vector: Any | None,
    inverse_mass: np.ndarray | None,
    level: int,
    compensated: bool,
    monomials: Monomials,
) -> _Loops:
    """The loops around the user's Numba functions; compiled for this process only."""
    rows = _INVERSE_MASS_TIMES_V[0 if inverse_mass is None else inverse_mass.ndim]
    mass = f"@njit(**OPTIONS)\ndef apply_inverse_mass(v, out):\n    for i in range(NDOF):\n        {rows}"
    header = _header(level, compensated, cache=False, scheduled=False)
    functions: dict[str, Any] = {
        "NDOF": ndof,
        "INVERSE_MASS": inverse_mass,
        "gradient": gradient,
        "hessian_vector": hessian_vector,
    }
    exec("\n\n\n".join([header, mass, *map(template, ("arrays", "loops", "processed_loops"))]), functions)
    names = ("rollout", "rollout_each", "rollout_processed", "rollout_processed_rows", "step_each")
    return _Loops(*(functions[name] for name in names))
