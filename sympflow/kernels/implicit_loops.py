"""Compiled loops of implicit Gauss methods on a symbolic system."""

from __future__ import annotations

from typing import Any
from weakref import WeakKeyDictionary

import numpy as np
from numpy.typing import ArrayLike

from sympflow.hamiltonian.collocation import Tableau, stage_nodes
from sympflow.hamiltonian.driving import with_letters
from sympflow.hamiltonian.recorded import check_recorded
from sympflow.hamiltonian.system import HamiltonianSystem
from sympflow.kernels.newton import newton_code
from sympflow.kernels.protocol import Carry, Kernel, Run, Steps, run_states
from sympflow.kernels.samples import check_samples
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
        self._rates = None if friction is None else np.broadcast_to(friction.rates, system.ndof)
        self._nodes = np.array(stage_nodes(tableau))
        symbols = system.symbols if is_large(system.symbols) else system.symbols.parametric
        for name in symbols.samples:
            check_samples(symbols.samples[name])
        check_recorded(with_letters([symbols.H])[0][0])
        self._values, self._driven = symbols.values, symbols.time is not None
        self._code, self._single = (
            newton_code(symbols, tableau, sums, friction is not None) for sums in (compensated, False)
        )

    def _numbers(self, h: np.ndarray, t: np.ndarray) -> np.ndarray:
        """The numbers (n, size) of steps of lengths h (n,), at the times t (n,) less those of whole steps before."""
        given = [h[:, None], np.broadcast_to(self._values, (len(h), len(self._values)))]
        if self._driven:
            given.append(t[:, None])
        if self._rates is not None:
            exponents = np.append(self._nodes, 1.0)[:, None] * self._rates
            decays = -h[:, None] * exponents.ravel()
            given.append(np.exp(np.concatenate([-decays, decays], axis=1)))
        return np.concatenate(given, axis=1)

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
        code, counts = self._code, np.zeros(len(y0))
        rollout: Any = code.rollout_batch
        columns = np.repeat(self._numbers(np.array([h]), np.array([t0])), 3, axis=0), np.zeros(3, dtype=np.int64)

        def rows(i: slice, *rest: Any) -> None:
            rollout(columns, *rest, closed=False, counts=counts[i])

        Y, n_finite, _ = run_states(rows, y0, n_steps, save, threads, carry, code.n_values - 1, code.work)
        return Run(Y, n_finite, int(counts.sum()))

    def step(self, h: ArrayLike, y: np.ndarray, t: ArrayLike = 0.0) -> Steps:
        """One step from each row of `y` (N, 2d), each of its own length `h` (N,): see `Kernel`."""
        y = given(y)
        h, t = (given(np.broadcast_to(x, y.shape[:1])) for x in (h, t))
        return Steps(*self._single.steps(y, self._numbers(h, t)))
