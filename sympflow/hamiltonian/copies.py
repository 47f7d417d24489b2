"""H on two copies of phase space: three parts with exact flows, whatever H is.

On the states [q, x, p, y] of two copies, (q, p) and (x, y), the Hamiltonian

    H(q, y) + H(x, p) + ω (|q − x|² + |p − y|²)/2

has the solutions of H where the copies agree. Neither of its first two parts holds a coordinate with its own momentum,
so each is solved exactly; the third binds the copies, and is an oscillator of frequency 2ω in their difference. Where H
depends on t the time stands still in the first two, and moves with the third.

References
----------
.. [1] P. Pihajoki, "Explicit methods in extended phase space for inseparable Hamiltonian problems", Celest. Mech. Dyn.
   Astron. 121 (2015) 211–231.
.. [2] M. Tao, "Explicit symplectic approximation of nonseparable Hamiltonians: algorithm and long time performance",
   Phys. Rev. E 94 (2016) 043303.
"""

from __future__ import annotations

from functools import cached_property
from math import sqrt
from typing import TYPE_CHECKING, Any

import numpy as np

from sympflow.arrays import Array, concatenate
from sympflow.hamiltonian.linear_part import LinearPart, check_parts_conservative
from sympflow.hamiltonian.parts import ExactParts, PartFunctions
from sympflow.hamiltonian.times import probe_times

if TYPE_CHECKING:
    from sympflow.hamiltonian.system import HamiltonianSystem

STATES = 64
"""States of a domain at which the default ω is taken, where there is no y0."""


class Coupling(LinearPart):
    """ω (|q − x|² + |p − y|²)/2, in the sums and differences of the copies over √2: these are its normal modes."""

    @cached_property
    def _spectrum(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        d, one = self.ndof // 2, np.eye(self.ndof // 2) / sqrt(2)
        C = np.block([[one, one], [one, -one]])
        return np.repeat([np.nan, (2 * self.inverse_mass[0, 0]) ** 2], d), C, C


class FunctionsOfCopies:
    """H(q, y), or H(x, p), of a system that is given by functions."""

    of_positions, turns = False, False

    def __init__(self, system: HamiltonianSystem, first: bool) -> None:
        self.system, self.first, self.ndof = system, first, 2 * system.ndof
        self.timed = not system.autonomous

    def hamiltonian(self, x: Array, *t: Any) -> Array:
        return self.system.hamiltonian(self._state(x), *t)

    def gradient(self, x: Array, *t: Any) -> Array:
        d, g = self.system.ndof, self.system.gradient(self._state(x), *t)
        zero = 0 * g[..., :d]
        return concatenate([g[..., :d], zero, zero, g[..., d:]] if self.first else [zero, g, zero])

    def _state(self, x: Array) -> Array:
        d = self.system.ndof
        return concatenate([x[..., :d], x[..., 3 * d :]]) if self.first else x[..., d : 3 * d]


def two_copies(system: HamiltonianSystem, omega: float) -> ExactParts:
    """H(q, y), H(x, p) and the coupling, in the order of a splitting with the coupling innermost."""
    check_parts_conservative(system)
    import sympy as sp

    d, symbols = system.ndof, system.symbols
    one = np.eye(d)
    matrix = omega * np.block([[one, -one], [-one, one]])
    coupling = Coupling(matrix, matrix, np.zeros(2 * d))
    if symbols is None:
        return ExactParts(coupling, [FunctionsOfCopies(system, first) for first in (True, False)], 2 * d)
    q, p = (tuple(sp.symbols(f"{letter}1:{2 * d + 1}", real=True)) for letter in "qp")
    first = dict(zip((*symbols.q, *symbols.p), (*q[:d], *p[d:]), strict=True))
    second = dict(zip((*symbols.q, *symbols.p), (*q[d:], *p[:d]), strict=True))
    copies = [PartFunctions(symbols.H.xreplace(these), q, p, symbols) for these in (first, second)]
    return ExactParts(coupling, copies, 2 * d)


def both(y: Array, d: int) -> Array:
    """[q, q, p, p] of states [q, p]: (..., 2d) to (..., 4d)."""
    return concatenate([y[..., :d], y[..., :d], y[..., d:], y[..., d:]])


def mean(x: Array, d: int) -> Array:
    """The mean of the two copies, in which their difference cancels to first order: (..., 4d) to (..., 2d)."""
    return concatenate([(x[..., :d] + x[..., d : 2 * d]) / 2, (x[..., 2 * d : 3 * d] + x[..., 3 * d :]) / 2])


def distance(x: Array, d: int) -> Array:
    """The largest difference of the two copies in a coordinate or momentum: (..., 4d) to (...)."""
    apart = concatenate([x[..., :d] - x[..., d : 2 * d], x[..., 2 * d : 3 * d] - x[..., 3 * d :]])
    return abs(apart).max(-1) if isinstance(apart, np.ndarray) else abs(apart).amax(-1)


def coupling_strength(system: HamiltonianSystem) -> float:
    """The default ω: the largest |λ| of J∇²H at y0, or the median over the domain; 1 where that is 0 or not finite.

    Where H depends on t, the largest of a few times within its period, or else the system's interval.

    The copies stay together where the coupling is as strong as what drives them apart; far stronger, its frequency asks
    for shorter steps.

    Raises
    ------
    ValueError
        If there is neither a y0 nor a domain.
    """
    if system.y0 is not None:
        y = system.y0[None]
    elif system.domain is not None:
        y = system.domain.sample(STATES, 0)
    else:
        raise ValueError(
            f"`system` {system.name!r} has neither a `y0` of its own nor a domain to take the coupling from: give "
            "`omega`, or the system one of these."
        )
    t0, t1 = system.t_span
    times = [t0] if system.autonomous else probe_times(t0, t1 if system.period is None else t0 + system.period)
    return max(_median_rate(system, y, float(t)) for t in times) or 1.0


def _median_rate(system: HamiltonianSystem, y: np.ndarray, t: float) -> float:
    """The median over the states of the largest |λ| of J∇²H; 0 where none is finite."""
    d = system.ndof
    with np.errstate(all="ignore"):
        S = np.asarray(system.hessian(y, t))
    S = S[np.isfinite(S).all((-1, -2))]
    rates = np.abs(np.linalg.eigvals(np.concatenate([S[:, d:], -S[:, :d]], axis=1))).max(-1)
    return float(np.median(rates)) if len(S) else 0.0
