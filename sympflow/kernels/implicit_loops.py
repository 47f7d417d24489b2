"""Compiled loops of implicit Gauss methods: Newton's iteration with the Hessian of a symbolic H."""

from __future__ import annotations

from functools import lru_cache
from types import ModuleType
from typing import Any
from weakref import WeakKeyDictionary

import numpy as np
import sympy as sp
from numpy.typing import ArrayLike

from sympflow.hamiltonian.collocation import Tableau
from sympflow.hamiltonian.symbolic import SymbolicHamiltonian
from sympflow.hamiltonian.system import HamiltonianSystem
from sympflow.kernels import terms
from sympflow.kernels.codegen import statements
from sympflow.kernels.modules import constants_source, load_algebra, template
from sympflow.kernels.protocol import Carry, Kernel, Run, Steps, run_states
from sympflow.kernels.terms import is_large
from sympflow.kernels.threads import given

__all__ = ["ImplicitKernel", "implicit_kernel"]


def implicit_kernel(system: HamiltonianSystem, tableau: Tableau, compensated: bool = False) -> ImplicitKernel:
    """The compiled loops of a method on a symbolic system, built once.

    Raises
    ------
    ValueError
        If the system cannot be compiled, with the reason.
    """
    kernels = _KERNELS.setdefault(system, {})
    if (tableau, compensated) not in kernels:
        kernels[tableau, compensated] = ImplicitKernel(system, tableau, compensated)
    return kernels[tableau, compensated]


_KERNELS: WeakKeyDictionary[HamiltonianSystem, dict[tuple[Tableau, bool], ImplicitKernel]] = WeakKeyDictionary()


class ImplicitKernel(Kernel):
    """Compiled loops of an implicit Runge–Kutta method on one system, a `Kernel`.

    Parameters
    ----------
    system : HamiltonianSystem
        Symbolic.
    tableau : (A, B, scale)
        As tuples of numbers: see `Tableau`.
    compensated : bool
        Sum with Kahan's compensation in runs.
    """

    saves_finite = False

    def __init__(self, system: HamiltonianSystem, tableau: Tableau, compensated: bool = False) -> None:
        if system.symbols is None:
            raise ValueError(
                "`system` cannot be compiled: its Hessian is not symbolic. Use HamiltonianSystem.from_sympy, "
                "or use backend='array'."
            )
        friction = system.friction
        if friction is not None and compensated:
            raise ValueError(
                "`compensated` sums are for systems without friction, which forgets round-off: leave it out."
            )
        if friction is not None and friction.damping.ndim == 2:
            raise ValueError("`damping` is a matrix, whose decay is not compiled here: use backend='array'.")
        rates = () if friction is None else tuple(np.broadcast_to(friction.rates, system.ndof).tolist())
        self.ndof, self._tableau, self._compensated, self._rates = system.ndof, tableau, compensated, rates
        self._algebra = gradient_and_hessian_source(system.symbols)

    def run(
        self,
        h: float,
        y0: np.ndarray,
        n_steps: int,
        save: np.ndarray,
        carry: Carry | None = None,
        t0: float = 0.0,
    ) -> Run:
        """`n_steps` steps of length `h` from one state: see `Kernel`."""
        Y, n_finite, iterations = self._rollout(h, t0, y0[None], n_steps, save, None, carry)
        return Run(Y[0], n_finite[0], iterations)

    def run_batch(
        self,
        h: float,
        y0: np.ndarray,
        n_steps: int,
        save: np.ndarray,
        threads: int | None = None,
        carry: Carry | None = None,
        t0: float = 0.0,
    ) -> Run:
        """`run` for every row of `y0` (N, 2d), where it pays on several threads."""
        return self._rollout(h, t0, y0, n_steps, save, threads, carry)

    def _rollout(
        self,
        h: float,
        t0: float,
        y0: np.ndarray,
        n_steps: int,
        save: np.ndarray,
        threads: int | None,
        carry: Carry | None,
    ) -> Run:
        loops = _load(self._algebra, self.ndof, self._tableau, self._compensated, self._rates)
        iterations = np.empty(len(y0), dtype=np.int64)

        def rows(i: slice, *rest: Any) -> None:
            *states, stop, first, running = rest
            loops.rollout_each(h, t0, *states, iterations[i], stop, first, running)

        width, size = 2 * self.ndof * (1 + self._compensated), 2 * self.ndof * len(self._tableau[1])
        Y, n_finite, _ = run_states(rows, y0, n_steps, save, threads, carry, width, 4 * size**3)
        return Run(Y, n_finite, int(iterations.sum()))

    def step(self, h: ArrayLike, y: np.ndarray, t: ArrayLike = 0.0) -> Steps:
        """One step from each row of `y` (N, 2d), each of its own length `h` (N,): see `Kernel`."""
        y = given(y)
        h, t = (given(np.broadcast_to(x, y.shape[:1])) for x in (h, t))
        out, iterations = np.empty_like(y), np.empty(len(y), dtype=np.int64)
        _load(self._algebra, self.ndof, self._tableau, False, self._rates).step_each(h, t, y, out, iterations)
        return Steps(out, int(iterations.sum()))


@lru_cache(maxsize=256)
def _load(algebra: str, ndof: int, tableau: Tableau, compensated: bool, rates: tuple[float, ...]) -> ModuleType:
    A, B, scale = tableau
    C = tuple(float(np.dot(row, scale)) for row in A)
    numbers: dict[str, Any] = {"A": A, "B": B, "C": C, "SCALE": scale, "RATES": rates}
    constants = constants_source(COMPENSATED=compensated, NDOF=ndof, STAGES=len(B), **numbers)
    steps = "\n\n\n".join([constants, template("running_states"), template("newton_steps")])
    return load_algebra(algebra, ["newton"], [steps])


def gradient_and_hessian_source(symbols: SymbolicHamiltonian) -> str:
    """``gradient_and_hessian(y, g, S, t)``: ∇H into g and ∇²H into S, as statements; zeros of S are not written.

    Raises
    ------
    ValueError
        If a function in H has no counterpart in compiled code.
    """
    variables, H, before = symbols.q + symbols.p, symbols.H, ""
    if symbols.time is not None:
        from sympflow.kernels.stage_times import in_code, sampled_sources

        before = "\n\n\n".join([*sampled_sources([H], symbols.samples), before])
        H = in_code(H, symbols.time, "t")
    if is_large(symbols):
        return before + terms.gradient_and_hessian_source(H, variables, "gradient_and_hessian", time="t")
    slopes = [sp.diff(H, s) for s in variables]
    triangle = [(i, j) for i in range(len(variables)) for j in range(i, len(variables))]
    entries = {ij: sp.diff(slopes[ij[0]], variables[ij[1]]) for ij in triangle}
    entries = {ij: entry for ij, entry in entries.items() if entry != 0}
    targets = [f"g[{i}]" for i in range(len(variables))]
    targets += [f"S[{i}, {j}] = S[{j}, {i}]" if i != j else f"S[{i}, {i}]" for i, j in entries]
    lines = [f"{before}@njit(**OPTIONS)", "def gradient_and_hessian(y, g, S, t):"]
    lines += [f"    {s.name} = y[{i}]" for i, s in enumerate(variables)]
    lines += [f"    {statement}" for statement in statements(targets, [*slopes, *entries.values()])]
    return "\n".join(lines) + "\n"
