"""Arguments, checked before anything runs: an error names the argument and ends with the remedy."""

from __future__ import annotations

import difflib
import inspect
import math
import os
import reprlib
import secrets
import sys
import warnings
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from functools import wraps
from math import isfinite
from pathlib import Path
from types import FunctionType
from typing import Any, ParamSpec, TypeVar

import numpy as np
from numpy.typing import ArrayLike

from sympflow.arrays import differentiable, is_tensor, to_numpy, without_torch

P = ParamSpec("P")
T = TypeVar("T")
MAX_SAVED_VALUES = 10_000_000
MAX_ASKED_VALUES = 1_000_000_000  # values of a batch, or of outputs that were asked for one by one: 8 GB
LONGEST_STEP = 1e100  # beyond it the powers of dt in a step overflow
_FLOAT64 = np.dtype(np.float64)
_PLAIN = {float, int}
FEWEST_TIMES = 8  # floating-point numbers that an interval must span
_MOST_SAMPLES = 100_000_000


def check_t_span(t_span: Any, ends_by_event: bool | None = None) -> tuple[float, float]:
    """Return the start and end, two finite numbers; the end may be infinite if the run `ends_by_event`."""
    plain = type(t_span) is tuple and len(t_span) == 2 and {type(t_span[0]), type(t_span[1])} <= _PLAIN
    if not plain:
        check_not_followed("t_span", t_span)
    try:
        if plain:
            t0, t1 = float(t_span[0]), float(t_span[1])
        elif isinstance(t_span, str | bytes | set | frozenset | dict):
            raise TypeError(type(t_span).__name__)
        else:
            t0, t1 = (_real(t) for t in t_span)
    except (TypeError, ValueError) as error:
        raise ValueError(
            f"`t_span` must be two numbers, start and end; got {t_span!r}: pass a tuple such as (0, 100)."
        ) from error
    except OverflowError:
        t0, t1 = -math.inf, math.inf
    if not math.isfinite(t1 - t0):
        endless = math.isfinite(t0) and math.isinf(t1)
        if endless and ends_by_event:
            return t0, t1
        remedy = ", or pass a terminal event" if endless and ends_by_event is not None else ""
        raise ValueError(f"`t_span` must be finite; got ({t0:g}, {t1:g}). Choose an end that can be reached{remedy}.")
    spacing = math.ulp(max(abs(t0), abs(t1)))
    if 0 < abs(t1 - t0) < FEWEST_TIMES * spacing:
        raise ValueError(
            f"`t_span` spans fewer than {FEWEST_TIMES} floating-point numbers, which are {spacing:g} apart there; got "
            f"({t0!r}, {t1!r}). Start at 0: H does not depend on time."
        )
    return t0, t1


def check_not_followed(name: str, times: Any) -> None:
    """Raise a TypeError if times carry derivatives: where times are numbers they would be dropped in silence."""
    parts = times if type(times) in (tuple, list) else (times,)
    for t in parts:
        if type(t) is float or not differentiable(t):
            continue
        raise TypeError(
            f"`{name}` is a tensor that torch differentiates or transforms, but the times of a solution are numbers: "
            "use sympflow.interop.torchdiffeq.odeint, whose times are differentiated, or pass `.detach()`."
        )


def check_kept(name: str, value: Any) -> None:
    """Raise a TypeError if a number that a system keeps carries derivatives, which would be dropped in silence."""
    if differentiable(value):
        raise TypeError(
            f"`{name}` is a tensor that torch differentiates or transforms, but it is kept as numbers: pass "
            "`.detach()`, and the tensor itself to each run, as in solve(..., params={name: tensor}); or write H with "
            "it, as HamiltonianSystem(hamiltonian=...)."
        )


def check_array(y0: Any, but: str, remedy: str = "y0.numpy()") -> None:
    """Raise a TypeError if `y0` is a tensor; `but` is a clause on what takes none."""
    if is_tensor(y0):
        raise TypeError(f"`y0` is a tensor, but {but}: pass {remedy}.")


def check_not_traced(function: str) -> None:
    """Raise a TypeError in a graph that `torch.compile` traces, which cannot contain a whole run."""
    torch = sys.modules.get("torch")
    if torch is not None and torch.compiler.is_dynamo_compiling():
        raise TypeError(
            f"`{function}` looks at values, which torch.compile hides: compile the steps, "
            'sympflow.get("verlet")().step(system, t, y, h), or a flow, flow(t, y) with a number t.'
        )


