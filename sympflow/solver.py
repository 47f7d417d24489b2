"""solve(): validates, picks the integrator, drives it, and returns a Solution."""

from __future__ import annotations

import math
import os
import time
import warnings
from collections.abc import Callable, Iterable, Mapping
from dataclasses import replace
from functools import partial
from types import NoneType
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

from sympflow.arguments import (
    MAX_SAVED_VALUES,
    check_flag,
    check_not_traced,
    check_save_every,
    check_t_eval,
    check_t_span,
    warn,
)
from sympflow.arrays import (
    Array,
    as_tensor,
    concatenate,
    differentiable,
    finite_states,
    full_of_nan,
    known_finite,
    lanes,
    last,
    readable,
    to_numpy,
)
from sympflow.integrators.base import run_and_search
from sympflow.integrators.choosing import check_tolerance, choose_method, state_error, step_for, with_start, with_step
from sympflow.integrators.contract import Failure, Integrator, Interrupted, Outcome, Problem
from sympflow.integrators.diagnosis import diagnose, diagnose_piece, note_poles, note_singularities_of_rows
from sympflow.integrators.domain_exit import check_domain, check_system_along
from sympflow.integrators.grid import MOST_OPEN_STEPS, Grid, no_event
from sympflow.integrators.grid_runs import report_lanes
from sympflow.integrators.impulses import landings, run_in_pieces
from sympflow.integrators.problems import (
    check_backend,
    check_event_search,
    check_events,
    check_memory,
    check_params,
    check_stored,
    check_y0,
)
from sympflow.integrators.progress import Asked, Progress
from sympflow.integrators.registry import build, check_applies, get, naming_plugin
from sympflow.solution import Solution, StoredSolution, energy_change, joined
from sympflow.systems.given import GivenSystem, given_system

if TYPE_CHECKING:
    from sympflow.hamiltonian.parameter_rows import ParameterRows
    from sympflow.storage.runs import RunStore

COMPARED = {"state": 16, "energy": 256}
"""Outputs of a run with a chosen step, at most, at which it is compared with one of half the step."""
FIRST_WINDOW = 4096  # steps of the first of the ever longer runs to an infinite end


