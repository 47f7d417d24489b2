"""Splines of SciPy in functions that are traced: their polynomials, with coefficients in tables.

Along each axis a spline is Σ_j N_j(x) c_{i+j}, where i is the interval that x lies in and each N_j a polynomial there;
of several axes it is the product. A spline of one axis by its polynomials is the case of one N and no c.
"""

from __future__ import annotations

import math
import sys
import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import Any, NamedTuple

import numpy as np

from sympflow.compiler.functions import apply
from sympflow.compiler.tables import Table

__all__ = ["NotRecorded", "recorded_splines"]

SMOOTH = 2  # derivatives that must not jump
CONTINUOUS = 1e-7  # by how much they may differ, relative to their largest value
EXTRAPOLATED, PERIODIC, CLAMPED = "extrapolated", "periodic", "clamped"
"""Beyond the first and last knot: by the last polynomials, by those one period away, by the value at the end."""


class NotRecorded(TypeError):
    """The reason why a spline has no form as a program, a clause."""


class Axis(NamedTuple):
    """The functions along an axis: `powers` (n, m, k + 1) are the coefficients of m polynomials in n intervals.

    They are those of powers of the distance to the left end of an interval, from the constant on; the intervals lie
    between n + 1 `knots`.
    """

    knots: np.ndarray
    powers: np.ndarray

    def derived(self, order: int) -> Axis:
        """The derivatives of the functions."""
        powers = self.powers
        for _ in range(order):
            powers = powers[..., 1:] * np.arange(1, powers.shape[-1]) if powers.shape[-1] > 1 else 0.0 * powers
        return Axis(self.knots, powers)

    def check_smooth(self) -> None:
        """Refuse functions whose value, slope or second derivative jumps at a knot; of one alone, not of a basis."""
        widths = np.diff(self.knots)[:, None]
        for order in range(SMOOTH + 1):
            powers = self.derived(order).powers[:, 0]
            ends = (powers * widths ** np.arange(powers.shape[-1])).sum(-1)[:-1]
            begins = powers[1:, 0]
            if len(ends) and np.abs(ends - begins).max() > CONTINUOUS * max(np.abs(ends).max(), np.abs(begins).max()):
                raise NotRecorded(JUMPS)


JUMPS = "it has a spline whose second derivative jumps: take a smoother one, such as CubicSpline"


class Recorded:
    """A spline of numbers that are traced: `coefficients` (n_1, …, n_d) of the product of functions along axes."""

    def __init__(self, axes: Sequence[Axis], coefficients: np.ndarray | None, beyond: Any) -> None:
        self._beyond, self._knots = beyond, [axis.knots for axis in axes]
        self._tables = [Table(axis.knots) for axis in axes]
        self._powers = [(axis.powers.shape, Table(axis.powers)) for axis in axes]
        self._coefficients = None if coefficients is None else Table(coefficients)
        shape = () if coefficients is None else coefficients.shape
        self._strides = [int(np.prod(shape[a + 1 :])) for a in range(len(shape))]

    def __call__(self, *x: Any) -> Any:
        """The value at x, a number for each axis."""
        given, inside = list(x), 1.0
        for a, knots in enumerate(self._knots):
            low, high = float(knots[0]), float(knots[-1])
            if self._beyond == PERIODIC:
                given[a] = low + apply("mod", given[a] - low, high - low)
            elif self._beyond == CLAMPED:
                given[a] = apply("min", apply("max", given[a], low), high)
            elif self._beyond != EXTRAPOLATED:
                within = apply("and", apply("le", low, given[a]), apply("le", given[a], high))
                inside = within if isinstance(inside, float) else apply("and", inside, within)
        places, functions = zip(*map(self._along, range(len(given)), given), strict=True)
        value = functions[0][0] if self._coefficients is None else self._total(places, functions)
        return value if isinstance(inside, float) else apply("where", inside, value, self._beyond)

    def _along(self, a: int, x: Any) -> tuple[Any, list[Any]]:
        """The interval of an axis that x lies in, and the functions there."""
        (_, m, k), table = self._powers[a]
        i = apply("interval", self._tables[a], x)
        distance, found = x - apply("entry", self._tables[a], i, 0.0), []
        for j in range(m):
            value = apply("entry", table, i * float(m * k), float(j * k + k - 1))
            for power in range(k - 2, -1, -1):
                value = value * distance + apply("entry", table, i * float(m * k), float(j * k + power))
            found.append(value)
        return i, found

    def _total(self, places: Sequence[Any], functions: Sequence[list[Any]]) -> Any:
        """Σ N_{j_1} … N_{j_d} c, the sums over the last axes within those over the first."""
        first: Any = 0.0
        for place, stride in zip(places, self._strides, strict=True):
            first = first + place * float(stride)

        def total(a: int, offset: int) -> Any:
            if a == len(functions):
                return apply("entry", self._coefficients, first, float(offset))
            value: Any = 0.0
            for j, function in enumerate(functions[a]):
                value = value + function * total(a + 1, offset + j * self._strides[a])
            return value

        return total(0, 0)