def _real(x: Any) -> float:
    if type(x) is float or type(x) is int:
        return float(x)
    if np.iscomplexobj(x):  # NumPy's complex numbers would lose their imaginary part with a warning
        raise TypeError("a complex number")
    return float(x)


def check_t_eval(t_eval: Any, t0: float, t1: float) -> np.ndarray:
    plain = type(t_eval) is np.ndarray and t_eval.dtype == _FLOAT64 and t_eval.ndim == 1
    if plain and 0 < t_eval.size <= MAX_SAVED_VALUES and _proper(t_eval, t0, t1):
        return t_eval.copy()
    check_not_followed("t_eval", t_eval)
    try:
        times = to_numpy(t_eval)
        if times.dtype.kind not in "fiu":
            raise TypeError(f"dtype {times.dtype}")
    except (TypeError, ValueError) as error:
        raise TypeError(f"`t_eval` must be real numbers; got {error}. Pass times such as [0.5, 1.0].") from error
    if np.ma.is_masked(t_eval):
        raise ValueError("`t_eval` has masked entries: fill them, or leave these times out.")
    if times.ndim != 1:
        raise ValueError(f"`t_eval` must be one-dimensional; got shape {times.shape}: pass a list of times.")
    if times.size > MAX_ASKED_VALUES:
        raise ValueError(f"`t_eval` has {times.size:.3g} times, more than {MAX_ASKED_VALUES:.0e}: choose fewer.")
    times = times.astype(float)
    if times.size and _proper(times, t0, t1):
        return times
    low, high = min(t0, t1), max(t0, t1)
    if not np.isfinite(times).all():
        raise ValueError("`t_eval` must be finite: drop the times that are NaN or infinite.")
    if times.size and not (times.min() >= low and times.max() <= high):
        raise ValueError(f"`t_eval` must lie within `t_span`, [{low:g}, {high:g}]: extend `t_span` or drop times.")
    if (np.diff(times) * (1 if t1 >= t0 else -1) < 0).any():
        raise ValueError("`t_eval` must be ordered from the start of `t_span` to its end: sort it.")
    return times


def _proper(times: np.ndarray, t0: float, t1: float) -> bool:
    """True if times lie between t0 and t1, in this order."""
    first, last = float(times[0]), float(times[-1])
    if not (t0 <= first <= last <= t1 if t0 <= t1 else t0 >= first >= last >= t1):
        return False
    if len(times) == 1:
        return True
    ordered = times[:-1] <= times[1:] if t0 <= t1 else times[:-1] >= times[1:]
    return int(np.count_nonzero(ordered)) == len(times) - 1


def check_save_every(save_every: Any, times: np.ndarray | None) -> int:
    if save_every is None:
        return 1
    if times is not None:
        raise ValueError("`save_every` and `t_eval` both choose the outputs: give one of them.")
    check_counts(save_every=save_every)
    return min(int(save_every), 2**53)


def check_counts(**values: Any) -> None:
    """Positive integers."""
    for name, value in values.items():
        if isinstance(value, bool) or not isinstance(value, int | np.integer) or value < 1:
            raise ValueError(f"`{name}` must be a positive integer; got {value!r}: give 1 or more.")


def positive_numbers(name: str, values: Any) -> list[float]:
    """Return a list of positive and finite numbers, sorted; raise if it is none, or is empty."""
    try:
        if isinstance(values, str) or any(isinstance(x, bool | np.bool_ | str) for x in values):
            raise TypeError("no numbers")
        numbers = sorted(float(x) for x in values)
    except (TypeError, ValueError, OverflowError) as error:
        raise TypeError(f"`{name}` must be a list of positive numbers; got {values!r}.") from error
    if not numbers:
        raise ValueError(f"`{name}` is empty: give at least one number, or leave it out.")
    if not all(0 < x < math.inf for x in numbers):
        raise ValueError(f"`{name}` must be positive and finite; got {values!r}.")
    return numbers


def check_dt(dt: Any) -> None:
    """Raise unless `dt` is None or a step length."""
    if dt is not None and not 0 < as_float(dt) <= LONGEST_STEP:
        raise ValueError(f"`dt` must be a positive and finite number, at most {LONGEST_STEP:g}; got {dt!r}.")


def as_float(value: Any) -> float:
    """Return a real number as a float; NaN for anything else, an integer beyond floats among it."""
    if isinstance(value, bool | np.bool_) or not isinstance(value, int | float | np.floating | np.integer):
        return math.nan
    try:
        return float(value)
    except OverflowError:
        return math.nan


