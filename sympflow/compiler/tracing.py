"""Functions of arrays, written with NumPy or torch, as programs: called once with arrays of traced numbers.

An array of objects does most of it: NumPy's own code indexes, reshapes, adds up and multiplies them. Three protocols
bring what objects lack: functions of each element, functions of arrays, and torch's names of both.
"""

from __future__ import annotations

import builtins
import math
import operator
import warnings
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from contextvars import ContextVar
from functools import partial, reduce
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np

from sympflow.arrays import is_tensor
from sympflow.compiler.functions import COMPOSED, OF_SCIPY, apply
from sympflow.compiler.program import Program, Recording, Traced, reached, traced
from sympflow.compiler.splines import NotRecorded, recorded_splines

__all__ = ["WEIGHTS", "Chain", "TracedArray", "Untraceable", "trace", "trace_chain", "trace_followed"]

MOST_OPERATIONS, MOST_VARIABLES = 50_000, 300  # of one function; larger systems run as array operations
MOST_FOLLOWED = 48  # numbers that torch follows in one function; code takes some hundredths of a second for each
LARGEST_COFACTORS = 3  # of matrices; larger ones are eliminated


class Untraceable(TypeError):
    """The reason why a function cannot be recorded, a clause."""


BRANCH = "it branches on a value: write np.where(condition, a, b) in place of `if`, `min` and `max`"
OUT = "it calls {} with `out`, which holds no coordinates: take the result instead"
VALUE = "it asks for the value of a coordinate, by float(), item() or a function of `math`: write np.cos for math.cos"
WEIGHTS = "it has a tensor that requires gradients, such as weights of a network"
BY_CONDITION = "it indexes by a condition: write np.where(condition, a, b)"


class TracedArray(np.ndarray):
    """An array whose elements are traced numbers, or floats; one number is an array of shape ()."""

    __array_priority__ = 2000.0

    def __getitem__(self, index: Any) -> Any:
        if _holds_traced(index):
            raise Untraceable(BY_CONDITION)
        return _array(_raw(self)[index], type(self))

    def __setitem__(self, index: Any, value: Any) -> None:
        if _holds_traced(index):
            raise Untraceable(BY_CONDITION)
        _raw(self)[index] = _plain(value)

    def __iter__(self) -> Any:
        return (self[k] for k in range(len(self)))

    def __bool__(self) -> bool:
        if self.size == 1 and not isinstance(value := _raw(self).reshape(-1)[0], Traced):
            return bool(value)
        raise Untraceable(BRANCH)

    def __float__(self) -> float:
        if self.size == 1 and not isinstance(value := _raw(self).reshape(-1)[0], Traced):
            return float(value)
        raise Untraceable(VALUE)

    def __index__(self) -> int:
        raise Untraceable(VALUE)

    __int__ = __complex__ = item = tolist = __index__  # type: ignore[assignment]

    def __array_ufunc__(self, ufunc: Any, method: Any, *inputs: Any, out: Any = None, **kwargs: Any) -> Any:
        function, name, given = ufunc, ufunc.__name__, [_plain(x) for x in inputs]
        if out is not None and any(_plain(x) is x and method != "__call__" for x in out):
            raise Untraceable(OUT.format(name))
        options = {key: _plain(x) for key, x in kwargs.items() if key != "dtype"}
        if name in NATIVE or function.types == ["O" * function.nin + "->O"]:
            called = function
        elif name in ELEMENTS:
            called = np.frompyfunc(ELEMENTS[name], function.nin, 1)
        else:
            raise Untraceable(f"{_module(function)}{name} has no rule")
        result = _array(getattr(called, method)(*given, **options), type(self))
        if out is None:
            return result
        (target,) = out
        if not isinstance(target, TracedArray):  # V += x: the name is bound to the new value
            return result if not target.ndim else np.broadcast_to(result, target.shape)
        _raw(target)[...] = _raw(result)
        return target

    def __array_function__(self, function: Any, types: Any, args: Any, options: Any) -> Any:
        name = function.__name__
        if options.get("out") is not None:
            raise Untraceable(OUT.format(name))
        if name in ARRAYS:
            return self._of(ARRAYS[name](*_plain(args), **_plain(options)))
        if name not in UNCHANGED:
            raise Untraceable(f"{_module(function)}{name} has no rule")
        return self._of(function(*_plain(args), **_plain(options)))

    def _of(self, result: Any) -> Any:
        return _wrapped(result, type(self))

    def astype(self, *args: Any, **options: Any) -> Any:
        return self.copy()

    def sort(self, *args: Any, **options: Any) -> Any:
        raise Untraceable("numpy.sort has no rule")

    def _called(self, name: str, args: Any, options: Any) -> Any:
        if options.get("out") is not None:
            raise Untraceable(OUT.format(name))
        rule = ARRAYS.get(name) or getattr(np, name)
        return self._of(rule(_raw(self), *_plain(args), **_plain(options)))

    @classmethod
    def __torch_function__(cls, function: Any, types: Any, args: Any = (), options: Any = None) -> Any:
        name = getattr(function, "__name__", str(function))
        rule = _torch_rule(name)
        if rule is None:
            raise Untraceable(f"torch.{name} has no rule")
        return _by_rule(rule, args, options or {})


def _method(name: str) -> Callable[..., Any]:
    return lambda self, *args, **options: self._called(name, args, options)


for _name in ("sum", "prod", "mean", "var", "std", "max", "min", "clip", "dot", "any", "all", "cumsum", "round"):
    setattr(TracedArray, _name, _method(_name))  # NumPy's own do not pass through the protocols


