"""Compiled runs of splitting schemes with deviation vectors, moved by the exact linearisation of the steps."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import lru_cache, partial
from typing import TYPE_CHECKING, NamedTuple
from weakref import WeakKeyDictionary

import numpy as np

from sympflow.hamiltonian.system import HamiltonianSystem
from sympflow.kernels.loop_functions import shared_by_lanes
from sympflow.kernels.modules import load_algebra
from sympflow.kernels.splitting_loops import damped_table, splitting_loops
from sympflow.kernels.stages import (
    DampedDrift,
    damped_drift,
    kicks_of,
    lanes_source,
    run_table,
    stages_source,
    takes_values,
    two_stages_source,
)
from sympflow.kernels.threads import run_rows
from sympflow.schemes import Scheme

if TYPE_CHECKING:
    from sympflow.hamiltonian.monomials import Monomials
    from sympflow.hamiltonian.symbolic import SymbolicHamiltonian

__all__ = ["ALIGNMENT", "VOLUME", "TangentKernel", "TangentRun", "tangent_kernel"]

ALIGNMENT, VOLUME = 1, 2
"""Kinds of spread of deviation vectors: see `TangentRun`."""


class TangentRun(NamedTuple):
    """Deviation vectors along N orbits.

    Attributes
    ----------
    growth : ndarray of shape (N, k, n + 1)
        Logarithms of the lengths of the vectors, 0 at the start, after the n counts of steps that were to be saved, and
        at the end of the orbit. NaN where the orbit has ended before.
    spread : ndarray of shape (N, n + 1)
        By its kind the alignment min(|u + v|, |u − v|) of two vectors made unit vectors, or the volume that unit
        vectors span.
    n_steps : ndarray of int64 of shape (N,)
        The steps of each orbit.
    whole : ndarray of bool of shape (N,)
        False where something was not finite any more; then `n_steps` is the last count at which all was.
    """

    growth: np.ndarray
    spread: np.ndarray
    n_steps: np.ndarray
    whole: np.ndarray


class TangentKernel:
    """Compiled loops of one scheme on one system with k deviation vectors: see `tangent_kernel`."""

    def __init__(self, system: HamiltonianSystem, scheme: Scheme, vectors: int) -> None:
        from sympflow.kernels.terms import is_large

        symbols = system.symbols
        if symbols is None or is_large(symbols):
            raise ValueError(
                f"`system` {system.name!r} has no compiled deviation vectors, which are made for symbolic systems of "
                "few terms: use backend='auto'."
            )
        if not system.autonomous:
            raise ValueError(f"`system` {system.name!r} depends on t, for which vectors are moved by arrays.")
        loops = splitting_loops(system)
        self.vectors, self.ndof = vectors, system.ndof
        self._values: tuple[float, ...] = ()
        self._scheme, self._friction = scheme, system.friction
        drift = damped_drift(system, False)
        damped = None if drift is None else replace(drift, copies=1 + vectors)
        if loops.values and loops.friction is None and takes_values(scheme.level):
            symbols, self._values = symbols.parametric, loops.values
        self._make = partial(_rollout, symbols, scheme.level, scheme.monomials, vectors, damped)

    def _table(self, h: float) -> np.ndarray:
        if self._friction is not None:
            return damped_table(self._scheme, h, self._friction)
        return run_table(self._scheme, h).rows(self._values)

    def run(
        self,
        h: float,
        y0: np.ndarray,
        w0: np.ndarray,
        n_steps: int,
        save: np.ndarray,
        every: int,
        kind: int = 0,
        limit: float = 0.0,
        single: bool = False,
        threads: int | None = None,
        scale: np.ndarray | None = None,
    ) -> TangentRun:
        """`n_steps` steps of length h of every row of `y0`.

        Parameters
        ----------
        h : float
        y0 : ndarray of shape (N, 2d)
        w0 : ndarray of shape (k, 2d)
            The vectors at the start of each orbit.
        n_steps : int
        save : ndarray of int64, sorted, in 1 … n_steps
            The steps after which growth and spread are kept.
        every : int
            Steps after which vectors are rescaled, and orbits looked at.
        kind : 0, ALIGNMENT or VOLUME
            0 for no spread.
        limit : float
            An orbit ends where the spread is below it.
        single : bool
            True to run each orbit by itself, which is faster for one, not in vector lanes.
        threads : int, optional
            The default is as many as pay.
        scale : ndarray of shape (2d,), optional
            Lengths are those of scale·w; 1 by default.
        """
        d, table, rollout = self.ndof, self._table(h), self._make(single)
        parts = np.empty((len(y0), 2, 1 + self.vectors, d))
        parts[:, :, 0] = y0.reshape(-1, 2, d)
        parts[:, :, 1:] = w0.reshape(-1, 2, d).swapaxes(0, 1)
        x0 = parts.reshape(len(y0), -1)
        growth = np.full((len(y0), self.vectors, len(save) + 1), np.nan)
        spread = np.full((len(y0), len(save) + 1), np.nan)
        reached = np.zeros(len(y0), dtype=np.int64)
        save = np.ascontiguousarray(save, dtype=np.int64)
        squares = np.ones(2 * d) if scale is None else scale**2

        def rows(i: slice, stop: np.ndarray) -> None:
            rollout(table, x0[i], squares, n_steps, every, save, kind, limit, growth[i], spread[i], reached[i], stop)

        run_rows(rows, len(y0), n_steps * table.shape[1] * x0.shape[1], threads)
        whole = reached >= 0
        return TangentRun(growth, spread, np.where(whole, reached, -1 - reached), whole)


def tangent_kernel(system: HamiltonianSystem, scheme: Scheme, vectors: int) -> TangentKernel:
    """The compiled loops of a scheme with k deviation vectors, made once.

    Raises
    ------
    ValueError
        If there are none, with the reason.
    """
    known = _KERNELS.setdefault(system, {})
    if (scheme, vectors) not in known:
        known[scheme, vectors] = TangentKernel(system, scheme, vectors)
    return known[scheme, vectors]


_KERNELS: WeakKeyDictionary[HamiltonianSystem, dict[tuple[Scheme, int], TangentKernel]] = WeakKeyDictionary()


@lru_cache(maxsize=256)
def _rollout(
    symbols: SymbolicHamiltonian,
    level: int,
    monomials: Monomials,
    vectors: int,
    friction: DampedDrift | None,
    single: bool,
) -> Callable[..., None]:
    """``rollout_tangents`` of the text `tangents`."""
    from sympflow.kernels.codegen import variations_source
    from sympflow.kernels.kicks import kicks_source
    from sympflow.kernels.variations import Variations

    kinds, n = kicks_of(level, len(monomials)), len(symbols.parameters)
    sources = [
        variations_source(Variations(symbols, vectors)),
        stages_source(kinds, True, friction, n),
        lanes_source(kinds, True, friction, n),
        two_stages_source(kinds, friction, n),
        kicks_source(symbols, level, monomials, vectors),
    ]
    constants = {"SCHEDULED": True, "DRIVEN": False, "VECTORS": vectors, "SINGLE": single}
    shared = shared_by_lanes(symbols.ndof * (1 + vectors), kinds, friction, n, False, 0)
    texts = ("loops", "lanes", "tangents")
    return load_algebra("\n\n\n".join(sources), texts, shared, **constants).rollout_tangents
