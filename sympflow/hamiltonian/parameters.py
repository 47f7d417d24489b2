"""Parameters of H: numbers, and functions of t by samples."""

from __future__ import annotations

import hashlib
import math
import numbers
import reprlib
import sys
from collections.abc import Mapping, Sequence
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np

from sympflow.arguments import check_kept, plain
from sympflow.arrays import Array, opaque
from sympflow.hamiltonian.grammar import COORDINATE

JUMP = 1e-9  # share of the largest value by which both sides of an end of an interval differ where samples jump
MOST_TURNS = 10_000  # periods of samples, and zeros of a function, beyond which jumps are not listed
LARGEST = sys.float_info.max


class Samples:
    """A function of t by the polynomials of a SciPy spline, a parameter of H."""

    def __init__(self, c: np.ndarray, x: np.ndarray, periodic: bool) -> None:
        self.c, self.x, self.periodic = c, x, periodic
        self.span = float(x[0]), float(x[-1])  # the first and the last time
        for each in (c, x):
            each.setflags(write=False)

    @classmethod
    def of(cls, name: str, spline: Any) -> Samples:
        """Return the samples of a SciPy spline that is given as a parameter."""
        if isinstance(spline, Samples):
            return spline
        from scipy.interpolate import BPoly, BSpline, PPoly

        low, high = -np.inf, np.inf
        if isinstance(spline, BSpline):
            low, high = spline.t[spline.k], spline.t[len(spline.t) - 1 - spline.k]
        if np.ndim(spline.c) != (1 if isinstance(spline, BSpline) else 2) or np.iscomplexobj(spline.c):
            raise ValueError(f"`params` has {name}, a spline that is not of real numbers: give one for each parameter.")
        if isinstance(spline, BSpline):
            spline = PPoly.from_spline(spline)
        elif isinstance(spline, BPoly):
            spline = PPoly.from_bernstein_basis(spline)
        c, x = np.array(spline.c, dtype=float), np.array(spline.x, dtype=float)
        if len(x) > 1 and x[0] > x[-1]:
            raise ValueError(f"`params` has {name}, a spline of times that decrease: reverse them.")
        kept = (x[1:] > x[:-1]) & (x[:-1] >= low) & (x[1:] <= high)
        ends = np.append(x[:-1][kept], x[1:][kept][-1:])
        if not (len(ends) > 1 and np.isfinite(c).all() and np.isfinite(ends).all()):
            raise ValueError(
                f"`params` has {name}, a spline that is not finite: give finite samples at two times at least."
            )
        return cls(np.ascontiguousarray(c[:, kept]), ends, spline.extrapolate == "periodic")

    @cached_property
    def jumps(self) -> np.ndarray:
        """The times of the span at which the value jumps, (m,), of a periodic spline its end among them."""
        return self._breaks(0)

    @cached_property
    def kinks(self) -> np.ndarray:
        """The times at which the value, or its slope, jumps."""
        return np.union1d(self.jumps, self._breaks(1))

    def _breaks(self, order: int) -> np.ndarray:
        """The times at which a derivative jumps."""
        lengths, polynomials = np.diff(self.x), self.polynomials(order)
        ends = sum(c * lengths ** (len(polynomials) - 1 - k) for k, c in enumerate(polynomials))
        starts = polynomials[-1]
        large = JUMP * max(np.abs(ends).max(), np.abs(starts).max())
        inner = np.abs(ends[:-1] - starts[1:]) > large
        last = [self.periodic and abs(ends[-1] - starts[0]) > large]
        return self.x[1:][np.concatenate([inner, last])]

    def jump_times(self, low: float, high: float, kinks: bool = False) -> np.ndarray:
        """The times between two others of jumps, or `kinks` too, in `MOST_TURNS` periods of a spline at most."""
        times = self.kinks if kinks else self.jumps
        if self.periodic and len(times):
            start, end = self.span
            first = math.floor((low - start) / (end - start))
            turns = np.arange(first, min(math.ceil((high - start) / (end - start)), first + MOST_TURNS))
            times = (times + turns[:, None] * (end - start)).ravel()
        return times[(times > low) & (times < high)]

    @property
    def shortest_piece(self) -> float:
        """The shortest time between two jumps, or a jump and an end; inf without jumps."""
        if not len(self.jumps):
            return np.inf
        low, high = self.span
        if self.periodic:
            times = np.append(self.jumps, self.jumps[0] + high - low)
        else:
            times = np.concatenate([[low], self.jumps, [high]])
        return float(np.diff(times).min())

    @cached_property
    def digest(self) -> str:
        """A name made from the content, so that H with other samples is another expression."""
        content = b"".join((self.c.tobytes(), self.x.tobytes(), bytes([self.periodic])))
        return hashlib.sha256(content).hexdigest()[:12]

    def polynomials(self, order: int) -> np.ndarray:
        """The coefficients (k, n) of a derivative, or for −1 of the antiderivative, on the same intervals."""
        return self._function(order).c

    def __call__(self, t: Array, order: int = 0) -> Array:
        """The derivative of an order, −1 for the antiderivative, at times: numbers or arrays; tensors by NumPy."""
        return opaque(_Derivative(self, order), t)

    def values(self, t: np.ndarray, order: int) -> np.ndarray:
        """The same at numbers or arrays."""
        t = np.asarray(t, dtype=float)
        function, (low, high) = self._function(order), self.span
        if not self.periodic:
            return function(t)
        turns = np.floor((t - low) / (high - low))
        value = function(np.clip(t - turns * (high - low), low, high))
        return value if order >= 0 else value + turns * function(high)

    def _function(self, order: int) -> Any:
        if order not in self._functions:
            from scipy.interpolate import PPoly

            function = PPoly.construct_fast(np.array(self.c), np.array(self.x), True)
            self._functions[order] = function.derivative(order) if order >= 0 else function.antiderivative(-order)
        return self._functions[order]

    @cached_property
    def _functions(self) -> dict[int, Any]:
        return {}

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Samples) and self.digest == other.digest

    def __hash__(self) -> int:
        return hash(self.digest)

    def __reduce__(self) -> tuple[Any, ...]:
        return Samples, (np.array(self.c), np.array(self.x), self.periodic)

    def __repr__(self) -> str:
        low, high = self.span
        return f"<{len(self.x)} samples, t in [{low:g}, {high:g}]{', periodic' if self.periodic else ''}>"