def _polynomials(x: np.ndarray, c: np.ndarray) -> Axis:
    """The polynomials (k + 1, n), highest power first, of the intervals that are not empty."""
    kept = np.diff(x) > 0
    return Axis(np.append(x[:-1][kept], x[-1]), np.moveaxis(c[::-1, kept], 0, -1)[:, None])


def _basis(t: np.ndarray, k: int, derivative: int) -> Axis:
    """A derivative of B-splines of a degree between knots."""
    from scipy.interpolate import BSpline

    knots = t[k : len(t) - k]
    if k - derivative <= SMOOTH or (np.diff(knots) <= 0).any():
        raise NotRecorded(JUMPS)
    every, i, j = BSpline(t, np.eye(len(t) - k - 1), k), np.arange(len(knots) - 1)[:, None], np.arange(k + 1)
    taylor = [every(knots[:-1], order)[i, i + j] / math.factorial(order) for order in range(k + 1)]
    return Axis(knots, np.stack(taylor, axis=-1)).derived(derivative)


def _check_real(c: np.ndarray, order: int) -> None:
    if order < 0 or np.iscomplexobj(c):
        raise NotRecorded("it has a spline of complex numbers, or an antiderivative")


def _beyond(extrapolate: Any) -> Any:
    return PERIODIC if extrapolate == "periodic" else EXTRAPOLATED if extrapolate else np.nan


# the classes: what a call of each records ---------------------------------------------------------------------------


def _of_polynomials(x: np.ndarray, c: np.ndarray, nu: int, extrapolate: Any) -> np.ndarray:
    """A recorded spline for each component (…) of polynomials (k + 1, n, …) between knots."""
    _check_real(c, nu)
    if x[-1] < x[0]:
        raise NotRecorded("it has a PPoly with decreasing breakpoints: make it with increasing ones")
    found = np.empty(c.shape[2:], dtype=object)
    for index in np.ndindex(found.shape):
        axis = _polynomials(x, c[(..., *index)]).derived(nu)
        axis.check_smooth()
        found[index] = Recorded([axis], None, _beyond(extrapolate))
    return found


def _called_polynomials(spline: Any, x: Any, nu: int = 0, extrapolate: Any = None) -> Any:
    extrapolate = spline.extrapolate if extrapolate is None else extrapolate
    return _each(_of_polynomials(spline.x, spline.c, nu, extrapolate), x)


def _called_b_spline(spline: Any, x: Any, nu: int = 0, extrapolate: Any = None) -> Any:
    from scipy.interpolate import PPoly

    t, c, k = spline.tck
    columns = [PPoly.from_spline((t, column, k)) for column in c.reshape(len(c), -1).T]
    inner = slice(k, len(t) - k - 1)
    powers = np.stack([each.c[:, inner] for each in columns], axis=-1)
    extrapolate = spline.extrapolate if extrapolate is None else extrapolate
    found = _of_polynomials(t[k : len(t) - k], powers.reshape(*powers.shape[:2], *c.shape[1:]), nu, extrapolate)
    return _each(found, x)


def _called_univariate(spline: Any, x: Any, nu: int = 0, ext: Any = None) -> Any:
    from scipy.interpolate import BSpline

    ext = spline.ext if ext is None else ext
    if ext not in (0, "extrapolate", 3, "const"):
        raise NotRecorded("it has a spline that is 0, or refused, beyond its data: pass ext=0 or 3")
    t, c, k = spline._eval_args
    if ext in (3, "const"):
        x = _each(lambda v: apply("min", apply("max", v, float(t[k])), float(t[-k - 1])), x)
    return _called_b_spline(BSpline(t, c[: len(t) - k - 1], k), x, nu, True)


def _called_bivariate(spline: Any, x: Any, y: Any, dx: int = 0, dy: int = 0, grid: bool = True) -> Any:
    if grid:
        raise NotRecorded("it evaluates a spline on a grid: pass grid=False")
    tx, ty, c = spline.tck
    _check_real(c, min(dx, dy))
    kx, ky = spline.degrees
    axes = [_basis(tx, kx, dx), _basis(ty, ky, dy)]
    found = Recorded(axes, c.reshape(len(tx) - kx - 1, len(ty) - ky - 1), CLAMPED)
    return np.frompyfunc(found, 2, 1)(np.asarray(x, dtype=object), np.asarray(y, dtype=object))