def check_positive(name: str, value: Any, most: float = sys.float_info.max) -> Any:
    """Return the argument `name`; raise unless it is a positive and finite real number."""
    if not 0 < as_float(value) <= most:
        raise ValueError(f"`{name}` must be positive and finite; got {value!r}: give a number above 0.")
    return value


def checked_number(name: str, value: Any, what: str = "a finite number", fits: Callable[[Any], bool] = isfinite) -> Any:
    """Return the argument `name`; raise unless it is a real number that fits, which the message says in words."""
    if not fits(as_float(value)):
        raise ValueError(f"`{name}` must be {what}; got {value!r}.")
    return value


NOT_NEGATIVE = "finite and not negative"


def not_negative(x: Any) -> bool:
    """Return True for a finite number that is 0 or more."""
    return 0 <= x < math.inf


def checked_count(name: str, value: Any, low: int, high: int, what: str) -> int:
    """Return the argument `name`, a whole number from `low` to `high`, which the message says in words."""
    return int(checked_number(name, value, what, lambda n: low <= n <= high and int(n) == n))


def check_one_of(name: str, value: Any, known: Iterable[str]) -> None:
    """Raise unless the argument `name` is one of the known words."""
    words = list(known)
    if not isinstance(value, str) or value not in words:
        raise ValueError(f"`{name}` must be one of {', '.join(map(repr, words))}; got {value!r}.")


def check_flag(name: str, value: Any) -> None:
    """Raise unless the option `name` is True or False."""
    if not isinstance(value, (bool, np.bool_)):
        raise TypeError(f"`{name}` must be True or False; got {value!r}.")


def any_array(values: Any) -> np.ndarray:
    """Return values as an array, without entries where these are rows of different lengths."""
    try:
        return to_numpy(values)
    except ValueError:
        return np.empty(0, dtype=object)


def floats(name: str, value: Any) -> np.ndarray:
    """`value` as an array of floats, if it is one of real numbers."""
    array = any_array(value)
    if array.dtype.kind not in "fiu":
        raise TypeError(f"`{name}` must be made of real numbers; got {value!r}.")
    return array.astype(float)


def real_array(name: str, values: Any) -> np.ndarray:
    """Return an array of floats of the numbers that a system keeps; a TypeError where they are none."""
    check_kept(name, values)
    try:
        array = to_numpy(values)
        if array.dtype.kind not in "biufO":
            raise TypeError(f"of {array.dtype}")
        return array.astype(float)
    except (TypeError, ValueError, OverflowError) as error:
        shown = reprlib.repr(values)
        raise TypeError(f"`{name}` must be real numbers; got {shown}: pass a number or an array of them.") from error


def is_number_word(word: str) -> bool:
    """Return True for text that is a number."""
    try:
        float(word)
    except ValueError:
        return False
    return True


def real_number(value: Any) -> bool:
    """Return True for a real number of Python's or NumPy's, however large; False for a bool."""
    return isinstance(value, int | float | np.integer | np.floating) and not isinstance(value, bool)


def check_number(name: str, value: Any) -> None:
    """A TypeError unless `value` is a real number."""
    if not real_number(value):
        raise TypeError(f"`{name}` must be a number; got {value!r}.")


def vector(name: str, value: ArrayLike) -> tuple[float, ...]:
    """`value` as the finite numbers of a state [q, p], (2d,)."""
    array = floats(name, value)
    if array.ndim != 1 or array.size == 0 or array.size % 2:
        raise ValueError(f"`{name}` must have shape (2d,), one entry for each of [q, p]; got {array.shape}.")
    if not np.isfinite(array).all():
        raise ValueError(f"`{name}` must be finite; got {array.tolist()}.")
    return tuple(array.tolist())


def checked_states(x: ArrayLike, width: int) -> np.ndarray:
    """`x`, checked to be numbers of shape (..., width)."""
    array = any_array(x)
    if array.dtype.kind not in "fiu":
        raise TypeError(f"`x` must be states of real numbers; got {x!r}: pass an array of shape (..., {width}).")
    if array.ndim == 0 or array.shape[-1] != width:
        raise ValueError(
            f"`x` must have shape (..., {width}), states [q, p] of the domain; got {array.shape}: "
            "put them on the last axis."
        )
    return array