class TracedTensor(TracedArray):
    """The same with the names that torch has: of the properties and methods of tensors."""

    @property
    def dtype(self) -> Any:
        return _torch().float64

    @property
    def device(self) -> Any:
        return _torch().device("cpu")

    requires_grad = False
    is_cuda = False

    def size(self, dim: int | None = None) -> Any:  # type: ignore[override]
        return self.shape if dim is None else self.shape[dim]

    def __bool__(self) -> bool:
        return _array(_raw(self)).__bool__()

    def __float__(self) -> float:
        return _array(_raw(self)).__float__()

    def __getattribute__(self, name: str) -> Any:
        if name.startswith("_") or name in _KEPT or name in vars(TracedTensor):
            return super().__getattribute__(name)
        rule = _torch_rule(name)
        if rule is None:
            return super().__getattribute__(name)

        return lambda *args, **options: _by_rule(rule, (self, *args), options)

    def detach(self) -> Any:
        raise Untraceable("it calls detach(), item() or numpy(), which cut derivatives off: leave these out")

    numpy = cpu = detach


_KEPT = {"shape", "ndim", "T", "flags", "dtype"}
_OF_NUMPY = {"dim": "axis", "keepdim": "keepdims", "input": "x", "other": "y"}


def _by_rule(rule: Callable[..., Any], args: tuple[Any, ...], options: dict[str, Any]) -> Any:
    """The result of a function of torch."""
    written_out = rule is not TORCH["linear"] or _followed.get() is not None
    if not written_out and is_tensor(args[1]) and (layer := _linear_layer(*args, **options)) is not None:
        return _array(layer, TracedTensor)
    given = {_OF_NUMPY.get(key, key): _plain(x) for key, x in options.items() if key != "dtype"}
    return _wrapped(rule(*_plain(args), **given), TracedTensor)


def _torch() -> Any:
    import torch

    return torch


def _raw(x: np.ndarray) -> np.ndarray:
    return np.ndarray.view(x, np.ndarray)


def _array(x: Any, kind: type[TracedArray] = TracedArray) -> TracedArray:
    if isinstance(x, Traced) or not isinstance(x, np.ndarray):
        made = np.empty((), dtype=object)
        made[()] = x
        return np.ndarray.view(made, kind)
    return np.ndarray.view(x if np.ndarray.dtype.__get__(x).kind == "O" else x.astype(object), kind)


def _wrapped(x: Any, kind: type[TracedArray]) -> Any:
    """A result of raw arrays as it is given to the function again."""
    if isinstance(x, Traced | float) or (isinstance(x, np.ndarray) and x.dtype == object):
        return _array(x, kind)
    return type(x)(_wrapped(y, kind) for y in x) if type(x) in (list, tuple, _Extremes) else x


def _plain(x: Any) -> Any:
    """An argument as raw arrays of objects or numbers."""
    if isinstance(x, TracedArray):
        return _raw(x)
    if type(x) in (list, tuple):
        return type(x)(_plain(y) for y in x)
    if type(x) is dict:
        return {key: _plain(y) for key, y in x.items()}
    if is_tensor(x):
        if not x.requires_grad:
            return x.cpu().numpy()
        if (followed := _followed.get()) is None:
            raise Untraceable(WEIGHTS)
        return followed.numbers(x)
    return x


def _holds_traced(index: Any) -> bool:
    return isinstance(index, TracedArray) or (type(index) is tuple and builtins.any(map(_holds_traced, index)))


def _is_traced(x: Any) -> bool:
    return isinstance(x, TracedArray)


def _like_this(x: Any, like: Any) -> Any:
    return _array(x, type(like))


def _module(function: Any) -> str:
    return f"{getattr(function, '__module__', None) or 'numpy'}."


# functions of elements ---------------------------------------------------------------------------------------------


def _choose(condition: Any, x: Any, y: Any) -> Any:
    return apply("where", condition, x, y) if isinstance(condition, Traced) else x if condition else y


def _not(x: Any) -> Any:
    return apply("not", x)


def _truncated(x: Any) -> Any:
    return _choose(apply("lt", x, 0.0), -apply("floor", -x), apply("floor", x))


def _nearest(x: Any) -> Any:
    """The nearest whole number; of two as near, a traced number goes to the one above."""
    return apply("floor", x + 0.5) if isinstance(x, Traced) else float(np.rint(x))


def _logaddexp(x: Any, y: Any) -> Any:
    return apply("max", x, y) + apply("log1p", apply("exp", -abs(x - y)))


_softplus = COMPOSED["softplus"].value


def _sinc(x: Any) -> Any:
    """sin(x)/x, near 0 by its series, whose derivatives do not cancel there."""
    if not isinstance(x, Traced):
        return float(np.sinc(x / np.pi))
    near, squared = abs(x) < 1.0, x * x
    series: Any = 0.0
    for k in range(10, -1, -1):
        series = series * squared + (-1.0) ** k / math.factorial(2 * k + 1)
    far = apply("where", near, 1.0, x)
    return apply("where", near, series, apply("sin", far) / far)


def _of(name: str) -> Callable[..., Any]:
    return lambda *x: apply(name, *x)