def _called_at(spline: Any, xi: Any, yi: Any, dx: int = 0, dy: int = 0) -> Any:
    return _called_bivariate(spline, xi, yi, dx, dy, grid=False)


def _called_tensor(spline: Any, xi: Any, *, nu: Any = None, extrapolate: Any = None) -> Any:
    extrapolate = spline.extrapolate if extrapolate is None else extrapolate
    return _of_product(spline, xi, nu, _beyond(extrapolate))


def _of_product(spline: Any, xi: Any, nu: Any, beyond: Any) -> Any:
    orders = [0] * len(spline.t) if nu is None else list(nu)
    _check_real(spline.c, min(orders))
    axes = [_basis(*each) for each in zip(spline.t, spline.k, orders, strict=True)]
    found = np.empty(spline.c.shape[len(axes) :], dtype=object)
    for index in np.ndindex(found.shape):
        found[index] = Recorded(axes, np.ascontiguousarray(spline.c[(..., *index)]), beyond)
    return _each(found, *_columns(xi, len(axes)))


def _called_grid(spline: Any, xi: Any, method: Any = None, *, nu: Any = None) -> Any:
    if not isinstance(xi, tuple) and np.ndim(xi) == 1:
        raise NotRecorded(
            "a RegularGridInterpolator gives shape (1,) for one state: call it with coordinates, "
            "V((q[..., 0], q[..., 1]))"
        )
    if method not in (None, spline.method) or spline.method not in ("cubic", "quintic"):
        raise NotRecorded("it has a RegularGridInterpolator with kinks: pass method='cubic'")
    beyond = np.nan if spline.bounds_error else EXTRAPOLATED if spline.fill_value is None else float(spline.fill_value)
    return _of_product(spline._spline, xi, nu, beyond)


def _columns(xi: Any, d: int) -> list[Any]:
    """Points (…, d), or d arrays, as d arrays."""
    if isinstance(xi, tuple):
        return [np.asarray(x, dtype=object) for x in xi]
    points = np.asarray(xi, dtype=object)
    if points.shape[-1] != d:
        raise NotRecorded(f"it calls a spline of {d} coordinates with {points.shape[-1]}")
    return [points[..., a] for a in range(d)]


def _each(found: Any, *x: Any) -> Any:
    """Functions, one or an array of them, of the elements of arrays: their axes first."""
    arrays = [np.asarray(each, dtype=object) for each in x]
    if callable(found):
        return np.frompyfunc(found, len(arrays), 1)(*arrays)
    values = [np.asarray(np.frompyfunc(f, len(arrays), 1)(*arrays), dtype=object) for f in found.flat]
    return np.stack(values, axis=-1).reshape((*values[0].shape, *found.shape))


_CALLS: dict[tuple[str, str], Callable[..., Any]] = {
    ("PPoly", "__call__"): _called_polynomials,
    ("BSpline", "__call__"): _called_b_spline,
    ("UnivariateSpline", "__call__"): _called_univariate,
    ("BivariateSpline", "__call__"): _called_bivariate,
    ("BivariateSpline", "ev"): _called_at,
    ("NdBSpline", "__call__"): _called_tensor,
    ("RegularGridInterpolator", "__call__"): _called_grid,
}
_LOCK = threading.RLock()


@contextmanager
def recorded_splines(is_traced: Callable[[Any], bool], wrapped: Callable[[Any, Any], Any]) -> Iterator[None]:
    """Record what SciPy's splines are called with that `is_traced`, where SciPy's splines are loaded.

    SciPy itself needs values, and numbers that are traced have none. Other calls, of other threads too, are as before.
    """
    module = sys.modules.get("scipy.interpolate")
    if module is None:
        yield
        return
    with _LOCK:
        kept = []
        for (name, method), rule in _CALLS.items():
            kind = getattr(module, name)
            own = vars(kind).get(method)
            kept.append((kind, method, own))
            setattr(kind, method, _intercepted(getattr(kind, method), rule, is_traced, wrapped))
        try:
            yield
        finally:
            for kind, method, own in kept:
                if own is None:
                    delattr(kind, method)
                else:
                    setattr(kind, method, own)


def _intercepted(
    before: Callable[..., Any],
    rule: Callable[..., Any],
    is_traced: Callable[[Any], bool],
    wrapped: Callable[[Any, Any], Any],
) -> Callable[..., Any]:
    def called(spline: Any, *args: Any, **options: Any) -> Any:
        given = [*args, *options.values()]
        flat = [y for x in given for y in (x if isinstance(x, tuple | list) else (x,))]
        traced = [x for x in flat if is_traced(x)]
        if not traced:
            return before(spline, *args, **options)
        return wrapped(rule(spline, *args, **options), traced[0])

    return called
