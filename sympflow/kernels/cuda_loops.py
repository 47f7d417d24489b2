"""Splitting schemes on an NVIDIA GPU by Numba: the code that is generated for the CPU, a thread for each orbit.

It has been run in Numba's simulator, and compiled up to NVIDIA's own compiler; no GPU has been measured.
"""

from __future__ import annotations

from functools import lru_cache
from threading import Lock
from types import ModuleType
from typing import Any

import numpy as np
from numba import cuda
from numpy.typing import ArrayLike

from sympflow.hamiltonian.monomials import Monomials
from sympflow.hamiltonian.symbolic import SymbolicHamiltonian
from sympflow.hamiltonian.system import HamiltonianSystem
from sympflow.kernels.codegen import algebra_source, tuple_algebra
from sympflow.kernels.loop_functions import plain_kicks_source
from sympflow.kernels.modules import load_module, template
from sympflow.kernels.protocol import Carry, Run, Steps
from sympflow.kernels.splitting_loops import SplittingKernel, splitting_loops
from sympflow.kernels.stages import kicks_of, numbers_source, run_table, stages_source, takes_values
from sympflow.kernels.terms import is_large
from sympflow.schemes import Scheme

__all__ = ["CudaKernel", "cuda_kernel", "cuda_module"]

THREADS = 64
"""Threads of a block: each orbit needs many registers."""

_DEVICE = Lock()  # one launch at a time: a device gains nothing by two, and the simulator does not know them

HEADER = """import math

from numba import cuda

OPTIONS = {{}}
COMPENSATED = {compensated}
SCHEDULED = False
N_VALUES = 0
fast_sin, fast_cos, fast_tanh = math.sin, math.cos, math.tanh


def njit(**options):
    return cuda.jit(device=True)


@njit()
def min(a, b):  # Python's is not to be had on the device
    return a if a < b else b"""


def cuda_kernel(system: HamiltonianSystem, scheme: Scheme, compensated: bool) -> CudaKernel:
    """The loops of a scheme on a system, on the GPU.

    Raises
    ------
    ValueError
        If the system has no such form, or there is no GPU, with the reason.
    """
    reason = None
    if system.local is not None:
        reason = f"is a {system.local.noun}, whose loops run on processors alone"
    elif system.symbols is None:
        reason = "is not symbolic: define it with HamiltonianSystem.from_sympy"
    elif not system.separable:
        reason = "is not separable"
    elif system.friction is not None:
        reason = "has friction"
    elif not system.autonomous:
        reason = "has an H that depends on t"
    elif is_large(system.symbols):
        reason = "has more terms than a thread has registers"
    if reason is not None:
        raise ValueError(f"`system` {system.name!r} {reason}; or use backend='auto'.")
    if not cuda.is_available():
        raise ValueError(
            "Numba finds no NVIDIA GPU with its driver: use backend='auto', or set the environment variable "
            "NUMBA_ENABLE_CUDASIM=1 before Python starts, for a trial in Numba's simulator."
        )
    return CudaKernel(system, scheme, compensated)


