"""The arguments of `solve`, checked before anything runs: an error names the argument and ends with the remedy."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from sympflow.arrays import Array, is_tensor, to_numpy
from sympflow.events import EventSearch, parse
from sympflow.integrators.base import Integrator, Problem
from sympflow.system import HamiltonianSystem

MAX_SAVED_VALUES = 10_000_000
MAX_ASKED_VALUES = 1_000_000_000
"""Of a batch, or of outputs that were asked for one by one: 8 GB."""
MAX_EVENT_SAMPLES = 100_000_000
_FLOAT64 = np.dtype(np.float64)
_PLAIN = {float, int}
FEWEST_TIMES = 8  # floating-point numbers that an interval must span


def check_t_span(t_span: Any) -> tuple[float, float]:
    try:
        if type(t_span) is tuple and len(t_span) == 2 and {type(t_span[0]), type(t_span[1])} <= _PLAIN:
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
        raise ValueError(f"`t_span` must be finite; got ({t0:g}, {t1:g}). Choose an end that can be reached.")
    spacing = math.ulp(max(abs(t0), abs(t1)))
    if 0 < abs(t1 - t0) < FEWEST_TIMES * spacing:
        raise ValueError(
            f"`t_span` spans fewer than {FEWEST_TIMES} floating-point numbers, which are {spacing:g} apart there; got "
            f"({t0!r}, {t1!r}). Start at 0: H does not depend on time."
        )
    return t0, t1


def _real(x: Any) -> float:
    if type(x) is float or type(x) is int:
        return float(x)
    if np.iscomplexobj(x):  # NumPy's complex numbers would lose their imaginary part with a warning
        raise TypeError("a complex number")
    return float(x)


def check_y0(system: HamiltonianSystem, y0: Any, dtype: Any) -> Array:
    if y0 is None:
        raise ValueError(f"`y0` is needed: the system {system.name!r} has no default initial state.")
    size = 2 * system.ndof
    if is_tensor(y0):
        if dtype is not None:
            raise TypeError("`dtype` is for NumPy states: convert the tensor `y0` instead.")
        if str(y0.dtype) not in ("torch.float32", "torch.float64"):
            raise TypeError(
                f"`y0` must be a real floating-point tensor of 32 or 64 bits; got {y0.dtype}. Use y0.double()."
            )
        if str(y0.layout) != "torch.strided" or y0.device.type == "meta":
            raise TypeError(
                f"`y0` must be a dense tensor with values; got {y0.layout} on {y0.device}. Use y0.to_dense()."
            )
    else:
        y0 = _as_floats(y0, _check_dtype(dtype))
    if y0.ndim == 0 or y0.shape[-1] != size:
        raise ValueError(
            f"`y0` must have shape (..., {size}) for {system.name!r}, [q, p] with {system.ndof} each; got "
            f"{tuple(y0.shape)}."
        )
    if math.prod(y0.shape) == 0:
        raise ValueError(f"`y0` is an empty batch, of shape {tuple(y0.shape)}: pass at least one state.")
    if np.count_nonzero(np.isfinite(to_numpy(y0))) < math.prod(y0.shape):
        raise ValueError("`y0` must be finite; it holds NaN or infinity. Remove these states.")
    return y0


def _as_floats(y0: Any, dtype: np.dtype) -> np.ndarray:
    if type(y0) is np.ndarray and y0.dtype == dtype and y0.size <= MAX_ASKED_VALUES:
        return y0.copy()
    try:
        array = np.asarray(y0)
        if not np.issubdtype(array.dtype, np.number):
            raise TypeError(f"dtype {array.dtype}")
    except (TypeError, ValueError) as error:
        raise TypeError(f"`y0` must be an array of numbers; got {error}. Pass numbers of shape (..., 2d).") from error
    if np.ma.is_masked(y0):
        raise ValueError("`y0` has masked entries: fill them, or leave these states out.")
    if np.iscomplexobj(array):
        raise TypeError("`y0` must be real; got complex numbers. Use y0.real if the imaginary part is zero.")
    if array.size > MAX_ASKED_VALUES:
        raise ValueError(f"`y0` has {array.size:.3g} numbers, more than {MAX_ASKED_VALUES:.0e}: solve in parts.")
    with np.errstate(over="ignore"):  # what is infinite in float32 is refused as such
        return array.astype(dtype)


def _check_dtype(dtype: Any) -> np.dtype:
    if dtype is None:
        return _FLOAT64
    try:
        chosen = np.dtype(dtype)
    except Exception:  # NumPy raises errors of many kinds
        chosen = np.dtype(object)
    if chosen not in (np.float32, np.float64):
        raise ValueError(f"`dtype` must be 'float32' or 'float64'; got {dtype!r}.")
    return chosen


def check_t_eval(t_eval: Any, t0: float, t1: float) -> np.ndarray:
    plain = type(t_eval) is np.ndarray and t_eval.dtype == _FLOAT64 and t_eval.ndim == 1
    if plain and 0 < t_eval.size <= MAX_SAVED_VALUES and _proper(t_eval, t0, t1):
        return t_eval.copy()
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
    if times.size and not (times.min() >= low and times.max() <= high):
        raise ValueError(f"`t_eval` must lie within `t_span`, [{low:g}, {high:g}]: extend `t_span` or drop times.")
    if (np.diff(times) * (1 if t1 >= t0 else -1) < 0).any():
        raise ValueError("`t_eval` must be ordered from the start of `t_span` to its end: sort it.")
    return times


def _proper(times: np.ndarray, t0: float, t1: float) -> bool:
    """Whether times lie between t0 and t1, in this order."""
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
            raise ValueError(f"`{name}` must be a positive integer; got {value!r}.")


def check_events(y0: Array, events: Any, event_step: Any, duration: float) -> EventSearch | None:
    parsed = parse(events)
    if not parsed:
        if event_step is not None:
            raise ValueError("`event_step` samples events, but there are none: pass `events`, or leave it out.")
        return None if events is None else EventSearch(())
    if y0.ndim != 1:
        raise ValueError(
            f"`events` are found along one trajectory, but `y0` is a batch of shape {tuple(y0.shape)}: solve one state "
            "at a time, or use poincare_section, which takes batches."
        )
    if event_step is None:
        return EventSearch(parsed)
    if not (isinstance(event_step, int | float | np.number) and event_step > 0):
        raise ValueError(f"`event_step` must be a positive number, a time; got {event_step!r}.")
    if duration > MAX_EVENT_SAMPLES * event_step:
        raise ValueError(
            f"`event_step` {event_step:g} would take more than {MAX_EVENT_SAMPLES:.0e} samples over a time of "
            f"{duration:g}: increase it."
        )
    return EventSearch(parsed, float(event_step))


def check_memory(integrator: Integrator, problem: Problem) -> None:
    """Refuse runs whose outputs would fill the memory."""
    size = math.prod(problem.y0.shape)
    if problem.t_eval is not None and problem.t_eval.size * size > MAX_ASKED_VALUES:
        raise ValueError(
            f"`t_eval` asks for {problem.t_eval.size * size:.3g} values, more than {MAX_ASKED_VALUES:.0e}: choose "
            "fewer times, or solve in parts."
        )
    if problem.t_eval is not None and not problem.dense_output:
        return
    length = getattr(integrator, "step_length", lambda system: None)(problem.system)
    if length is None:
        return
    n_steps = abs(problem.t1 - problem.t0) / length
    stored = n_steps if problem.dense_output else n_steps / problem.save_every
    values = (stored + 1) * size
    if values > MAX_SAVED_VALUES:
        raise ValueError(
            f"`t_eval` is not given, so {values:.3g} values ({values * 8 / 2**30:.3g} GiB) would be stored, more than "
            f"{MAX_SAVED_VALUES:.0e}: choose the times with `t_eval`, or thin them with `save_every`"
            f"{', or leave dense_output out' if problem.dense_output else ''}."
        )