# fmt: off
NATIVE = {"add", "subtract", "multiply", "divide", "true_divide", "negative", "positive", "matmul", "conjugate"}
"""Functions that arrays of objects have."""
ELEMENTS: dict[str, Callable[..., Any]] = {
    **{name: _of(name) for name in (
        "exp", "expm1", "log", "log1p", "sin", "cos", "tan", "tanh", "sinh", "cosh", "sqrt", "sign", "floor", "erf",
        "erfc")},
    **{f"arc{name}": _of(f"a{name}") for name in ("sin", "cos", "tan", "sinh", "cosh", "tanh")},
    "arctan2": _of("atan2"), "absolute": abs, "fabs": abs, "gammaln": _of("lgamma"), "psi": _of("digamma"),
    "maximum": _of("max"), "minimum": _of("min"), "fmax": _of("max"), "fmin": _of("min"),
    "less": _of("lt"), "less_equal": _of("le"), "equal": _of("eq"),
    "greater": lambda x, y: apply("lt", y, x), "greater_equal": lambda x, y: apply("le", y, x),
    "not_equal": lambda x, y: _not(apply("eq", x, y)),
    "logical_and": _of("and"), "logical_or": _of("or"), "logical_not": _not,
    "bitwise_and": _of("and"), "bitwise_or": _of("or"), "invert": _not,
    "power": lambda x, n: x**n, "float_power": lambda x, n: x**n,
    "square": lambda x: x * x, "reciprocal": lambda x: 1.0 / x,
    "hypot": lambda x, y: apply("sqrt", x * x + y * y), "exp2": lambda x: apply("exp", math.log(2.0) * x),
    "log2": lambda x: apply("log", x) * (1.0 / math.log(2.0)),
    "log10": lambda x: apply("log", x) * (1.0 / math.log(10.0)),
    "cbrt": lambda x: apply("sign", x) * abs(x) ** (1.0 / 3.0),
    "remainder": _of("mod"), "fmod": lambda x, y: x - y * _truncated(x / y),
    "floor_divide": lambda x, y: apply("floor", x / y), "ceil": lambda x: -apply("floor", -x), "trunc": _truncated,
    "rint": _nearest, "fix": _truncated, "isnan": lambda x: _not(apply("eq", x, x)),
    "isfinite": lambda x: apply("lt", abs(x), math.inf),
    "deg2rad": lambda x: x * (math.pi / 180), "radians": lambda x: x * (math.pi / 180),
    "rad2deg": lambda x: x * (180 / math.pi), "degrees": lambda x: x * (180 / math.pi),
    "copysign": lambda x, y: abs(x) * _choose(apply("lt", y, 0.0), -1.0, 1.0),
    "heaviside": lambda x, zero: _choose(apply("eq", x, 0.0), zero, _choose(apply("lt", 0.0, x), 1.0, 0.0)),
    "logaddexp": _logaddexp, "expit": COMPOSED["expit"].value, "log_expit": lambda x: -_softplus(-x),
    "xlogy": lambda x, y: _choose(apply("eq", x, 0.0), 0.0, x * apply("log", y)),
    **{name: _of(name) for name in OF_SCIPY}, **{f"{f}{n}": lambda x, f=f, n=n: apply(f"{f}v", float(n), x)
       for f in "jyik" for n in (0, 1)},
    "clip": lambda x, low, high: apply("min", apply("max", x, low), high),
}
# fmt: on


def _each(name: str, *args: Any) -> np.ndarray:
    return np.frompyfunc(ELEMENTS[name], len(args), 1)(*map(_objects, args))


# functions of arrays -----------------------------------------------------------------------------------------------


def _objects(x: Any) -> np.ndarray:
    return np.asarray(x, dtype=object)


def _where(condition: Any, *choices: Any) -> Any:
    if not choices:
        raise Untraceable(BY_CONDITION)
    return np.frompyfunc(_choose, 3, 1)(*map(_objects, (condition, *choices)))


def _norm(x: Any, ord: Any = None, axis: Any = None, keepdims: bool = False, **_: Any) -> Any:
    if ord in (None, 2, 2.0, "fro"):
        if ord == 2 and axis is None and np.ndim(x) > 1:
            raise Untraceable("numpy.linalg.norm of a matrix has no rule of this order")
        return _each("sqrt", _objects((_objects(x) * x).sum(axis=axis, keepdims=keepdims)))
    if ord == 1 and (axis is not None or np.ndim(x) == 1) and not isinstance(axis, tuple):
        return _objects(_each("absolute", x)).sum(axis=axis, keepdims=keepdims)
    if ord == math.inf and (axis is not None or np.ndim(x) == 1) and not isinstance(axis, tuple):
        return _extreme("maximum")(_each("absolute", x), axis, keepdims=keepdims)
    raise Untraceable(f"numpy.linalg.norm of the order {ord!r} has no rule")


def _extreme(name: str) -> Callable[..., Any]:
    def function(x: Any, axis: Any = None, out: Any = None, keepdims: bool = False, **_: Any) -> Any:
        values = _objects(x)
        axes = tuple(range(values.ndim)) if axis is None else axis if isinstance(axis, tuple) else (axis,)
        chosen = np.frompyfunc(ELEMENTS[name], 2, 1)
        for k in sorted((k % values.ndim for k in axes), reverse=True):
            values = _objects(chosen.reduce(values, axis=k, keepdims=keepdims))
        return values

    return function


def _variance(x: Any, axis: Any = None, ddof: int = 0, correction: int | None = None, **_: Any) -> Any:
    values = _objects(x)
    n = values.size if axis is None else values.shape[axis]
    apart = values - values.sum(axis=axis, keepdims=True) * (1.0 / n)
    return (apart * apart).sum(axis=axis) * (1.0 / (n - (ddof if correction is None else correction)))


def _mean(x: Any, axis: Any = None, keepdims: bool = False, **_: Any) -> Any:
    values = _objects(x)
    axes = range(values.ndim) if axis is None else axis if isinstance(axis, tuple) else (axis,)
    return values.sum(axis=axis, keepdims=keepdims) / float(math.prod(values.shape[k] for k in axes))


