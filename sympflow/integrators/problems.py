"""Checks of an initial value problem and of its outputs: a message names the argument."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

from sympflow.arguments import MAX_ASKED_VALUES, MAX_SAVED_VALUES, as_float, check_array
from sympflow.arrays import Array, copied, expanded, finite_states, is_tensor, readable
from sympflow.events import EventSearch, parse
from sympflow.hamiltonian.system import HamiltonianSystem
from sympflow.integrators.contract import Integrator, Problem

if TYPE_CHECKING:
    from sympflow.hamiltonian.parameter_rows import ParameterRows

BACKENDS = ("auto", "compiled", "array")
MAX_EVENT_SAMPLES = 100_000_000
_FLOAT64 = np.dtype(np.float64)


def check_backend(backend: Any, integrator: Integrator) -> None:
    """Raise a ValueError for an unknown backend, or one that the method does not have."""
    if not isinstance(backend, str) or backend not in BACKENDS:
        raise ValueError(
            f"`backend` must be one of {', '.join(map(repr, BACKENDS))}; got {backend!r}: for a GPU pass tensors on it."
        )
    if backend == "compiled" and not integrator.compiles:
        raise ValueError(f"`backend` 'compiled' does not apply to method {integrator.name!r}: use 'auto'.")


def check_y0(system: HamiltonianSystem, y0: Any, dtype: Any) -> Array:
    if y0 is None:
        raise ValueError(
            f"`y0` is needed: {system.title} has no initial state. Pass [q, p], {2 * system.ndof:,} numbers."
        )
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
        y0 = system.lift(y0)
    if math.prod(y0.shape) == 0:
        raise ValueError(f"`y0` is an empty batch, of shape {tuple(y0.shape)}: pass at least one state.")
    if not (np.isfinite(y0) if type(y0) is np.ndarray else finite_states(y0)).all():
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


def check_params(
    system: HamiltonianSystem, params: Any, y0: Array, integrator: Integrator
) -> tuple[ParameterRows, Array]:
    """The parameters of each trajectory, and y0 broadcast with them."""
    from sympflow.hamiltonian.parameter_rows import checked_rows

    rows = checked_rows(system, params, tuple(y0.shape[:-1]))
    check_own_parameters(system, rows.values, integrator)
    y = expanded(y0, (*rows.shape, y0.shape[-1]))
    return rows, y if y is y0 else copied(y)


def check_own_parameters(system: HamiltonianSystem, values: Mapping[str, ArrayLike], integrator: Integrator) -> None:
    """Refuse a trained flow for other parameters than its system's, and a sweep from where H is constant in time."""
    definition = system.definition
    if values and definition.symbolic and not definition.timed and definition.named_time is not None:
        raise ValueError(
            "`params` would make H depend on t, but with the values of `system` it does not: pass a system whose H "
            "depends on t, as by system.with_params(...)."
        )
    if not integrator.trained:
        return
    other = [name for name, value in values.items() if np.any(np.asarray(value) != system.params[name])]
    if other:
        own = ", ".join(f"{name} = {system.params[name]:.9g}" for name in other)
        raise ValueError(
            f"`params` changes {', '.join(other)}, and a trained flow, as of method {integrator.name!r}, holds for "
            f"its own parameters ({own}): train one for each value, or use a classical method such as 'kahan_li8'."
        )


def check_events(events: Any, event_step: Any) -> EventSearch | None:
    parsed = parse(events)
    if not parsed:
        if event_step is not None:
            raise ValueError("`event_step` samples events, but there are none: pass `events`, or leave it out.")
        return None if events is None else EventSearch(())
    if event_step is None:
        return EventSearch(parsed)
    if not as_float(event_step) > 0:
        raise ValueError(f"`event_step` must be a positive number, a time; got {event_step!r}.")
    return EventSearch(parsed, float(event_step))


def check_event_search(search: EventSearch, y0: Array, duration: float) -> None:
    """Refuse events along a batch, and samples of them that would never end."""
    if search.events and not readable(y0):
        raise ValueError(
            "`events` are found by the values of the states, which torch.func.vmap and torch.compile hide: call solve "
            "outside of them, one state at a time."
        )
    if search.events and y0.ndim != 1:
        raise ValueError(
            f"`events` are found along one trajectory, but `y0` is a batch of shape {tuple(y0.shape)}: solve one state "
            "at a time, or use poincare_section, which takes batches."
        )
    if search.max_interval is not None and MAX_EVENT_SAMPLES * search.max_interval < duration < math.inf:
        raise ValueError(
            f"`event_step` {search.max_interval:g} would take more than {MAX_EVENT_SAMPLES:.0e} samples over a time of "
            f"{duration:g}: increase it."
        )


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
    length = integrator.step_length(problem.system) if problem.dense_output else integrator.output_step(problem)
    if length is None:
        return
    n_steps = abs(problem.t1 - problem.t0) / length
    stored = n_steps if problem.dense_output else n_steps / problem.save_every
    values = (stored + 1) * size
    if values > MAX_SAVED_VALUES:
        system, own = problem.system, ""
        if (problem.t0, problem.t1) == system.t_span and length > 0.5 * system.dt:
            own = (
                f"`t_span` ({problem.t0:g}, {problem.t1:g}), the system's, is {n_steps:.3g} steps of {length:.3g}, "
                "which suit its motion: pass a shorter one. "
            )
        raise ValueError(
            f"{own}`t_eval` is not given, so {values:.3g} values ({values * 8 / 2**30:.3g} GiB) would be stored, more "
            f"than {MAX_SAVED_VALUES:.0e}: choose the times with `t_eval`, or thin them with `save_every`"
            f"{', or leave dense_output out' if problem.dense_output else ''}."
        )


def check_stored(problem: Problem, action: str, rows: ParameterRows | None) -> None:
    """Refuse options that a store does not support, with the reason."""
    check_array(problem.y0, "a `store` takes NumPy states, because it keeps no gradients", "y0.detach().numpy()")
    if problem.events is not None and problem.events.events:
        raise ValueError(
            "`store` does not go with `events`, whose zeros are kept in memory: store the outputs, and look for the "
            "zeros in them, or leave `store` out."
        )
    if problem.dense_output:
        raise ValueError(
            "`store` does not go with `dense_output`, which keeps every step in memory: choose times by `t_eval`."
        )
    if action == "stop":
        raise ValueError("`store` takes no `on_domain_exit` 'stop': use 'warn'.")
    if rows is not None and not rows.uniform:
        raise ValueError(
            "`store` is for trajectories of the same `params`: use sympflow.ensemble(..., params=..., store=...)."
        )
