"""H on two copies of phase space: three parts with exact flows, whatever H is.

On the states [q, x, p, y] of two copies, (q, p) and (x, y), the Hamiltonian

    H(q, y) + H(x, p) + ω Σ_i (s_i² (q_i − x_i)² + (p_i − y_i)²/s_i²)/2

has the solutions of H where the copies agree; s = √(mω), `natural_scale`, makes q and p comparable, and is 1 in Tao's
paper. Neither of its first two parts holds a coordinate with its own momentum, so each is solved exactly; the third
binds the copies, and is an oscillator of frequency 2ω in their difference. Where H depends on t the time stands still
in the first two, and moves with the third.

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

from sympflow.arrays import Array, concatenate, library, like, stack
from sympflow.hamiltonian.linear_part import LinearPart, check_parts_conservative
from sympflow.hamiltonian.parts import ExactParts, PartFunctions
from sympflow.hamiltonian.scales import fastest_rate, natural_scale
from sympflow.lazy import kept

if TYPE_CHECKING:
    from sympflow.hamiltonian.system import HamiltonianSystem


class Coupling(LinearPart):
    """The coupling of the copies; its normal modes are the sums and differences of s q and s x over √2."""

    @cached_property
    def _spectrum(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        d, K, B = self.ndof // 2, self.stiffness_matrix, self.inverse_mass
        s = np.diag((np.diag(K) / np.diag(B))[:d] ** 0.25)
        C, inverse = (np.block([[one, one], [one, -one]]) / sqrt(2) for one in (np.linalg.inv(s), s))
        return np.repeat([np.nan, 4 * K[0, 0] * B[0, 0]], d), C, inverse


class FunctionsOfCopies:
    """H(q, y), or H(x, p), of a system that is given by functions."""

    of_positions, turns = False, False

    def __init__(self, system: HamiltonianSystem, first: bool) -> None:
        self.system, self.first, self.ndof = system, first, 2 * system.ndof
        self.timed = system.definition.timed

    def hamiltonian(self, x: Array, *t: Any) -> Array:
        return self.system.hamiltonian(self._state(x), *t)

    def gradient(self, x: Array, *t: Any) -> Array:
        d, g = self.system.ndof, self.system.gradient(self._state(x), *t)
        zero = 0 * g[..., :d]
        return concatenate([g[..., :d], zero, zero, g[..., d:]] if self.first else [zero, g, zero])

    def _state(self, x: Array) -> Array:
        d = self.system.ndof
        return concatenate([x[..., :d], x[..., 3 * d :]]) if self.first else x[..., d : 3 * d]


@kept
def two_copies(system: HamiltonianSystem, omega: float | None) -> ExactParts:
    """H(q, y), H(x, p) and the coupling, by default of the fastest rate of the motion, which is the innermost part."""
    omega = fastest_rate(system) if omega is None else float(omega)
    if omega is None:
        raise ValueError(
            f"`system` {system.name!r} has neither a `y0` of its own nor a domain to take the coupling from: give "
            "`omega`, or the system one of these."
        )
    check_parts_conservative(system)
    import sympy as sp

    d, symbols = system.ndof, system.written
    squares = np.diag(natural_scale(system) ** 2)
    B, K = (omega * np.block([[one, -one], [-one, one]]) for one in (np.linalg.inv(squares), squares))
    coupling = Coupling(B, K, np.zeros(2 * d))
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


def distance(x: Array, s: np.ndarray) -> Array:
    """The largest |s(q − x)| or |(p − y)/s|, and the largest of these variables: (..., 4d) to (..., 2)."""
    d = len(s)
    x = x * like(np.concatenate([s, s, 1 / s, 1 / s]), x)
    apart = concatenate([x[..., :d] - x[..., d : 2 * d], x[..., 2 * d : 3 * d] - x[..., 3 * d :]])
    xp = library(x)
    return stack([xp.amax(abs(apart), -1), xp.amax(abs(x), -1)], axis=-1)