def solve(
    system: GivenSystem,
    method: Any = None,
    t_span: tuple[float, float] | None = None,
    y0: ArrayLike | Array | None = None,
    *,
    tol: float | None = None,
    tol_of: str = "energy",
    params: Mapping[str, ArrayLike] | None = None,
    t_eval: ArrayLike | None = None,
    dense_output: bool = False,
    save_every: int | None = None,
    dtype: Any = None,
    events: Any = None,
    event_step: float | None = None,
    backend: str = "auto",
    on_domain_exit: str | None = None,
    diagnose: bool = True,
    progress: Asked = False,
    store: str | os.PathLike[str] | None = None,
    resume: bool = False,
    same: bool = False,
    checkpoint_every: float | None = None,
    **options: Any,
) -> Solution:
    """Solve x' = J∇H(x), x(t0) = y0.

    Parameters
    ----------
    system : HamiltonianSystem
        Or the name of a scene, such as "henon-heiles", H as a formula, such as "p**2/2 + q**4/4", or a system in a
        file of your own, "own.py:name" or "own.toml".
    method : str, Integrator, or trained flow, optional
        A name from `sympflow.available()`; or a configured integrator such as ``get("verlet")(dt=0.05)``; or a flow. By
        default one that suits the system, the first of these that applies: a flow that ships for it ("sympflow");
        "wisdom_holman" for planets about a star; "log_kahan_li8" where V < 0 falls without bound towards a place, or,
        without `tol`, "dop853" where it does so as a logarithm or is positive elsewhere; "srkn11b" where T = ½ pᵀM⁻¹p;
        "kahan_li8" where H is separable; "gauss_legendre6"; "dop853". The message and `stats["chosen"]` contain the
        choice and its reason.
    t_span : (float, float), optional
        Start and end; the end may lie before the start. The default is the system's. Gradients flow to tensors, here
        and in `t_eval`, by the field at the start and at the outputs. With a terminal event the end may
        be infinite: without the event the run ends after a million steps, with status −1.
    y0 : array_like or tensor of shape (..., 2d), optional
        Initial state [q, p], or a batch of them. The default is the system's. A NumPy array gives float64 (integers are
        promoted); a tensor gives a tensor of its dtype and device, and gradients flow to it.
    tol : float, optional
        The largest relative energy error; on the logarithmic clock, where H may be conserved although the time is
        wrong, the largest error of states. A method of fixed steps takes the step that `sympflow.choose_step` finds by
        short trial runs; for "sympflow" it chooses the flow. The error of the run itself is in `stats`, "energy_error"
        or "state_error": where it is larger than `tol`, a RuntimeWarning and the message report it. The error of states
        is found by another run with half of the step; with friction or a drive the error is that of the balance of
        energy and work, from runs with half of the step from one output to the next.
    tol_of : {"energy", "state"}
        See `sympflow.choose_step`.
    params : mapping of str to array_like, optional
        Values of parameters of the system for each trajectory: numbers, or arrays that broadcast with the batch of y0;
        of one state y0 they make a batch. The others keep the system's values. Splitting methods on the splitting
        "kinetic" take them as numbers of one compiled run, and each trajectory is that of a batch on
        ``system.with_params(...)``, up to rounding with compensated sums, force gradients, friction or a drive.
        Otherwise trajectories are grouped by parameter values, and the groups run in sequence. A trained flow is valid
        for its own parameters only. Gradients flow to tensors that require them, by splitting methods on the splitting
        "kinetic", and where H does not depend on t by Gauss methods and Runge–Kutta methods of fixed steps.
    t_eval : array_like of shape (n,), optional
        Times to report, ordered from start to end. The default is every step. No other state is stored.
    dense_output : bool
        True to return `sol`, a function of t. It stores the state after every step.
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
        Longest time between two samples of the event functions; two zeros of the same function between two samples are
        missed. It never changes the run: longer steps are sampled within, by the dense output, as `max_step` does
        inside `solve_ivp`. The default is `system.dt` for fixed steps, which may be long, and each step for adaptive
        methods.
    backend : "auto", "compiled" or "array"
        "auto" runs symbolic systems, lattices, pairs and Numba functions compiled, for float64 NumPy states and, by
        methods of fixed steps, for tensors on the CPU; everything else with array operations, tensors on a GPU too.
        The choice is in `stats["backend"]`.
    on_domain_exit : "warn", "stop" or "ignore", optional
        Action when an output lies outside the domain Ω: "warn" puts the first exit into the message and the statistics,
        "stop" ends the run there with status −1 (in a batch only that trajectory, NaN from there on). The default is
        "warn" for trained flows, whose accuracy is known in Ω only, and "ignore" for classical methods.
    diagnose : bool
        True to check the finished run: for places where H is infinite, for steps that are too long, and, if it became
        non-finite, whether and when the solution itself does. This takes about a tenth of a second.
    progress : bool or callable
        True for a bar on stderr; or a function of the elapsed and the total time of the run, called a few times a
        second. Methods of other libraries, which do not run in windows, report only the end.
    store : path, optional
        A folder, a zarr store, into which outputs are written as they are computed: fixed steps, NumPy states. Memory
        does not grow with them: `t` and `y` of the solution are read from the store when they are used, and
        ``xarray.open_zarr(store)`` reads it at any time.
    resume : bool
        Continue the run in the store, if there is one: after a kill at any moment, or to a later end of
        `t_span`, with later times in `t_eval`, the result equals that of an uninterrupted run bit for bit. A store of
        another run is refused: runs are compared by everything that defines them, functions and classes by their code
        and the values that they use.
    same : bool
        With `resume`, assume that functions and Python objects are those of the store. Use it where they cannot be
        compared, such as results of a compiled library, or where code was rewritten with the same meaning.
    checkpoint_every : float, optional
        Time between checkpoints in seconds: the most work that is lost when the process is killed; the default is 10.
        Outputs are chosen by `t_eval` and `save_every`.
    **options
        Options of the method: `dt` for fixed steps (default `system.dt`, or the flow's Δt), `rtol` and `atol` for
        adaptive ones, `flow` for "sympflow" and "mlp".

    Returns
    -------
    Solution
        A run that becomes non-finite ends with status −1 and keeps the outputs so far. If the solution itself becomes
        infinite, the message and `stats["blow_up_time"]` say when, by an estimate.

    Raises
    ------
    ValueError, TypeError
        For bad arguments, at once: the message names the argument and the remedy.
    RuntimeError
        If the method is that of a plug-in and fails: the message names the plug-in.
    Interrupted
        A KeyboardInterrupt, by Ctrl-C in a run of a second or more: its `solution` has the outputs computed until then.

    Examples
    --------
    >>> import sympflow
    >>> sol = sympflow.solve(sympflow.systems.henon_heiles(), "verlet", (0, 10), dt=0.1)
    >>> sol.y.shape
    (4, 101)
    """
    check_not_traced("solve")
    system = given_system(system, params)
    given, chosen = options, None
    if tol is not None and isinstance(method, str) and "tol" in get(method).options():
        given = {**options, "tol": tol}
    elif tol is not None:
        check_tolerance(tol, tol_of)
    integrator = None if method is None else build(method, given)
    search = check_events(events, event_step)
    moving = _moving_times(t_span, t_eval)
    if moving is not None:
        if events is not None or dense_output or store is not None or params is not None:
            raise ValueError(
                "`t_span` or `t_eval` requires gradients, which do not flow through `events`, `dense_output`, `store` "
                "or `params`: pass `.detach()`, or leave these out; of values for all trajectories make the system, by "
                "system.with_params(...)."
            )
        t_span, t_eval = moving.numbers
    t0, t1 = check_t_span(system.t_span if t_span is None else t_span, search is not None and search.may_end_run)
    y_start = check_y0(system, system.y0 if y0 is None else y0, dtype)
    system.check_times(t0, t1)
    if type(t_span) is list and type(y0) is tuple and t0 and len(y0) == 2 and 0 == y0[0] < y0[1]:
        warn(
            f"`t_span` {t_span} and `y0` {y0} look interchanged: the order is solve(system, method, t_span, y0). If "
            "this is meant, pass a tuple as `t_span`.",
            RuntimeWarning,
        )
    if integrator is None:
        simple = events is None and store is None and params is None and not dense_output
        integrator, chosen = choose_method(system, y_start, options, tol, simple, flows=params is None)
    system = with_start(integrator, system, y_start)
    rows = None
    if params is not None:
        rows, y_start = check_params(system, params, y_start, integrator)
        if rows.followed:
            y_start = as_tensor(y_start)
        if rows.uniform:
            system = rows.system_of(0)
    if moving is not None:
        y_start = moving.started(system, y_start, t0)
    times = None if t_eval is None else check_t_eval(t_eval, t0, t1)
    every = check_save_every(save_every, times)
    check_backend(backend, integrator)
    check_flag("dense_output", dense_output)
    action = ("warn" if integrator.trained else "ignore") if on_domain_exit is None else on_domain_exit
    if not isinstance(action, str) or action not in ("warn", "stop", "ignore"):
        raise ValueError(f"`on_domain_exit` must be 'warn', 'stop' or 'ignore'; got {on_domain_exit!r}.")
    check_flag("diagnose", diagnose)
    if action == "stop" and not readable(y_start):
        raise ValueError(
            "`on_domain_exit` 'stop' needs the values of the states, which torch.func.vmap and torch.compile hide: use "
            "'warn' or 'ignore' there."
        )
    if search is not None:
        check_event_search(search, y_start, abs(t1 - t0))
    problem = Problem(
        system, t0, t1, y_start, times, every, bool(dense_output), backend, search, diagnosed=bool(diagnose)
    )
    if store is not None:
        from sympflow.storage.runs import RunStore

        kept = RunStore(store, resume, checkpoint_every, same)
        check_stored(problem, action, rows)
        problem = replace(problem, store=kept)
    elif resume or same or checkpoint_every is not None:
        raise ValueError(
            "`resume` and `checkpoint_every` are for runs with a `store`, and `same` with them: give one, or leave "
            "them out."
        )
    steps_chosen = tol is not None and "tol" not in integrator.options()
    if tol is not None and steps_chosen:
        dt, tol_of = step_for(integrator, problem, tol, tol_of)
        integrator = replace(integrator, dt=dt)  # type: ignore[type-var]
        if store is None and math.isfinite(t1):
            _check_outputs(integrator, problem, tol)
    elif system.step_is_open and readable(y_start):
        integrator = with_step(integrator, system, to_numpy(y_start))
    sol = _shown(integrator, problem, action, rows, progress)
    if moving is not None:
        sol.y = moving.ended(system, sol.y, sol.t)
    if tol is not None and steps_chosen and store is None and readable(y_start):
        _check_tolerance_met(sol, integrator, problem, rows, tol, tol_of)
    if chosen is not None:
        sol.stats["chosen"] = f"{sol.integrator.label}: {chosen}"
        sol.message += f" Method {sol.integrator.label!r} was chosen: {chosen}."
    return sol