def is_spline(value: object) -> bool:
    """Return True for samples, or a spline of SciPy, decided without importing that."""
    if isinstance(value, Samples):
        return True
    module = sys.modules.get("scipy.interpolate")
    return module is not None and isinstance(value, module.PPoly | module.BPoly | module.BSpline)


class _Derivative(NamedTuple):
    """A derivative of samples, as `opaque` takes it."""

    samples: Samples
    order: int

    def value(self, t: np.ndarray) -> np.ndarray:
        return self.samples.values(t, self.order)

    def vjp(self, x: Sequence[Array], w: Array, wanted: Sequence[bool]) -> tuple[Array]:
        return (w * self.samples(x[0], self.order + 1),)

    def jvp(self, x: Sequence[Array], v: Sequence[Array]) -> Array:
        return v[0] * self.samples(x[0], self.order + 1)


def check_span(samples: Mapping[str, Samples], t0: float, t1: float) -> None:
    """Refuse a run that leaves the times of samples, beyond which a spline is no more than its last polynomial."""
    for name, each in samples.items():
        low, high = each.span
        if not each.periodic and not (low <= min(t0, t1) and max(t0, t1) <= high):
            raise ValueError(
                f"`t_span` ({t0:g}, {t1:g}) leaves the samples of the parameter {name!r}, which are for t from {low:g} "
                f"to {high:g}: end it there, or give samples of all of it, or a periodic spline."
            )


def checked_params(params: Mapping[str, Any] | None) -> dict[str, Any]:
    """Return the parameters as numbers of Python, or samples of a function of t."""
    if not isinstance(params, Mapping | None):
        raise TypeError(f"`params` must be a mapping of names to numbers; got {type(params).__name__}: pass a dict.")
    sympy = sys.modules.get("sympy")  # without which nothing is a symbol
    symbol, expression = (sympy.Symbol, sympy.Expr) if sympy else ((), ())
    checked: dict[str, Any] = {}
    for name, given in (params or {}).items():
        name = name.name if isinstance(name, symbol) else name  # noqa: PLW2901
        if not isinstance(name, str) or COORDINATE.fullmatch(name) or name == "t":
            kind = "the time" if name == "t" else "a coordinate"
            raise ValueError(f"`params` gives a value to {name!r}, which is {kind}: rename the parameter.")
        if is_spline(given):
            checked[name] = Samples.of(name, given)
            continue
        check_kept(f"params[{name!r}]", given)
        value = plain(given)
        if isinstance(value, (numbers.Rational, expression)) and not isinstance(value, int):
            try:
                value = float(value)
            except (TypeError, OverflowError):
                value = None
        if isinstance(value, bool) or not isinstance(value, int | float) or not abs(value) <= LARGEST:
            raise ValueError(f"`params` has {name} = {reprlib.repr(given)}: give a finite real number.")
        checked[name] = value
    return checked