def sample_count(n: int) -> int:
    """`n` as an integer, at least one and not more than memory holds."""
    number = isinstance(n, int | float | np.number) and np.isfinite(n)
    if not number or n < 1 or int(n) != n:
        raise ValueError(f"`n` must be a positive integer; got {n!r}.")
    if n > _MOST_SAMPLES:
        raise ValueError(f"`n` must be at most {_MOST_SAMPLES:.0e}; got {n:.3g}: draw in parts, with several seeds.")
    return int(n)


def closest(name: str, known: Iterable[str], cutoff: float = 0.6) -> str:
    """The name that is closest to one, in any case of letters; "" where none is close."""
    by_letters = {each.lower(): each for each in reversed(list(known))}
    close = difflib.get_close_matches(name.lower(), by_letters, n=1, cutoff=cutoff)
    return by_letters[close[0]] if close else ""


def did_you_mean(name: str, known: Iterable[str], cutoff: float = 0.6) -> str:
    """A question after the name that is closest to one, with a space before it; "" where none is close."""
    close = closest(name, known, cutoff)
    return f" Did you mean {close!r}?" if close else ""


OF_RUNS = ("t_span", "y0", "dt", "tol", "params", "t_eval", "dense_output", "save_every", "events", "store")
INSTEAD = {
    "args": "values of parameters are in H, or given by `params`",
    **dict.fromkeys(("q0", "p0", "x0", "v0", "y_0", "ic", "u0"), "the initial state is `y0`, [q, p] in one array"),
    **dict.fromkeys(("initial_state", "initial_conditions"), "the initial state is `y0`, [q, p] in one array"),
    **dict.fromkeys(("h", "step", "step_size", "stepsize"), "the step of fixed-step methods is `dt`"),
    **dict.fromkeys(("timestep", "time_step", "dt0", "delta_t"), "the step of fixed-step methods is `dt`"),
    **dict.fromkeys(("n_steps", "num_steps", "steps"), "n steps over `t_span` are dt=(t1 - t0)/n"),
    **dict.fromkeys(("t_end", "t1", "T", "tmax", "t_max", "t0", "duration"), "times are `t_span`, (start, end)"),
    **dict.fromkeys(
        ("t", "ts", "times", "saveat", "save_at"), "times of outputs are `t_eval`, or every few steps by `save_every`"
    ),
    **dict.fromkeys(("integrator", "solver", "algorithm", "scheme"), "the method is `method`"),
    **dict.fromkeys(("abstol", "reltol"), "tolerances of adaptive methods are `rtol` and `atol`"),
    **dict.fromkeys(("jac", "vectorized", "fun"), "leave it out: forces and their derivatives follow from H"),
    **dict.fromkeys(("verbose", "progress_bar"), "a bar is `progress`"),
    **dict.fromkeys(("n_jobs", "n_workers", "num_workers"), "sympflow.ensemble has `workers`"),
    "dt": "steps to try are `steps`, and a method with one step is sympflow.get(name)(dt=...)",
    "tol": "the step for a tolerance is that of sympflow.choose_step(system, method, tol)",
    "budget": "how long is `repeats`, the number of timed runs",
    "plane": "the plane of a section is `coordinate` = `level`",
    "E": "the energy of a section is `energy`",
    "device": "pass `y0` as a tensor on that device",
    "lr": "a learning rate is one of a solver, solver=sympflow.Adam(learning_rate=...)",
    "epochs": "how long is `budget`, in seconds, or the steps of a solver, solver=sympflow.Adam(steps=...)",
}
"""Remedies for arguments by names that they have elsewhere."""


def advice(name: str, known: Iterable[str]) -> str:
    """The remedy for an argument that is not there, and the end of a sentence; "" if none is known."""
    if name in INSTEAD:
        return f"{INSTEAD[name]}."
    close = closest(name, known)
    return close and f"did you mean `{close}`?"


def told(function: Callable[P, T]) -> Callable[P, T]:
    """Decorate a function so that a call that does not fit its arguments raises a TypeError with the remedy."""

    @wraps(function)
    def call(*args: P.args, **options: P.kwargs) -> T:
        try:
            return function(*args, **options)
        except TypeError as error:
            if error.__traceback__ is None or error.__traceback__.tb_next is not None:
                raise  # within the function
        raise TypeError(_misfit(function, len(args), options))

    return call