def _moving_times(t_span: Any, t_eval: Any) -> Any:
    """The times that torch follows, where there are some."""
    ends = t_span if isinstance(t_span, (tuple, list)) else ()
    listed = t_eval if isinstance(t_eval, (tuple, list)) else (t_eval,)
    times = [t for t in (*ends, *listed) if type(t) not in (float, int, NoneType)]
    if not differentiable(*times):
        return None
    from sympflow.integrators.tensors import MovingTimes

    return MovingTimes(t_span, t_eval)


def _shown(
    integrator: Integrator, problem: Problem, action: str, rows: ParameterRows | None, progress: Asked
) -> Solution:
    """The solution of a validated problem, with a bar where that is asked for."""
    if progress is False:
        return _answered(integrator, problem, action, rows)
    t0, t1 = problem.t0, problem.t1
    sign = math.copysign(1.0, t1 - t0)
    bar = Progress(progress, abs(t1 - t0), lambda done: f"t = {t0 + sign * done:.6g} of {t1:.6g}")
    try:
        sol = _answered(integrator, replace(problem, progress=bar), action, rows)
        if sol.success and bar.done != bar.total:
            bar(bar.total)
    finally:
        bar.end()
    return sol


def _check_outputs(integrator: Integrator, problem: Problem, tol: float) -> None:
    """Refuse a tolerance for which a method takes more steps than can be stored."""
    try:
        check_memory(integrator, problem)
    except ValueError as error:
        other, why = choose_method(problem.system, problem.y0, {}, tol, flows=False)
        remedy = f"take one of higher order{f', or {other.label!r} ({why})' if other.in_another_time else ''}"
        what = "of the states, as always on the logarithmic clock, " if integrator.in_another_time else ""
        raise ValueError(
            f"`tol` {tol:g} {what}needs very short steps of method {integrator.label!r}, of order {integrator.order}: "
            f"{remedy}, or a larger `tol`. {error}"
        ) from error


