"""solve(): validates, picks the integrator, drives it, and returns a Solution."""

from __future__ import annotations

import math
import time
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from sympflow.arrays import Array, all_finite, is_tensor, to_numpy
from sympflow.domain import Box, Domain, EnergySublevel
from sympflow.events import run_and_search
from sympflow.integrators.base import Integrator, Outcome, Problem
from sympflow.integrators.registry import build, check_applies, naming_plugin
from sympflow.solution import Solution
from sympflow.system import HamiltonianSystem
from sympflow.validation import check_events, check_memory, check_save_every, check_t_eval, check_t_span, check_y0

_TRUE = np.array(True)
BACKENDS = ("auto", "compiled", "array")


def solve(
    system: HamiltonianSystem,
    method: Any = "sympflow",
    t_span: tuple[float, float] | None = None,
    y0: ArrayLike | Array | None = None,
    *,
    t_eval: ArrayLike | None = None,
    dense_output: bool = False,
    save_every: int | None = None,
    dtype: Any = None,
    events: Any = None,
    event_step: float | None = None,
    backend: str = "auto",
    on_domain_exit: str | None = None,
    **options: Any,
) -> Solution:
    """Solve x' = J∇H(x), x(t0) = y0.

    Parameters
    ----------
    system : HamiltonianSystem
    method : str, Integrator, or trained flow
        A name from `sympflow.available()`; or a configured integrator such as ``get("verlet")(dt=0.05)``; or a flow.
    t_span : (float, float), optional
        Start and end; the end may lie before the start. The default is the system's.
    y0 : array_like or tensor of shape (..., 2d), optional
        Initial state [q, p], or a batch of them. The default is the system's. A NumPy array gives float64 (integers are
        promoted); a tensor gives a tensor of its dtype and device, and gradients flow to it.
    t_eval : array_like of shape (n,), optional
        Times to report, ordered from start to end. The default is every step. No other state is stored.
    dense_output : bool
        Whether to return `sol`, a function of t. It stores the state after every step.
    save_every : int, optional
        Report every k-th step instead of each; not together with `t_eval`.
    dtype : "float32" or "float64", optional
        Precision for a NumPy `y0`.
    events : callable or list of callables, optional
        Functions g(t, y) of one state whose zeros are sought, as in SciPy: with the attribute `terminal` True, or a
        count, the solution ends at the zero of that number; with `direction` positive (negative) only zeros where g
        increases (decreases) count. They are located by Brent's method on the dense output, while the run streams by:
        no state is stored for them. For single trajectories; `poincare_section` takes batches.
    event_step : float, optional
        Longest time between two samples of the event functions; two zeros of one between two samples are missed. It
        never changes the run: longer steps are sampled within, by the dense output, as `max_step` does inside
        `solve_ivp`. The default is `system.dt` for fixed steps, which may be long, and every step for adaptive methods.
    backend : "auto", "compiled" or "array"
        "auto" runs splitting methods on symbolic systems (and on Numba functions) and float64 NumPy states compiled,
        everything else with array operations. What ran is in `stats["backend"]`.
    on_domain_exit : "warn", "stop" or "ignore", optional
        What to do when an output lies outside the domain Ω: "warn" puts the first exit into the message and the
        statistics, "stop" ends there with status −1 (in a batch for that trajectory alone, NaN from there on). The
        default is "warn" for trained flows, whose figures hold in Ω, and "ignore" for classical methods.
    **options
        Options of the method: `dt` for fixed steps (default `system.dt`, or the flow's Δt), `rtol` and `atol` for
        adaptive ones, `flow` for "sympflow" and "mlp".

    Returns
    -------
    Solution
        A run that becomes non-finite ends with status −1 and keeps what was computed. If the solution itself becomes
        infinite, the message and `stats["blow_up_time"]` say when, by an estimate.

    Raises
    ------
    ValueError, TypeError
        For bad arguments, at once: the message names the argument and the remedy.
    RuntimeError
        If the method is that of a plug-in and fails: the message names the plug-in.

    Examples
    --------
    >>> import sympflow
    >>> sol = sympflow.solve(sympflow.systems.henon_heiles(), "verlet", (0, 10), dt=0.1)
    >>> sol.y.shape
    (4, 101)
    """
    if not isinstance(system, HamiltonianSystem):
        raise TypeError(f"`system` must be a HamiltonianSystem; got {type(system).__name__}.")
    integrator = build(method, options)
    t0, t1 = check_t_span(system.t_span if t_span is None else t_span)
    y_start = check_y0(system, system.y0 if y0 is None else y0, dtype)
    if hasattr(integrator, "resolved"):  # which integrator a method is may depend on what it is asked for
        integrator = integrator.resolved(system, y_start, abs(t1 - t0))
    check_applies(integrator, system)
    times = None if t_eval is None else check_t_eval(t_eval, t0, t1)
    every = check_save_every(save_every, times)
    if not isinstance(backend, str) or backend not in BACKENDS:
        raise ValueError(f"`backend` must be one of {', '.join(map(repr, BACKENDS))}; got {backend!r}.")
    if backend == "compiled" and not integrator.compiles:
        raise ValueError(f"`backend` 'compiled' does not apply to method {integrator.name!r}: use 'auto'.")
    if not isinstance(dense_output, bool | np.bool_):
        raise TypeError(f"`dense_output` must be True or False; got {dense_output!r}.")
    action = ("warn" if integrator.trained else "ignore") if on_domain_exit is None else on_domain_exit
    if not isinstance(action, str) or action not in ("warn", "stop", "ignore"):
        raise ValueError(f"`on_domain_exit` must be 'warn', 'stop' or 'ignore'; got {on_domain_exit!r}.")
    search = check_events(y_start, events, event_step, abs(t1 - t0))
    problem = Problem(system, t0, t1, y_start, times, every, bool(dense_output), backend, search)
    check_memory(integrator, problem)

    start = time.perf_counter()
    with naming_plugin(integrator):
        outcome = (
            integrator.run(problem)
            if search is None or integrator.finds_events
            else run_and_search(integrator, problem, search)
        )
        _check_outcome(outcome, integrator, y_start)
    outcome.stats["wall_time"] = time.perf_counter() - start
    if outcome.status < 0 if isinstance(outcome.status, int) else np.any(np.asarray(outcome.status) < 0):
        from sympflow.singularity import note_singularities

        note_singularities(outcome, integrator, problem)
    if action != "ignore":
        _check_domain(outcome, integrator, system, action)
    y = outcome.y.movedim(0, -1) if is_tensor(outcome.y) else _time_last(outcome.y)
    return Solution(
        t=outcome.t,
        y=y,
        status=outcome.status,
        message=outcome.message,
        stats=outcome.stats,
        system=system,
        integrator=integrator,
        t_span=(t0, t1),
        y0=y_start,
        sol=outcome.sol,
        t_events=None if search is None else search.times(),
        y_events=None if search is None else search.states(y_start),
    )