def _clip(x: Any, a_min: Any = None, a_max: Any = None, **options: Any) -> Any:
    low, high = (options.get(key, given) for key, given in (("min", a_min), ("max", a_max)))
    if low is not None:
        x = _each("maximum", x, low)
    return x if high is None else _each("minimum", x, high)


def _select(conditions: Sequence[Any], choices: Sequence[Any], default: Any = 0.0) -> Any:
    pairs = list(zip(conditions, choices, strict=True))
    return reduce(lambda rest, pair: _where(pair[0], pair[1], rest), pairs[::-1], default)


def _piecewise(x: Any, conditions: Sequence[Any], functions: Sequence[Any], *args: Any, **options: Any) -> Any:
    values = [_plain(f(_array(x), *args, **options)) if callable(f) else f for f in functions]
    default = values.pop() if len(values) > len(conditions) else 0.0
    return _select(conditions, values, default)


def _round(x: Any, decimals: int = 0, out: Any = None) -> Any:
    unit = 10.0**decimals
    return _each("rint", unit * _objects(x)) / unit


def _sort(x: Any, axis: int = -1, **_: Any) -> np.ndarray:
    """The values along an axis in order, by comparisons of neighbours."""
    rows = list(np.moveaxis(_objects(x), axis, 0))
    for last in range(len(rows) - 1, 0, -1):
        for k in range(last):
            rows[k : k + 2] = (_each(name, *rows[k : k + 2]) for name in ("minimum", "maximum"))
    return np.stack([_objects(row) for row in rows], axis)


def _minor(M: np.ndarray, i: int, j: int) -> Any:
    return np.delete(np.delete(M, i, -2), j, -1)


def _det(M: Any) -> Any:
    M = _objects(M)
    if M.shape[-1] > LARGEST_COFACTORS:
        return _eliminated(M, M[..., :0])[1]
    if M.shape[-1] == 1:
        return M[..., 0, 0]
    return reduce(operator.add, ((-1.0) ** j * M[..., 0, j] * _det(_minor(M, 0, j)) for j in range(M.shape[-1])))


def _solve(M: Any, b: Any) -> Any:
    M, b = _objects(M), _objects(b)
    if b.ndim == 1:
        return _solve(M, b[:, None])[..., 0]
    if M.shape[-1] > LARGEST_COFACTORS:
        return _eliminated(M, b)[0]
    return _inv(M) @ b


def _inv(M: Any) -> Any:
    M = _objects(M)
    if np.frompyfunc(lambda x: not isinstance(x, Traced), 1, 1)(M).all():
        return np.linalg.inv(M.astype(float)).astype(object)
    n = M.shape[-1]
    if n > LARGEST_COFACTORS:
        return _eliminated(M, np.broadcast_to(np.eye(n).astype(object), M.shape))[0]
    if n == 1:
        return 1.0 / M
    rows = [[(-1.0) ** (i + j) * _det(_minor(M, j, i)) for j in range(n)] for i in range(n)]
    adjugate = np.stack([np.stack([_objects(x) for x in row], -1) for row in rows], -2)
    return adjugate * _objects(1.0 / _det(M))[..., None, None]


def _eliminated(M: np.ndarray, b: np.ndarray) -> tuple[np.ndarray, Any]:
    """M⁻¹b and det M by Gauss's elimination, rows exchanged where a pivot below is larger."""
    n = M.shape[-1]
    rows = [np.concatenate([M[..., i, :], b[..., i, :]], -1) for i in range(n)]
    det: Any = 1.0
    for k in range(n):
        for i in range(k + 1, n):
            larger = _each("less", _each("absolute", rows[k][..., k]), _each("absolute", rows[i][..., k]))
            swap = _objects(larger)[..., None]
            rows[k], rows[i] = _where(swap, rows[i], rows[k]), _where(swap, rows[k], rows[i])
            det = det * _where(larger, -1.0, 1.0)
        det = det * rows[k][..., k]
        pivot = _objects(1.0 / rows[k][..., k])[..., None]
        rows[k] = rows[k] * pivot
        for i in range(n):
            if i != k:
                rows[i] = rows[i] - _objects(rows[i][..., k])[..., None] * rows[k]
    return np.stack(rows, -2)[..., n:], det


def _like(fill: float) -> Callable[..., np.ndarray]:
    return lambda x, *_, **__: np.full(np.shape(x), fill).astype(object)


def _reduced(name: str) -> Callable[..., Any]:
    def function(x: Any, axis: Any = None, **_: Any) -> Any:
        return np.frompyfunc(ELEMENTS[name], 2, 1).reduce(_objects(x).reshape(-1) if axis is None else x, axis or 0)

    return function