def _check_tolerance_met(
    sol: Solution, integrator: Integrator, problem: Problem, rows: ParameterRows | None, tol: float, tol_of: str
) -> None:
    """Measure the error of a run, and note one that is larger than was asked for."""
    if not len(sol.t) or (tol_of == "energy" and sol.system.between_impulses is not sol.system):
        return
    with warnings.catch_warnings(action="ignore"):  # of an error that is absolute
        kept = tol_of == "energy" and sol.system.shows_energy
        error = energy_change(sol) if kept else _change_by_halves(sol, integrator, problem, rows, tol_of)
    largest = float(np.fmax.reduce(np.abs(error), axis=None, initial=0.0))
    sol.stats[f"{tol_of}_error"] = largest
    if largest > tol:
        note = f"The relative {tol_of} error of the run is {largest:.2g}, more than `tol` {tol:g}: pass a smaller one."
        sol.message += f" {note}"
        warn(note, RuntimeWarning)


def _change_by_halves(
    sol: Solution, integrator: Integrator, problem: Problem, rows: ParameterRows | None, tol_of: str
) -> np.ndarray:
    """The differences of states at some outputs from a run with half of the step, or the error of the energy's balance.

    This is the sum of the differences of H from runs between the outputs, each from the state before: orbits of chaos
    part without any error.
    """
    few = slice((len(sol.t) - 1) % (every := -(-len(sol.t) // COMPARED[tol_of])), None, every)  # with the last
    half: Any = replace(integrator, dt=0.5 * integrator.dt)  # type: ignore[attr-defined, type-var]
    y0, times = problem.y0 if rows is not None else to_numpy(problem.y0), sol.t[few]
    states = to_numpy(sol.states)[..., few, :]

    def finer(start: Array, t0: float, ends: np.ndarray) -> Solution:
        alike = replace(problem, y0=start, t0=t0, t1=float(ends[-1]), t_eval=ends, save_every=1, dense_output=False)
        try:
            return _answered(half, replace(alike, events=None, diagnosed=False), "ignore", rows)
        except Interrupted as stop:
            raise Interrupted(stop.outcome, sol) from None

    if tol_of == "energy":
        H, off = to_numpy(sol.energy())[..., few], np.zeros((*states.shape[:-2], len(times)))
        for k in range(len(times)):
            start, t0 = (states[..., k - 1, :], float(times[k - 1])) if k else (y0, problem.t0)
            ended = finer(start, t0, times[k : k + 1])
            if not len(ended.t):
                return off[..., :k] / sol.energy_scale()[..., None]
            off[..., k] = off[..., k - 1] + H[..., k] - to_numpy(ended.energy())[..., 0]
        return off / sol.energy_scale()[..., None]
    whole = finer(y0, problem.t0, times)
    return state_error(sol.system, to_numpy(y0), states[..., : len(whole.t), :] - to_numpy(whole.states))


def _answered(integrator: Integrator, problem: Problem, action: str, rows: ParameterRows | None) -> Solution:
    """The solution of a validated problem, where trajectories may have parameters of their own."""
    if rows is None or rows.uniform:
        sol = _solved(integrator, problem, action)
        sol.rows = rows
        return sol
    if rows.followed:
        return _solved_followed(integrator, problem, action, rows)
    return _solved_rows(integrator, problem, action, rows)


def _solved(integrator: Integrator, problem: Problem, action: str, rows: ParameterRows | None = None) -> Solution:
    """The solution of a validated problem; `rows` are the parameters of its trajectories, where they have some."""
    system, y_start = problem.system, problem.y0
    n_times = 0 if problem.t_eval is None else len(problem.t_eval)
    between = system.between_impulses
    integrator = integrator.resolved(between, y_start, abs(problem.t1 - problem.t0), n_times)
    check_applies(integrator, between, y_start)
    integrator.check_library(y_start)
    run: Callable[[Integrator, Problem], tuple[Outcome, Problem]] = _run
    able = problem.store is None and (rows is None or problem.parameter_values is None or _alike_in_time(problem, rows))
    driven = between if rows is None or problem.parameter_values is None else rows.system_of(0).between_impulses
    told, jumps = landings(integrator, driven, problem.t0, problem.t1, able)
    if told:
        without = "Without a `store`" if problem.store is not None else "With one value of `params` at a time"
        warn(told if able else f"{told} {without}, steps end there.", RuntimeWarning)
    if jumps and rows is not None and problem.t_eval is None and (length := integrator.step_length(between)):
        outputs = Grid(problem.t0, problem.t1, length).outputs(None, problem.save_every)
        problem = replace(problem, t_eval=outputs)  # the same of all trajectories
    if between is not system:
        _check_impulses(problem, integrator)
    if between is not system or jumps:
        run = partial(run_in_pieces, partial(_run_diagnosed, rows), jumps=jumps)
    if problem.t1 in (math.inf, -math.inf):
        run = _run_endless
    elif problem.store is not None:
        run = partial(_run_stored, action=action)
    else:
        check_memory(integrator, problem if between is system else replace(problem, system=between))

    start, stopped = time.perf_counter(), None
    with naming_plugin(integrator):
        try:
            outcome, problem = run(integrator, problem)
        except Interrupted as stop:
            outcome, stopped = stop.outcome, stop
        _check_outcome(outcome, integrator, y_start)
    outcome.stats["wall_time"] = time.perf_counter() - start
    diagnose(outcome, integrator, problem, rows, action, stopped is not None)
    y = last(outcome.y)
    sol = (Solution if problem.store is None else StoredSolution)(
        t=outcome.t,
        y=y,
        status=outcome.status,
        message=outcome.message,
        stats=outcome.stats,
        system=system,
        integrator=integrator,
        t_span=(problem.t0, problem.t1),
        y0=y_start,
        sol=outcome.sol,
        t_events=None if problem.events is None else problem.events.times(),
        y_events=None if problem.events is None else problem.events.states(y_start),
    )
    if problem.store is not None:
        assert isinstance(sol, StoredSolution)
        sol.store, sol.t, sol.y = problem.store, None, None
    if stopped is not None:
        raise Interrupted(outcome, sol) from None
    return sol


def _solved_followed(integrator: Integrator, problem: Problem, action: str, rows: ParameterRows) -> Solution:
    """The solution of trajectories to whose parameters gradients flow: one run, whatever the values."""
    numbers = {name: as_tensor(value.copy()) for name, value in rows.values.items() if name not in rows.followed}
    followed = {name: rows.followed[name] if name in rows.followed else numbers[name] for name in rows.values}
    by_name = None if problem.system.local is None else problem.system.local.parameter_values(followed)
    if by_name is not None:
        followed = {name: as_tensor(x) for name, x in by_name.items()}
    columns = [np.broadcast_to(to_numpy(value), rows.shape) for value in followed.values()]
    parameter_values = np.array([np.ravel(value) for value in columns])
    together = replace(problem, parameter_values=parameter_values, followed=followed, diagnosed=False)
    if problem.system.between_impulses is not problem.system or problem.events is not None or action == "stop":
        raise ValueError(
            f"`params` has {', '.join(rows.followed)} that require gradients, which do not flow through `events`, "
            "impulses, or `on_domain_exit` 'stop': detach them, or leave these out."
        )
    integrator.check_followed(together)
    if (name := _moving(problem, rows, rows.followed)) is not None:
        raise ValueError(
            f"`params` has {name} that requires gradients and moves the times at which H jumps in t, which "
            "gradients do not follow: detach it, or make the jump smooth, such as (1 + tanh((t - c)/w))/2."
        )
    sol = _solved(integrator, together, action, rows)
    sol.rows = rows
    return sol


def _alike_in_time(problem: Problem, rows: ParameterRows) -> bool:
    """Return True if H jumps, and has its kinks, at the same times for all trajectories."""
    varied = [name for name, value in rows.values.items() if np.ptp(value) > 0]
    return _moving(problem, rows, varied, kinks=True) is None


def _moving(problem: Problem, rows: ParameterRows, names: Iterable[str], kinks: bool = False) -> str | None:
    """The first of some parameters that moves the times at which H jumps in t, or has `kinks`."""
    system = problem.system
    if not system.definition.may_jump:
        return None

    def times(values: dict[str, float]) -> np.ndarray:
        between = system.with_params(**values)
        return between.jump_times(min(problem.t0, problem.t1), max(problem.t0, problem.t1), between.dt / 4, kinks)

    for place in (0, -1):
        values = {name: float(np.ravel(value)[place]) for name, value in rows.values.items()}
        for name in names:
            near = values | {name: values[name] + 1e-6 * (abs(values[name]) or 1.0)}
            if not np.array_equal(times(values), times(near)):
                return name
    return None


def _solved_rows(integrator: Integrator, problem: Problem, action: str, rows: ParameterRows) -> Solution:
    """The solution of a batch whose trajectories have parameters of their own."""
    states = problem.y0.reshape(-1, problem.y0.shape[-1])
    groups = []
    alike = action == "ignore" and problem.system.between_impulses is problem.system
    for group in rows.by_form() if alike else rows.distinct():
        together = replace(
            problem, system=group.system, y0=states[group.places], parameter_values=group.parameter_values
        )
        if group.parameter_values is None or integrator.takes_parameter_values(together):
            groups.append((group.places, together))
            continue
        for few, system, _ in rows.taken(group.places).distinct():
            index = group.places[few]
            groups.append((index, replace(problem, system=system, y0=states[index])))
    pieces: list[tuple[np.ndarray, Solution]] = []
    try:
        for index, part in groups:
            sol = _solved(integrator, part, action, rows.taken(index))
            pieces.append((index, sol))
            if problem.diagnosed and part.parameter_values is not None and not sol.success:
                note_singularities_of_rows(sol, integrator, part, rows.taken(index))
    except Interrupted as stop:
        pieces.append((index, stop.solution))
        whole = max((sol for _, sol in pieces), key=lambda sol: len(sol.t))
        for index, part in groups[len(pieces) :]:  # not begun
            y = part.y0[..., None][..., :0]
            status = np.full(tuple(part.y0.shape[:-1]), -1)
            own = replace(stop.solution, t=whole.t[:0], y=y, status=status, system=part.system, y0=part.y0)
            pieces.append((index, own))
        for i, (index, sol) in enumerate(pieces):  # unknown, NaN, at the last outputs
            unknown = [full_of_nan(sol.y0)[..., None]] * (len(whole.t) - len(sol.t))
            pieces[i] = index, replace(sol, t=whole.t, y=concatenate([sol.y, *unknown]), sol=None)
        sol = joined(pieces, problem.system, problem.y0, rows)
        raise Interrupted(stop.outcome, replace(sol, message=stop.solution.message)) from None
    return joined(pieces, problem.system, problem.y0, rows)


def _run(integrator: Integrator, problem: Problem) -> tuple[Outcome, Problem]:
    """The outcome of a run, and the problem that was solved."""
    search = problem.events
    if search is None or integrator.finds_events:
        return integrator.run(problem), problem
    return run_and_search(integrator, problem, search), problem


def _run_diagnosed(rows: ParameterRows | None, integrator: Integrator, problem: Problem) -> tuple[Outcome, Problem]:
    """The outcome of a piece of a run, and its problem."""
    outcome, problem = _run(integrator, problem)
    diagnose_piece(outcome, integrator, problem, rows)
    return outcome, problem


def _check_impulses(problem: Problem, integrator: Integrator) -> None:
    """Refuse what is not done of a system with impulses."""
    system, search = problem.system, problem.events
    if problem.store is not None:
        system.check_impulses("and a run into a `store` makes no kicks", "leave `store` out")
    if not math.isfinite(problem.t1):
        system.check_impulses("and `t_span` has no end up to which they are known", "give it a finite one")
    if search is not None and search.events and integrator.keeps:
        what = f"after each of which {integrator.keeps} begins anew in method {integrator.name!r}, and so do `events`"
        system.check_impulses(what, "use another method")


def _run_stored(integrator: Integrator, problem: Problem, action: str) -> tuple[Outcome, Problem]:
    """The outcome of a run whose outputs a store takes, and the problem."""
    from sympflow.integrators.provenance import provenance, run_identity

    store, system, y0 = problem.store, problem.system, problem.y0
    assert store is not None
    integrator.check_store()
    length = integrator.step_length(system)
    known = run_identity(problem, integrator, length)
    steps = 1.0 if length is None else abs(problem.t1 - problem.t0) / length / problem.save_every
    expected = steps + 2 if problem.t_eval is None else problem.t_eval.size
    store.prepare(known, provenance(system, integrator, (problem.t0, problem.t1)), y0, int(min(expected, 1e9)))
    compiled = {"backend": "compiled"}  # by which states are looked at in a compiled pass
    before: Problem | None = None

    def look(t: np.ndarray, y: np.ndarray) -> None:
        """Check the outputs of a window, as `_solved` checks all outputs."""
        piece = Outcome(t, y, 0, "", compiled.copy() if y.dtype == np.float64 else {})
        if system.functions_given:
            system.check_functions_along(y)
        if integrator.trained:
            check_system_along(piece, integrator, system, y0)
        if problem.diagnosed and system.definition.poles is not None:
            nonlocal before
            if before is None:
                before = replace(problem, store=None, progress=None, diagnosed=False)
                if n := store.length:  # which holds what was before
                    before = replace(before, t0=float(store.times(n - 1)[0]), y0=store.states(n - 1)[..., 0])
            _look_for_poles(store, Outcome(t, y, 0, "", {}), integrator, before)
            before = replace(before, t0=float(t[-1]), y0=y[-1])
        if action != "ignore" and "domain_exit" not in store.noted:
            check_domain(piece, integrator, system, action)
            if "domain_exit" in piece.stats:
                store.noted |= {"domain_exit": piece.stats["domain_exit"], "warning": piece.message}

    store.look = look
    return integrator.run(problem), problem


def _look_for_poles(store: RunStore, piece: Outcome, integrator: Integrator, before: Problem) -> None:
    """Note that a run passed a pole between outputs of a window, and the state before them; of each trajectory once."""
    known = np.array(store.noted.get("failed_at", np.full(before.y0.shape[:-1], np.nan)), dtype=float)
    piece.status = np.where(np.isnan(known), 0, -1) if known.ndim else 0 if np.isnan(known) else -1
    if any(each.certain for each in note_poles(piece, integrator, before, None)):
        at = np.where(np.isnan(known), piece.stats["failed_at"], known)
        store.noted |= {"failed_at": at.tolist(), "passed": store.noted.get("passed", piece.message)}


def _run_endless(integrator: Integrator, problem: Problem) -> tuple[Outcome, Problem]:
    """The outcome of a run to an infinite end, and the problem with the end that was reached."""
    search, size = problem.events, math.prod(problem.y0.shape)
    assert search is not None
    length = integrator.step_length(problem.system) or problem.system.dt
    stored = problem.t_eval is None or problem.dense_output
    most = min(MOST_OPEN_STEPS, MAX_SAVED_VALUES // size - 1) if stored else MOST_OPEN_STEPS
    if integrator.takes_infinite_end:
        outcome = integrator.run(problem)
    else:
        streams = integrator.finds_events and integrator.on_grid
        n_steps = most if streams else min(FIRST_WINDOW, most)
        while True:
            end = problem.t0 + math.copysign(n_steps * length, problem.t1)
            piece = replace(problem, t1=end, events=search.afresh())
            if problem.t_eval is not None:
                piece = replace(piece, t_eval=problem.t_eval[np.abs(problem.t_eval - problem.t0) <= n_steps * length])
            outcome, piece = _run(integrator, piece)
            if n_steps == most or np.any(np.asarray(outcome.status) != 0):
                break
            n_steps = min(4 * n_steps, most)
        problem = piece
    assert problem.events is not None
    if outcome.status == 0:
        outcome.status = -1
        outcome.message = no_event(outcome.stats.get("n_steps", most), problem.t1)
    reached = problem.events.end or (outcome.stats.get("failed_at", problem.t1),)
    return outcome, replace(problem, t1=float(reached[0]))


def _fits(outcome: Outcome, y0: Array) -> bool:
    """True if status, t and y have the types and shapes that they must have."""
    t, y, status = outcome.t, outcome.y, outcome.status
    if type(t) is type(y) is np.ndarray and type(status) is int:
        return t.ndim == 1 and y.shape == (t.size, *y0.shape)
    count = np.shape(t)[:1]
    shapes = np.shape(t) == count and tuple(np.shape(y)) == (*count, *y0.shape)
    return shapes and np.asarray(status).dtype.kind in "iu"


def _check_outcome(outcome: Any, integrator: Integrator, y0: Array) -> None:
    """Refuse an invalid answer of a plug-in, and flag states that are not finite, whatever the method says."""
    if not (isinstance(outcome, Outcome) and _fits(outcome, y0)):
        what = type(outcome).__name__
        if isinstance(outcome, Outcome):
            shapes = f"{np.shape(outcome.t)} and {tuple(np.shape(outcome.y))}"
            what = f"status {outcome.status!r}, t and y of shapes {shapes}"
        raise TypeError(
            f"`method` {integrator.name!r} must answer with an Outcome that has an integer status, t of shape (n,) and "
            f"y of shape (n, *y0.shape); got {what}. Correct its run(): check_integrator tests it."
        )
    if outcome.finite or known_finite(outcome.y):
        return
    finite = finite_states(outcome.y)
    bad = ~finite.all(0) & (np.asarray(outcome.status) >= 0)
    if not bad.any():
        return
    if lanes(outcome.y):
        report_lanes(outcome, finite, Failure.NON_FINITE)
        return
    first = int(np.argmin(finite[(slice(None), *np.argwhere(bad)[0])] if bad.ndim else finite))
    index = f" (trajectory {', '.join(map(str, np.argwhere(bad)[0].tolist()))})" if bad.ndim else ""
    outcome.message = (
        f"The solution became non-finite before t = {outcome.t[first]:.15g}{index}. Start from a smaller state, or end "
        "`t_span` earlier."
    )
    outcome.status = np.where(bad, -1, outcome.status) if bad.ndim else -1
    if not bad.ndim:
        outcome.t, outcome.y = outcome.t[:first], outcome.y[:first]
