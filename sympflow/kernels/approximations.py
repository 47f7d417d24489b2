"""Functions of one position as polynomials on an interval, exact to rounding."""

from __future__ import annotations

import operator
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cache
from typing import TYPE_CHECKING, Any

import numpy as np
from mpmath import mp

from sympflow.compiler.numbers import Number
from sympflow.compiler.program import Program
from sympflow.hamiltonian.domain import Domain

if TYPE_CHECKING:
    from sympflow.hamiltonian.formulas import TracedHamiltonian
    from sympflow.hamiltonian.symbolic import SymbolicHamiltonian

__all__ = ["OnInterval", "Ranges", "on_interval", "position_ranges"]

Ranges = tuple[tuple[float, float], ...]
"""The interval of q1 in which kicks are computed by polynomials; none for none."""

NODES = 48  # of the interpolants whose coefficients say which degree is enough
DIGITS = 40
HIGHEST = 34  # degree: a longer polynomial takes as long as the function
EXACT = 2.0**-54  # of the largest value
AMPLIFIED = 16.0  # by so much rounding errors may grow
STATES, MARGIN = 1000, 0.05  # of a domain whose positions, with a margin on both sides, are a range


def position_ranges(form: SymbolicHamiltonian | TracedHamiltonian | None, domain: Domain) -> Ranges:
    """The interval of the position in a domain of one degree of freedom; none for an H that makes no use of it."""
    assert form is not None
    assert form.V is not None
    if form.ndof > 1 or form.time is not None or form.V.is_polynomial(*form.q):
        return ()
    q = domain.sample(STATES, 0)[:, : form.ndof]
    margin = MARGIN * (q.max(0) - q.min(0))
    return tuple(zip((q.min(0) - margin).tolist(), (q.max(0) + margin).tolist(), strict=True))


@dataclass(frozen=True)
class OnInterval:
    """Functions of x on [low, high], a row of `coefficients` (n, K) each, of the powers 0 … K−1 of x − center."""

    low: float
    high: float
    center: float
    coefficients: np.ndarray


class _Precise(Number):
    """A number in the arithmetic of mpmath."""

    def __init__(self, value: Any) -> None:
        self.value = value

    def apply(self, name: str, args: Sequence[Any]) -> _Precise:
        values = [x.value if isinstance(x, _Precise) else x for x in args]
        return _Precise(_OPERATIONS[name](*values) if name in _OPERATIONS else getattr(mp, _SAME[name])(*values))


_OPERATIONS: dict[str, Callable[..., Any]] = {
    **{"add": operator.add, "sub": operator.sub, "mul": operator.mul, "times": operator.mul, "neg": operator.neg},
    **{"div": operator.truediv, "pow": operator.pow, "fma": lambda x, y, z: x * y + z},
    **{"expit": lambda x: 1 / (1 + mp.exp(-x)), "bose": lambda x: 1 / mp.expm1(x)},
    **{"softplus": lambda x: mp.log(1 + mp.exp(x)), "logcosh": lambda x: mp.log(mp.cosh(x))},
}
_SAME = {
    name: name
    for name in (
        *("sqrt", "exp", "expm1", "log", "log1p", "sin", "cos", "tan", "asin", "acos", "atan", "sinh", "cosh", "tanh"),
        *("asinh", "acosh", "atanh", "sech", "csch", "erf", "erfc", "gamma", "digamma", "ellipk", "ellipe", "hyp2f1"),
    )
}
"""Functions that mpmath has by the same name; of others, as those with kinks, there are no polynomials."""


def on_interval(functions: Program, low: float, high: float) -> OnInterval | None:
    """Functions of one number as polynomials on [low, high] whose errors are below rounding; None if there are none.

    Each function is to enter with a factor at least `AMPLIFIED` times less than that before, as the terms of a kick do:
    its errors may be larger by that. Coefficients are those of Chebyshev interpolants, in powers of x less the middle.
    """
    if abs(low + high) < 0.1 * (high - low):
        low, high = -max(-low, high), max(-low, high)
    center, half = 0.5 * (low + high), 0.5 * (high - low)
    with mp.workdps(DIGITS):
        cosines = _cosines()
        try:
            rows = [functions(_Precise(mp.mpf(center) + mp.mpf(half) * c)) for c in cosines[1]]
            numbers = [[mp.mpf(x.value if isinstance(x, _Precise) else x) for x in row] for row in rows]
            found = [
                _powers(column, cosines, half, AMPLIFIED**k) for k, column in enumerate(zip(*numbers, strict=True))
            ]
        except (ArithmeticError, TypeError, ValueError, LookupError):  # not defined, or not real, everywhere
            return None
    if any(c is None for c in found):
        return None
    kept = [c for c in found if c is not None]
    length = max(map(len, kept))
    return OnInterval(low, high, center, np.array([[*c, *[0.0] * (length - len(c))] for c in kept]))


@cache
def _cosines() -> list[list[Any]]:
    """cos(k a) of the angles a of the nodes, for k = 0, 1, …"""
    angles = [(mp.mpf(2 * i + 1) / (2 * NODES)) * mp.pi for i in range(NODES)]
    return [[mp.cos(k * a) for a in angles] for k in range(NODES)]


def _powers(values: Sequence[Any], cosines: Sequence[Sequence[Any]], half: float, less: float) -> list[float] | None:
    """The coefficients in powers of x of a function by its values, whose errors count `less`; None if too long."""
    largest = max(abs(v) for v in values)
    if largest == 0:
        return [0.0]
    n = len(values)
    chebyshev = [(2 if k else 1) * mp.fdot(values, cosines[k]) / n for k in range(n)]
    tails, tail = [], mp.mpf(0)
    for c in reversed(chebyshev):
        tail += abs(c)
        tails.append(tail)
    tails.reverse()  # tails[k] = |c_k| + |c_{k+1}| + …
    degree = next((k for k in range(n - 1) if tails[k + 1] <= EXACT * less * largest), n)
    if degree > HIGHEST:
        return None
    powers = np.polynomial.chebyshev.cheb2poly(np.array(chebyshev[: degree + 1], dtype=object)).tolist()
    powers = [c if abs(c) > EXACT * less * largest / n else mp.mpf(0) for c in powers]
    if sum(map(abs, powers)) > AMPLIFIED * less * largest:
        return None
    return [float(c / mp.mpf(half) ** i) for i, c in enumerate(powers)]