ARRAYS: dict[str, Callable[..., Any]] = {
    "where": _where, "norm": _norm, "vector_norm": _norm, "clip": _clip, "select": _select, "piecewise": _piecewise,
    "amax": _extreme("maximum"), "max": _extreme("maximum"), "amin": _extreme("minimum"), "min": _extreme("minimum"),
    "mean": _mean, "var": _variance, "std": lambda *x, **options: _each("sqrt", _objects(_variance(*x, **options))),
    "det": _det, "inv": _inv, "solve": _solve, "zeros_like": _like(0.0), "ones_like": _like(1.0),
    "full_like": lambda x, value, **_: np.full(np.shape(x), value).astype(object), "empty_like": _like(0.0),
    "sinc": lambda x: np.frompyfunc(lambda y: _sinc(math.pi * y), 1, 1)(_objects(x)),
    "real": lambda x: x, "round": _round, "around": _round, "fix": lambda x: _each("fix", x), "sort": _sort,
    "ptp": lambda x, *a, **o: _extreme("maximum")(x, *a, **o) - _extreme("minimum")(x, *a, **o),
    "any": _reduced("logical_or"), "all": _reduced("logical_and"), "vecdot": lambda x, y, **_: (x * y).sum(-1),
    "linalg_vecdot": lambda x, y, **_: (x * y).sum(-1), "iscomplexobj": lambda x: False,
}  # fmt: skip
# fmt: off
UNCHANGED = {
    "append", "array_split", "atleast_1d", "atleast_2d", "atleast_3d", "average", "block", "broadcast_arrays",
    "broadcast_to", "column_stack", "concat", "concatenate", "convolve", "copy", "correlate", "cross", "cumprod",
    "cumsum", "delete", "diag", "diagflat", "diagonal", "diff", "dot", "dsplit", "dstack", "ediff1d", "einsum",
    "expand_dims", "flip", "fliplr", "flipud", "gradient", "hsplit", "hstack", "inner", "insert", "kron", "matmul",
    "matrix_power", "matrix_transpose", "meshgrid", "moveaxis", "multi_dot", "ndim", "outer", "pad", "permute_dims",
    "polyval", "prod", "ravel", "repeat", "reshape", "roll", "rollaxis", "rot90", "shape", "size", "split",
    "squeeze", "stack", "sum", "swapaxes", "take", "take_along_axis", "tensordot", "tile", "trace", "transpose",
    "trapezoid", "tril", "triu", "unstack", "vander", "vdot", "vsplit", "vstack",
}
# fmt: on
"""NumPy's functions whose own code takes arrays of objects."""


# torch -------------------------------------------------------------------------------------------------------------


def _flat(x: Any) -> Any:
    return x[0] if len(x) == 1 and isinstance(x[0], list | tuple) else x


def _softmax(x: Any, axis: int = -1, **_: Any) -> Any:
    powers = _objects(_each("exp", x))
    return powers / powers.sum(axis=axis, keepdims=True)


def _extremes(name: str) -> Callable[..., Any]:
    """Return torch's max or min: of two arrays, of all, or along an axis, without the indices that torch has."""

    def function(x: Any, *args: Any, **options: Any) -> Any:
        if args and isinstance(args[0], np.ndarray):
            return _each(name, x, args[0])
        found = _extreme(name)(x, *args, **options)
        return _Extremes([found]) if args or "axis" in options else found

    return function


class _Extremes(tuple[Any, ...]):
    """The values along an axis, in place of torch's pair of values and indices."""

    @property
    def values(self) -> Any:
        return self[0]


def _reshaped(x: Any, *shape: Any) -> Any:
    return np.reshape(x, tuple(_flat(shape)))


def _expanded(x: Any, *shape: Any) -> Any:
    shape, old = tuple(_flat(shape)), np.shape(x)
    padded = (1,) * (len(shape) - len(old)) + old
    return np.broadcast_to(x, tuple(n if m == -1 else m for m, n in zip(shape, padded, strict=True)))


def _summed(x: Any, axis: Any = None, keepdims: bool = False, **_: Any) -> Any:
    return np.sum(x, axis=tuple(axis) if isinstance(axis, list) else axis, keepdims=keepdims)


def _gelu(x: Any, approximate: str = "none") -> Any:
    if approximate == "tanh":
        return 0.5 * x * (1.0 + _each("tanh", math.sqrt(2.0 / math.pi) * (x + 0.044715 * x * x * x)))
    return 0.5 * x * (1.0 + _each("erf", x * (1.0 / math.sqrt(2.0))))


def _smooth_ramp(x: Any, beta: float = 1.0, threshold: float = 20.0) -> Any:
    """torch's softplus without its threshold, beyond which it is x, to 2e-9 at the usual one."""
    if threshold < 20.0:
        raise Untraceable("torch.softplus has no rule of a threshold below 20")
    return np.frompyfunc(_softplus, 1, 1)(_objects(beta * x)) * (1.0 / beta)


def _elu(x: Any, alpha: float = 1.0, scale: float = 1.0) -> Any:
    return _where(_each("less", 0.0, x), x, alpha * _each("expm1", x * (1.0 / scale)))


def _dropout(x: Any, p: float = 0.5, training: bool = True, **_: Any) -> Any:
    if training:
        raise Untraceable("torch.dropout has no rule while a module is trained: call its eval()")
    return x


def _chunks(x: Any, size: int, axis: int = 0) -> Any:
    return tuple(np.split(x, range(size, np.shape(x)[axis], size), axis))


