"""Compiled loops of implicit Gauss methods on a symbolic system."""

from __future__ import annotations

from weakref import WeakKeyDictionary

import numpy as np

from sympflow.hamiltonian.collocation import Tableau, stage_nodes
from sympflow.hamiltonian.system import HamiltonianSystem
from sympflow.kernels.newton import newton_code
from sympflow.kernels.one_steps import OneStepKernel, is_large, lettered

__all__ = ["implicit_kernel"]


def implicit_kernel(system: HamiltonianSystem, tableau: Tableau, compensated: bool = False) -> OneStepKernel:
    """The compiled loops of a method on a symbolic system, built once; `compensated` sums are Kahan's, in runs.

    Raises
    ------
    ValueError
        If the system cannot be compiled, with the reason.
    """
    kernels = _KERNELS.setdefault(system, {})
    if (tableau, compensated) not in kernels:
        kernels[tableau, compensated] = _kernel(system, tableau, compensated)
    return kernels[tableau, compensated]


_KERNELS: WeakKeyDictionary[HamiltonianSystem, dict[tuple[Tableau, bool], OneStepKernel]] = WeakKeyDictionary()


def _kernel(system: HamiltonianSystem, tableau: Tableau, compensated: bool) -> OneStepKernel:
    written = system.written or system.form
    if written is None:
        raise ValueError(
            "`system` cannot be compiled: its Hessian is not symbolic. Use HamiltonianSystem.from_sympy, "
            "or use backend='array'."
        )
    friction = system.friction
    if friction and compensated:
        raise ValueError("`compensated` sums are for systems without friction, which forgets round-off: leave it out.")
    if friction.kind == 2:
        raise ValueError("`damping` is a matrix, whose decay is not compiled here: use backend='array'.")
    symbols = written if is_large(written) else written.parametric
    of_time = lettered(symbols, [symbols.H])
    code = newton_code(of_time, tableau, compensated, bool(friction))
    single = newton_code(of_time, tableau, False, False) if compensated else code
    if not friction:
        return OneStepKernel(code, single)
    rates = np.broadcast_to(friction.rates, system.ndof)
    exponents = np.outer([*stage_nodes(tableau), 1.0], rates).ravel()

    def growths(h: np.ndarray) -> np.ndarray:
        """e^{γτ} at the stages and the end of steps, and their reciprocals."""
        return np.exp(np.concatenate([h[:, None] * exponents, -h[:, None] * exponents], axis=1))

    return OneStepKernel(code, single, growths)