def told_of_all(cls: type[T]) -> type[T]:
    """Decorate a class so that its constructors and its public methods are `told`."""
    for name, value in vars(cls).copy().items():
        if name.startswith("_") and name != "__init__":
            continue
        if isinstance(value, classmethod):
            setattr(cls, name, classmethod(told(value.__func__)))
        elif isinstance(value, FunctionType):
            setattr(cls, name, told(value))
    return cls


def _misfit(function: Callable[..., Any], given: int, options: dict[str, Any]) -> str:
    """The message for a call with so many arguments and these options, which the function does not take."""
    parameters = list(inspect.signature(function).parameters.values())
    *_, owner, name = ["", *function.__qualname__.split(".")]
    bound = bool(parameters) and parameters[0].name in ("self", "cls")
    parameters, given = parameters[bound:], given - bound
    call = owner if name == "__init__" else name
    named = [p for p in parameters if p.kind is not p.VAR_KEYWORD]
    names, more = [p.name for p in named], len(named) < len(parameters)
    ordered = [p.name for p in named if p.kind is p.POSITIONAL_OR_KEYWORD]
    missing = [p for p in named if p.default is p.empty and p.name not in (*options, *ordered[:given])]
    meant = [p.name for p in missing] if more else names
    unknown = [each for each in options if each not in names and (not more or closest(each, meant))]
    if unknown:
        remedy = advice(unknown[0], meant) or "remove it."
        if function.__module__.startswith("sympflow.systems"):
            remedy = "pass it to solve()." if unknown[0] in OF_RUNS else closest(unknown[0], names) and remedy
            remedy = remedy or "write your own H with it, by HamiltonianSystem.from_sympy."
        return f"`{unknown[0]}` is not an argument of {call}(), which takes {', '.join(names) or 'none'}: {remedy}"
    if given > len(ordered):
        rest = [*names[len(ordered) :], *["name"] * more]
        if not rest:
            return f"`{call}` takes {', '.join(names) or 'no arguments'}: leave the others out."
        after = f" after `{ordered[-1]}`" if ordered else ""
        return f"arguments of {call}(){after} are given by name: write {rest[0]}=value."
    if missing:
        by_name = [f"{p.name}=…" for p in missing if p.kind is p.KEYWORD_ONLY]
        return f"`{missing[0].name}` is missing: give it, {call}({', '.join([*ordered, *by_name])})."
    return f"`{next(name for name in options if name in ordered)}` is given twice, by place and by name: name it once."


def warn(message: str, category: type[Warning] = UserWarning) -> None:
    """Warn at the line outside of the package that led here."""
    frame, level = sys._getframe(1), 2
    while frame.f_back is not None and frame.f_globals.get("__name__", "").startswith("sympflow."):
        frame, level = frame.f_back, level + 1
    warnings.warn(message, category, stacklevel=level)


def plain(value: Any) -> Any:
    """A number of NumPy's or torch's as one of Python's, which JSON takes as well; anything else as it is."""
    array = without_torch(value)
    return array.item() if isinstance(array, np.generic | np.ndarray) and array.ndim == 0 else value


def writable(path: Any) -> Path:
    """`path` of a file to be written, its folder made."""
    if isinstance(path, bytes) or not isinstance(path, str | os.PathLike):
        raise TypeError(f"`path` must be a file name or a pathlib.Path; got {type(path).__name__}.")
    file = Path(os.fsdecode(path))
    if not str(path) or file.is_dir():
        raise ValueError(f"`path` {str(path)!r} is {'a folder' if str(path) else 'empty'}: name a file in a folder.")
    with naming_path(file):
        file.parent.mkdir(parents=True, exist_ok=True)
    return file


@contextmanager
def naming_path(path: Path) -> Iterator[None]:
    """Turn an error of the operating system about a file into a ValueError that names the argument."""
    try:
        yield
    except OSError as error:
        why = error.strerror or type(error).__name__
        raise ValueError(f"`path` {str(path)!r} cannot be written ({why}): name a file that can be.") from error


def put_file(path: Path, content: bytes, durable: bool = True) -> None:
    """Write a file beside its place and move it there in one step; `durable` once the disk has it.

    It is opened as any new file, and not by `tempfile`, so that its permissions follow the umask.
    """
    unfinished = path.with_name(f".new-{secrets.token_hex(8)}")
    opened = unfinished.open("xb")
    try:
        with opened as file:
            file.write(content)
            file.flush()
            if durable:
                os.fsync(file.fileno())
        os.replace(unfinished, path)
    except BaseException:
        unfinished.unlink(missing_ok=True)
        raise