_SELF = lambda x, *_, **__: x  # noqa: E731
# fmt: off
TORCH: dict[str, Callable[..., Any]] = {
    "add": lambda x, y, alpha=1: x + alpha * y, "sub": lambda x, y, alpha=1: x - alpha * y,
    "mul": lambda x, y: x * y, "div": lambda x, y: x / y, "rsub": lambda x, y: y - x, "neg": lambda x: -x,
    "rpow": lambda x, y: _each("power", y, x), "rsqrt": lambda x: 1.0 / _each("sqrt", x), "softplus": _smooth_ramp,
    "silu": lambda x, **_: x * _each("expit", x), "relu": lambda x, **_: _each("maximum", x, 0.0), "gelu": _gelu,
    "elu": lambda x, alpha=1.0, **_: _elu(x, alpha), "celu": lambda x, alpha=1.0, **_: _elu(x, alpha, alpha),
    "leaky_relu": lambda x, slope=0.01, **o: _where(_each("less", 0.0, x), x, o.get("negative_slope", slope) * x),
    "mish": lambda x, **_: x * _each("tanh", _smooth_ramp(x)), "softsign": lambda x: x / (1.0 + _each("absolute", x)),
    "log_sigmoid": lambda x: _each("log_expit", x), "tanhshrink": lambda x: x - _each("tanh", x),
    "hardtanh": lambda x, min_val=-1.0, max_val=1.0, **_: _clip(x, min_val, max_val), "dropout": _dropout,
    "round": _round, "sort": lambda x, *a, **o: _Extremes([_sort(x, *a, **o)]),
    "tril": np.tril, "triu": np.triu, "stack": lambda x, axis=0: np.stack([_objects(y) for y in x], axis),
    "cat": lambda x, axis=0: np.concatenate(x, axis), "concat": lambda x, axis=0: np.concatenate(x, axis),
    "linear": lambda x, w, b=None: x @ np.swapaxes(w, -1, -2) + (0.0 if b is None else b),
    "roll": lambda x, shifts, dims=None, axis=None: np.roll(x, shifts, dims if axis is None else axis),
    "einsum": lambda e, *x: np.einsum(e, *_flat(x)), "norm": lambda x, p=2, axis=None, keepdims=False, **_: _norm(
        x, None if p == "fro" else p, axis, keepdims),
    "linalg_norm": _norm, "linalg_vector_norm": lambda x, ord=2, axis=None, keepdims=False, **_: _norm(
        x if axis is not None else _objects(x).reshape(-1), ord, axis, keepdims),
    "sum": _summed, "prod": lambda x, axis=None, keepdims=False, **_: np.prod(x, axis=axis, keepdims=keepdims),
    "mean": _mean, "var": lambda x, axis=None, correction=1, **_: _variance(x, axis, correction),
    "diff": lambda x, n=1, axis=-1, **_: np.diff(x, n, axis), "cumsum": np.cumsum,
    "logsumexp": lambda x, axis, keepdims=False: np.frompyfunc(_logaddexp, 2, 1).reduce(
        _objects(x), axis=axis, keepdims=keepdims), "softmax": _softmax,
    "max": _extremes("maximum"), "min": _extremes("minimum"), "amax": _extreme("maximum"), "amin": _extreme("minimum"),
    "clamp": lambda x, min=None, max=None: _clip(x, min, max), "clamp_min": _clip,
    "clamp_max": lambda x, high: _clip(x, None, high), "where": _where,
    "det": _det, "linalg_det": _det, "linalg_inv": _inv, "inverse": _inv, "linalg_solve": _solve,
    "matmul": np.matmul, "mm": np.matmul, "mv": np.matmul, "bmm": np.matmul, "dot": np.dot, "inner": np.inner,
    "outer": np.outer, "ger": np.outer, "tensordot": lambda x, y, dims=2, axis=None: np.tensordot(
        x, y, dims if axis is None else axis), "trace": np.trace, "vecdot": lambda x, y, axis=-1: (x * y).sum(axis),
    "linalg_vecdot": lambda x, y, axis=-1: (x * y).sum(axis), "cross": lambda x, y, axis=-1: np.cross(x, y, axis=axis),
    "linalg_cross": lambda x, y, axis=-1: np.cross(x, y, axis=axis),
    "addcmul": lambda x, y, z, value=1: x + value * y * z,
    "unbind": lambda x, axis=0: tuple(np.moveaxis(x, axis, 0)), "split": _chunks,
    "chunk": lambda x, n, axis=0: _chunks(x, -(-np.shape(x)[axis] // n), axis), "unsqueeze": np.expand_dims,
    "squeeze": lambda x, axis=None: np.squeeze(x, axis) if axis is None or np.shape(x)[axis] == 1 else x,
    "view": _reshaped, "reshape": _reshaped, "flatten": lambda x, *a: np.ravel(x), "ravel": np.ravel,
    "expand": _expanded, "expand_as": lambda x, y: np.broadcast_to(x, np.shape(y)),
    "broadcast_to": np.broadcast_to, "permute": lambda x, *axes, dims=None: np.transpose(
        x, _flat(axes) if dims is None else dims), "transpose": np.swapaxes, "swapaxes": np.swapaxes,
    "movedim": np.moveaxis, "moveaxis": np.moveaxis, "t": np.transpose, "flip": lambda x, *axes, axis=None: np.flip(
        x, tuple(_flat(axes)) if axis is None else axis), "repeat": lambda x, *n: np.tile(x, tuple(_flat(n))),
    "narrow": lambda x, axis, start, n: np.take(x, range(start, start + n), axis),
    "select": lambda x, axis, i: np.take(x, i, axis), "index_select": lambda x, axis, i: np.take(x, i, axis),
    "diagonal": lambda x, offset=0, dim1=0, dim2=1: np.diagonal(x, offset, dim1, dim2), "diag": np.diag,
    "zeros_like": _like(0.0), "ones_like": _like(1.0), "full_like": ARRAYS["full_like"],
    "new_zeros": lambda x, *n, **_: np.zeros(_flat(n)).astype(object), "numel": np.size, "dim": np.ndim,
    "clone": lambda x, **_: np.array(x), "contiguous": _SELF, "to": _SELF, "double": _SELF, "type": _SELF,
    "type_as": _SELF, "positive": _SELF, "sinc": ARRAYS["sinc"],
    "any": ARRAYS["any"], "all": ARRAYS["all"], "is_floating_point": lambda x: True, "is_complex": lambda x: False,
    **{name: partial(_each, f"arc{name.removeprefix('arc').removeprefix('a')}") for name in (
        "asin", "acos", "atan", "asinh", "acosh", "atanh", "arcsin", "arccos", "arctan", "arcsinh", "arccosh",
        "arctanh", "atan2")},
    **{name: partial(_each, name) for name in (
        "exp", "exp2", "expm1", "log", "log2", "log10", "log1p", "sin", "cos", "tan", "tanh", "sinh", "cosh", "sqrt",
        "sign", "floor", "ceil", "trunc", "erf", "erfc", "reciprocal", "deg2rad", "rad2deg", "square", "fmod", "hypot",
        "maximum", "minimum", "remainder", "logaddexp", "heaviside", "logical_and", "logical_or", "logical_not")},
    **{name: partial(_each, of) for name, of in (
        ("lt", "less"), ("le", "less_equal"), ("gt", "greater"), ("ge", "greater_equal"), ("eq", "equal"),
        ("ne", "not_equal"), ("and", "logical_and"), ("or", "logical_or"), ("invert", "logical_not"),
        ("abs", "absolute"), ("pow", "power"), ("mod", "remainder"), ("sigmoid", "expit"), ("lgamma", "gammaln"),
        ("digamma", "psi"), ("special_erf", "erf"), ("special_erfc", "erfc"), ("special_expit", "expit"),
        ("special_gammaln", "gammaln"))},
}
# fmt: on
_LONG = {"subtract": "sub", "multiply": "mul", "divide": "div", "truediv": "div", "negative": "neg", "absolute": "abs"}


def _torch_rule(name: str) -> Callable[..., Any] | None:
    """The rule of a function or method of torch, by its name, of an operator of tensors too."""
    if name in TORCH:
        return TORCH[name]
    bare = name.strip("_")
    if name.startswith("__") and bare[:1] in "ri" and _LONG.get(bare[1:], bare[1:]) in TORCH:
        rule = TORCH[_LONG.get(bare[1:], bare[1:])]
        return (lambda x, y: rule(y, x)) if bare[0] == "r" else rule
    if name.endswith("_") and not name.startswith("_"):
        return None  # in place, of a tensor
    return TORCH.get(_LONG.get(bare, bare))


# recording ---------------------------------------------------------------------------------------------------------


class _Recorded(Recording):
    """Recorded operations of a function, in which roots are powers, as they are in formulas."""

    _inside = False
    limited = True  # while a function is recorded
    layers: list[_Layer] | None = None
    """Linear layers whose weights require gradients, where these are taken."""

    def record(self, name: str, args: Sequence[Any]) -> Any:
        if self.limited and len(self) > MOST_OPERATIONS:
            raise Untraceable(f"it has more than {MOST_OPERATIONS:,} operations for one state")
        found = None if self._inside or len(args) != 2 else self._as_power(name, *args)
        if found is None:
            return super().record(name, args)
        base, n, factor = found
        self._inside = True
        power = super().record("pow", (base, n))
        self._inside = False
        return power if factor is None else super().record("mul", (factor, power))

    def _as_power(self, name: str, a: Any, b: Any) -> tuple[Any, float, Any] | None:
        """A power of a root, or a quotient by a root or a power: its base, its exponent, a factor."""
        if name == "div" and isinstance(b, Traced):
            if b.name == "sqrt":
                return b.args[0], -0.5, a
            if b.name == "pow" and isinstance(n := b.args[1], float):
                root = isinstance(x := b.args[0], Traced) and x.name == "sqrt" and n % 2 == 1
                return (x.args[0], -n / 2, a) if root else (x, -n, a)
        root = name == "pow" and isinstance(a, Traced) and a.name == "sqrt" and isinstance(b, float | int)
        return (a.args[0], b / 2, None) if root and b % 2 == 1 else None


class _Layer(NamedTuple):
    """A linear layer as it was called: from numbers to new ones."""

    weight: Any
    bias: Any
    given: np.ndarray
    results: list[Traced]


def _linear_layer(x: Any, weight: Any, bias: Any = None) -> np.ndarray | None:
    """The results of a layer as new numbers, where layers are taken; None of one that is written out."""
    numbers = _raw(x) if isinstance(x, TracedArray) else _objects(x)
    recording = next((n.recording for n in numbers.flat if isinstance(n, Traced)), None)
    layers = recording.layers if isinstance(recording, _Recorded) else None
    tensors = [w for w in (weight, bias) if w is not None]
    if layers is None and not any(w.requires_grad for w in tensors):
        return None
    if (
        recording is None
        or layers is None
        or not all(is_tensor(w) and w.is_leaf and w.device.type == "cpu" for w in tensors)
    ):
        raise Untraceable(WEIGHTS)
    if numbers.ndim != 1:
        raise Untraceable("a linear layer of a matrix has no rule")
    results = [recording.input(f"layer{len(layers)}_{i}") for i in range(len(weight))]
    layers.append(_Layer(weight, bias, numbers, results))
    return np.array(results, dtype=object)


class Chain(NamedTuple):
    """A function of x (n,): linear layers one after the other, with a function of each number between two of them.

    `first` goes from x to the input of the first layer, each of `between` from one number to one, behind each layer but
    the last, and `last` from x and the output of the last layer to the value. `layers` are pairs of a weight (to, from)
    and a bias (to,), or None.
    """

    first: Program
    between: list[Program]
    last: Program
    layers: list[tuple[Any, Any]]


NO_CHAIN = "its linear layers do not follow one another with the same function between all features"


def trace_chain(function: Callable[..., Any], names: Sequence[str]) -> Chain:
    """Record a function of a tensor with linear layers, whose weights may change: see `trace`."""
    recording = _Recorded()
    layers: list[_Layer] = []
    recording.layers = layers
    inputs, value = _recorded(recording, function, [names], True)
    if not layers:
        raise Untraceable(WEIGHTS)
    first, between = Program(inputs, list(layers[0].given)), []
    _check_inputs(first, inputs)
    for before, layer in pairwise(layers):
        if len(layer.given) != len(before.results):
            raise Untraceable(NO_CHAIN)
        each = [Program([z], [x]) for z, x in zip(before.results, layer.given, strict=True)]
        for program, z in zip(each, before.results, strict=True):
            _check_inputs(program, [z])
        between.append(traced(each[0], "a"))
        if len({str(traced(program, "a")) for program in each}) > 1:
            raise Untraceable(NO_CHAIN)
    last = Program([*inputs, *layers[-1].results], [value])
    _check_inputs(last, last.inputs)
    return Chain(first, between, last, [(layer.weight, layer.bias) for layer in layers])


def _check_inputs(program: Program, inputs: Sequence[Traced]) -> None:
    """Refuse a program that depends on other numbers than these."""
    known = {x.order for x in inputs}
    if any(x.name == "input" and x.order not in known for x in reached(program.outputs)):
        raise Untraceable(NO_CHAIN)


class _Followed:
    """The tensors that require gradients in a function, whose numbers are inputs of its program."""

    def __init__(self, recording: Recording) -> None:
        self._recording, self.tensors, self.inputs = recording, list[Any](), list[Traced]()
        self._arrays: dict[int, np.ndarray] = {}

    def numbers(self, x: Any) -> np.ndarray:
        """The numbers of a tensor, the same each time."""
        if id(x) not in self._arrays:
            n, count = len(self.inputs), x.numel()
            if not x.is_leaf or x.device.type != "cpu" or n + count > MOST_FOLLOWED:
                raise Untraceable(WEIGHTS)
            made = [self._recording.input(f"number{i}") for i in range(n, n + count)]
            array: np.ndarray = np.empty(count, dtype=object)
            array[:] = made
            self.tensors.append(x)
            self.inputs += made
            self._arrays[id(x)] = array.reshape(tuple(x.shape))
        return self._arrays[id(x)]


_followed: ContextVar[_Followed | None] = ContextVar("followed", default=None)


def _requires_gradients(x: Any) -> bool:
    return builtins.any(map(_requires_gradients, x)) if type(x) in (list, tuple) else is_tensor(x) and x.requires_grad


@contextmanager
def _following(recording: Recording) -> Iterator[_Followed]:
    """Record what is done with tensors that require gradients, by functions of torch of these alone too."""
    from torch.overrides import TorchFunctionMode

    class Mode(TorchFunctionMode):
        def __torch_function__(self, function: Any, types: Any, args: Any = (), options: Any = None) -> Any:
            name, options = getattr(function, "__name__", str(function)), options or {}
            if not _requires_gradients((*args, *options.values())):
                return function(*args, **options)
            rule = operator.getitem if name == "__getitem__" else _torch_rule(name)
            if rule is not None:
                return _by_rule(rule, args, options)
            found = function(*args, **options) if name in ("__get__", "size", "__len__", "__hash__") else args[0]
            if is_tensor(found) and not (name == "__get__" and found.is_leaf and found.requires_grad):
                raise Untraceable(WEIGHTS)
            return found

    token = _followed.set(followed := _Followed(recording))
    try:
        with Mode():
            yield followed
    finally:
        _followed.reset(token)


def trace_followed(function: Callable[..., Any], names: Sequence[Sequence[str] | str]) -> tuple[Program, list[Any]]:
    """Record a function of tensors, and of the numbers of tensors in it that require gradients: with these tensors."""
    recording = _Recorded()
    with _following(recording) as followed:
        inputs, value = _recorded(recording, function, names, True)
    return Program([*inputs, *followed.inputs], [value]), followed.tensors


def trace(function: Callable[..., Any], names: Sequence[Sequence[str] | str], torch: bool = False) -> Program:
    """Record a function of arrays, or of tensors (`torch`), which returns one number; raises `Untraceable` if it
    cannot.

    `names` has, for each argument, the names of the elements of an array, or the name of a number.
    """
    inputs, value = _recorded(_Recorded(), function, names, torch)
    return Program(inputs, [value])


def _recorded(
    recording: _Recorded, function: Callable[..., Any], names: Sequence[Sequence[str] | str], torch: bool
) -> tuple[list[Traced], Any]:
    """The inputs and the value of a function."""
    if sum(1 if isinstance(each, str) else len(each) for each in names) > MOST_VARIABLES:
        raise Untraceable(
            f"it has more than {MOST_VARIABLES} variables: give one site or pair, to HamiltonianSystem.lattice or pairs"
        )
    kind = TracedTensor if torch else TracedArray
    inputs, args = [], []
    for each in names:
        numbers = [recording.input(name) for name in ([each] if isinstance(each, str) else each)]
        array: np.ndarray = np.empty(len(numbers), dtype=object)
        array[:] = numbers
        array = array[0:1].reshape(()) if isinstance(each, str) else array
        array.flags.writeable = False
        inputs += numbers
        args.append(np.ndarray.view(array, kind))
    try:
        with warnings.catch_warnings(), np.errstate(all="ignore"), recorded_splines(_is_traced, _like_this):
            warnings.simplefilter("ignore")
            value = _objects(_plain(function(*args)))
    except Untraceable:
        raise
    except NotRecorded as error:
        raise Untraceable(str(error)) from error
    except RecursionError as error:
        raise Untraceable("it is too deep to be traced") from error
    except Exception as error:  # whatever a user's function raises
        shown = str(error).splitlines()[0] if str(error) else ""
        known = {"in place of a branch": BRANCH, "no float()": VALUE}
        reason = next((r for part, r in known.items() if part in shown), f"{type(error).__name__}: {shown[:160]}")
        raise Untraceable(reason) from error
    recording.limited = False
    if value.shape != () or not isinstance(value[()], Traced | float | int | np.number):
        raise Untraceable(f"it returns an array of shape {value.shape} for one state")
    return inputs, value[()]