def domain_of(flow: Any, system: HamiltonianSystem) -> Domain | None:
    """Ω of a flow, or else of its system, ready to be asked for states."""
    domain = getattr(flow, "domain", None) or system.domain
    if isinstance(domain, EnergySublevel) and domain.hamiltonian is None:
        return system.domain if domain == system.domain else domain.attach(system.hamiltonian)
    return domain


def contained(domain: Domain, system: HamiltonianSystem, y: Array, slack: float, compiled: bool) -> np.ndarray:
    """Whether the states y (..., 2d) are in the domain: (...), or () if all are and `compiled` code could tell."""
    if compiled and isinstance(domain, Box | EnergySublevel):
        from sympflow.kernels.sublevel import all_within

        if all_within(system, domain, y, slack):
            return _TRUE
    return np.asarray(domain.contains(y, slack=slack))


def _time_last(y: np.ndarray) -> np.ndarray:
    return y.T if y.ndim == 2 else np.moveaxis(y, 0, -1)


def _check_outcome(outcome: Any, integrator: Integrator, y0: Array) -> None:
    """Refuse what is no answer (of a plug-in), and flag states that are not finite, whatever the method says."""
    what = type(outcome).__name__
    if isinstance(outcome, Outcome):
        status, shapes = np.asarray(outcome.status), (np.shape(outcome.t), tuple(np.shape(outcome.y)))
        if status.dtype.kind in "iu" and shapes == (shapes[0][:1], (*shapes[0][:1], *y0.shape)):
            what = ""
        else:
            what = f"status {outcome.status!r}, t and y of shapes {shapes[0]} and {shapes[1]}"
    if what:
        raise TypeError(
            f"`method` {integrator.name!r} must answer with an Outcome that has an integer status, t of shape (n,) and "
            f"y of shape (n, *y0.shape); got {what}. Mend its run(): check_integrator tests it."
        )
    if outcome.finite or (not is_tensor(outcome.y) and np.isfinite(outcome.y).all()):
        return
    finite = to_numpy(all_finite(outcome.y))
    bad = ~finite.all(0) & (np.asarray(outcome.status) >= 0)
    if not bad.any():
        return
    first = int(np.argmin(finite[(slice(None), *np.argwhere(bad)[0])] if bad.ndim else finite))
    index = f" (trajectory {', '.join(map(str, np.argwhere(bad)[0].tolist()))})" if bad.ndim else ""
    outcome.message = (
        f"The solution became non-finite before t = {outcome.t[first]:.17g}{index}. Start from a smaller state, or end "
        "`t_span` earlier."
    )
    outcome.status = np.where(bad, -1, outcome.status) if bad.ndim else -1
    if not bad.ndim:
        outcome.t, outcome.y = outcome.t[:first], outcome.y[:first]