class CudaKernel(SplittingKernel):
    """The loops of one scheme on one system, on the GPU; single steps, as to outputs between two, are the CPU's.

    Parameters
    ----------
    system : HamiltonianSystem
        Symbolic, separable, without friction and driving.
    scheme : Scheme
    compensated : bool
    values : ndarray of shape (k, N), optional
        The values of `SplittingLoops.values` of each orbit, of batches whose orbits have their own.
    """

    backend = "cuda"

    def __init__(
        self, system: HamiltonianSystem, scheme: Scheme, compensated: bool, values: np.ndarray | None = None
    ) -> None:
        super().__init__(splitting_loops(system), scheme, compensated)
        self.system, self._values = system, values

    def run(
        self,
        h: float,
        y0: np.ndarray,
        n_steps: int,
        save: np.ndarray,
        carry: Carry | None = None,
        t0: float = 0.0,
    ) -> Run:
        one = None if carry is None else Carry(carry.steps, _rows_of(carry.running))
        states, n_finite, _ = self.run_batch(h, y0[None], n_steps, save, carry=one)
        if carry is not None and one is not None and one.running is not None:
            carry.advance(n_steps, one.running[0])
        return Run(states[0], int(n_finite[0]))

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
        """`run` for every row of `y0` (N, 2d), on the GPU; `threads` of the CPU are not used."""
        y0, save = np.ascontiguousarray(y0, dtype=np.float64), np.ascontiguousarray(save, dtype=np.int64)
        n = len(y0)
        first, running = 0, np.empty((n, self._width))
        if carry is not None and carry.running is not None:
            first, running = carry.steps, carry.running.copy()
        with _DEVICE:
            out, n_finite = cuda.device_array((n, len(save), y0.shape[1])), cuda.device_array(n, dtype=np.int64)
            of_orbits = cuda.to_device(running)
            given = [cuda.to_device(array) for array in (self._tables(h, n), y0)]
            stop = cuda.to_device(np.zeros(1, dtype=np.int64))
            rollout = self._module().rollout_orbits[-(-n // THREADS), THREADS]
            rollout(*given, n_steps, cuda.to_device(save), out, n_finite, stop, first, of_orbits)
            states, finite, running = out.copy_to_host(), n_finite.copy_to_host(), of_orbits.copy_to_host()
        if carry is not None:
            carry.advance(n_steps, running)
        return Run(states, finite)

    def step(self, h: ArrayLike, y: np.ndarray, t: ArrayLike = 0.0) -> Steps:
        kernel = self.loops.kernel(self.scheme, self.compensated)
        return (kernel if self._values is None else kernel.varied(self._values)).step(h, y, t)

    def table(self, h: float, t0: float = 0.0) -> np.ndarray:
        return self.loops.rows(run_table(self.scheme, h), h, t0, varied=self._values is not None)

    def varied(self, values: np.ndarray) -> Any:
        return CudaKernel(self.system, self.scheme, self.compensated, values)

    def _tables(self, h: float, n: int) -> np.ndarray:
        """The numbers of the steps: of each orbit (N, R, m) where they have values of their own, else (1, R, m)."""
        table = self.table(h)
        if self._values is None:
            return table[None]
        k = len(self._values)
        tables = np.tile(table, (n, 1, 1))
        tables[:, -k:] = np.tile(self._values.T, (n // self._values.shape[1], 1))[:, :, None]
        return tables

    def _module(self) -> ModuleType:
        symbols = self.system.symbols
        assert symbols is not None
        takes = self._values is not None or takes_values(self.scheme.level)
        form = symbols.parametric if takes else symbols
        return cuda_module(form, self.scheme.level, self.scheme.monomials, self.compensated)


def _rows_of(running: np.ndarray | None) -> np.ndarray | None:
    return None if running is None else running[None]


def _on_device(name: str) -> str:
    """The text of loops of that name, with the header's `njit`."""
    return template(name).replace("from numba import njit\n", "")


@lru_cache(maxsize=64)
def cuda_module(symbols: SymbolicHamiltonian, level: int, monomials: Monomials, compensated: bool) -> ModuleType:
    """The algebra of a symbolic system, its kicks and the loops after them, for the GPU."""
    kinds = kicks_of(level, len(monomials))
    sources = [
        HEADER.format(compensated=bool(compensated)),
        f"NDOF = {symbols.ndof}",
        tuple_algebra(symbols.ndof),
        _on_device("running_states"),
        algebra_source(symbols),
        numbers_source(kinds, None, len(symbols.parameters)),
        stages_source(kinds, False, None, len(symbols.parameters)),
        *plain_kicks_source(symbols, level, monomials),
        _on_device("loops"),
        template("cuda"),
    ]
    return load_module("\n\n\n".join(sources))