def _meaning(flow: Any) -> str:
    """What is left of a trained flow outside its domain: a primed one still evaluates the system's own forces there."""
    if flow is None or (hasattr(flow, "evaluations") and any(flow.evaluations(1, 1, 0, "array").values())):
        return ""
    return (
        ", where its network was not trained: it stays finite, even past a singularity, and what it gives from that "
        "time on means nothing. Start inside the domain, or use a classical method"
    )


def _check_domain(outcome: Outcome, integrator: Integrator, system: HamiltonianSystem, action: str) -> None:
    """Note the first output outside the domain, or end the run there."""
    flow = getattr(integrator, "flow_for", lambda system: None)(system)
    domain = domain_of(flow, system)
    if domain is None or not len(outcome.t):
        return
    slack = float(getattr(flow, "figures", {}).get("energy_error_max") or 0.0)
    inside = contained(domain, system, outcome.y, slack, outcome.stats.get("backend") == "compiled")  # (n, ...)
    if inside.all():
        return
    with np.errstate(invalid="ignore"):
        inside = inside | ~to_numpy(all_finite(outcome.y))  # what has become non-finite is reported as that
    if inside.all():
        return
    first = int(np.argmin(inside.reshape(len(inside), -1).all(1)))
    t = float(outcome.t[first])
    outcome.stats["domain_exit"] = t
    which = ""
    if inside.ndim > 1:
        index = tuple(np.argwhere(~inside[first])[0].tolist())
        count = int((~inside).any(0).sum())
        which = f" (trajectory {', '.join(map(str, index))}, the first of {count})"
    note = f"The state left the domain at t = {t:.17g}{which}"
    if action == "warn":
        held = "the figures" if getattr(flow, "certified", None) is None else "the figures and the certificate"
        outcome.message += f" {note}: {held} of a trained flow do not hold there{_meaning(flow)}."
        return
    outcome.message = f"{note}. Start inside the domain, or pass on_domain_exit='warn'."
    if inside.ndim == 1:
        outcome.t, outcome.y = outcome.t[: first + 1], outcome.y[: first + 1]
        outcome.status = -1
        return
    outside = np.logical_or.accumulate(~inside, axis=0)
    after = np.concatenate([np.zeros_like(outside[:1]), outside[:-1]])  # the exit itself is kept
    outcome.status = np.where(outside[-1], -1, outcome.status)
    if is_tensor(outcome.y):
        import torch

        outcome.y = outcome.y.masked_fill(torch.as_tensor(after, device=outcome.y.device)[..., None], math.nan)
    else:
        outcome.y = np.where(after[..., None], np.nan, outcome.y).astype(outcome.y.dtype)
