"""solve(): validates, picks the integrator, drives it, and returns a Solution."""

from __future__ import annotations

import itertools
import math
import os
import time
import warnings
from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

from sympflow.arguments import (
    MAX_ASKED_VALUES,
    MAX_SAVED_VALUES,
    as_float,
    check_not_traced,
    check_save_every,
    check_t_eval,
    check_t_span,
)
from sympflow.arrays import Array, as_tensor, finite_states, full_of_nan, is_tensor, lanes, readable, to_numpy
from sympflow.events import EventSearch, parse
from sympflow.hamiltonian.system import HamiltonianSystem
from sympflow.integrators.base import report_lanes, run_and_search
from sympflow.integrators.choosing import check_tolerance, choose_method, step_for, with_step
from sympflow.integrators.contract import Failure, Integrator, Interrupted, Outcome, Problem
from sympflow.integrators.diagnosis import note_poles, note_singularities, warn_of_cancelling, warn_of_long_steps
from sympflow.integrators.domain_exit import (
    check_domain,
    check_system_along,
    warn_of_leap,
    warn_of_loss,
)
from sympflow.integrators.grid import MOST_OPEN_STEPS, no_event
from sympflow.integrators.impulses import landings, run_in_pieces
from sympflow.integrators.progress import Asked, Progress
from sympflow.integrators.registry import build, check_applies, get, naming_plugin
from sympflow.solution import Solution, StoredSolution, energy_change, joined
from sympflow.systems.given import given_system

if TYPE_CHECKING:
    from sympflow.hamiltonian.parameter_rows import ParameterRows
    from sympflow.storage.runs import RunStore

BACKENDS = ("auto", "compiled", "array")
MAX_EVENT_SAMPLES = 100_000_000
MOST_DIAGNOSED = 16  # sets of values of parameters
FIRST_WINDOW = 4096  # steps of the first of the ever longer runs to an infinite end
_FLOAT64 = np.dtype(np.float64)


def solve(
    system: HamiltonianSystem,
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
        Or the name of a scene, such as "henon-heiles", or H as a formula, such as "p**2/2 + q**4/4".
    method : str, Integrator, or trained flow, optional
        A name from `sympflow.available()`; or a configured integrator such as ``get("verlet")(dt=0.05)``; or a flow. By
        default one that suits the system, the first of these that applies: a flow that ships for it ("sympflow");
        "log_kahan_li8" where V falls without bound towards q = 0; "srkn11b" where T = ½ pᵀM⁻¹p; "kahan_li8" where H is
        separable; "gauss_legendre6"; "dop853". The message and `stats["chosen"]` say which, and why.
    t_span : (float, float), optional
        Start and end; the end may lie before the start. The default is the system's. With a terminal event the end may
        be infinite: without the event the run ends after a million steps, with status −1.
    y0 : array_like or tensor of shape (..., 2d), optional
        Initial state [q, p], or a batch of them. The default is the system's. A NumPy array gives float64 (integers are
        promoted); a tensor gives a tensor of its dtype and device, and gradients flow to it.
    tol : float, optional
        The largest relative energy error that is asked for. A method of fixed steps takes the step that
        `sympflow.choose_step` finds by short trial runs; for "sympflow" it chooses the flow, see its option. The run
        itself is checked: where its energy error is larger, a RuntimeWarning and the message say so.
    tol_of : {"energy", "state"}
        See `sympflow.choose_step`.
    params : mapping of str to array_like, optional
        Values of parameters of the system for each trajectory: numbers, or arrays that broadcast with the batch of y0;
        of one state y0 they make a batch. The others keep the system's values. Splitting methods on the splitting
        "kinetic" take them as numbers of one compiled run, and each trajectory is that of a batch on
        ``system.with_params(...)``, up to rounding with compensated sums, force gradients, friction or a drive.
        Elsewhere trajectories of equal values run together, one set of values after the other. A trained flow holds for
        its own parameters alone.
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
        "auto" runs symbolic systems, lattices, pairs and Numba functions compiled, for float64 NumPy states, everything
        else with array operations; tensors on a GPU too. What ran is in `stats["backend"]`.
    on_domain_exit : "warn", "stop" or "ignore", optional
        What to do when an output lies outside the domain Ω: "warn" puts the first exit into the message and the
        statistics, "stop" ends there with status −1 (in a batch for that trajectory alone, NaN from there on). The
        default is "warn" for trained flows, whose figures hold in Ω, and "ignore" for classical methods.
    diagnose : bool
        Whether to find out, of a run that becomes non-finite, if the solution itself does, and when: a tenth of a
        second or so.
    progress : bool or callable
        True for a bar on stderr; or a function of the time that is done and the whole one, called a few times a second.
        A method that is not run in pieces, such as one of a library, tells its end only.
    store : path, optional
        A folder, a zarr store, that takes the outputs as they come: fixed steps, NumPy states. Memory does not grow
        with them: `t` and `y` of the solution are read from the store when they are asked for, and
        ``xarray.open_zarr(store)`` reads it at any time.
    resume : bool
        Go on with the run that is in the store, if there is one: after a kill at any moment, or to a later end of
        `t_span`, with later times in `t_eval`, the bits are those of a run that was never interrupted. A store of
        another run is refused: it is known by all that it is made of, functions and classes by their code and the
        values that they use.
    same : bool
        With `resume`, take functions and objects of Python for those of the store: where one cannot be told from
        another, such as what a compiled library made, or where code was rewritten and means the same.
    checkpoint_every : float, optional
        Seconds of work, at most, that a kill loses; the default is 10. Outputs are chosen by `t_eval` and `save_every`.
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
    Interrupted
        A KeyboardInterrupt, by Ctrl-C in a run of a second or more: its `solution` is what was computed until then.

    Examples
    --------
    >>> import sympflow
    >>> sol = sympflow.solve(sympflow.systems.henon_heiles(), "verlet", (0, 10), dt=0.1)
    >>> sol.y.shape
    (4, 101)
    """
    if is_tensor(y0):
        check_not_traced("solve")
    system = given_system(system)
    given, chosen = options, None
    if tol is not None and isinstance(method, str) and "tol" in get(method).options():
        given = {**options, "tol": tol}
    elif tol is not None:
        check_tolerance(tol, tol_of)
    integrator = None if method is None else build(method, given)
    search = check_events(events, event_step)
    t0, t1 = check_t_span(system.t_span if t_span is None else t_span, search is not None and search.may_end_run)
    y_start = check_y0(system, system.y0 if y0 is None else y0, dtype)
    system.check_times(t0, t1)
    if integrator is None:
        simple = events is None and store is None and params is None and not dense_output
        integrator, chosen = choose_method(system, y_start, options, tol, simple, flows=params is None)
    rows = None
    if params is not None:
        rows, y_start = check_params(system, params, y_start, integrator)
        if rows.followed:
            y_start = as_tensor(y_start)
        if rows.uniform:
            system = rows.system_of(0)
    times = None if t_eval is None else check_t_eval(t_eval, t0, t1)
    every = check_save_every(save_every, times)
    check_backend(backend, integrator)
    if not isinstance(dense_output, bool | np.bool_):
        raise TypeError(f"`dense_output` must be True or False; got {dense_output!r}.")
    action = ("warn" if integrator.trained else "ignore") if on_domain_exit is None else on_domain_exit
    if not isinstance(action, str) or action not in ("warn", "stop", "ignore"):
        raise ValueError(f"`on_domain_exit` must be 'warn', 'stop' or 'ignore'; got {on_domain_exit!r}.")
    if not isinstance(diagnose, bool | np.bool_):
        raise TypeError(f"`diagnose` must be True or False; got {diagnose!r}.")
    if action == "stop" and not readable(y_start):
        raise ValueError(
            "`on_domain_exit` 'stop' needs the values of the states, which torch.func.vmap and torch.compile hide: use "
            "'warn' or 'ignore' there."
        )
    if search is not None:
        check_event_search(search, y_start, abs(t1 - t0))
    problem = Problem(system, t0, t1, y_start, times, every, bool(dense_output), backend, search)
    if not diagnose:
        problem = replace(problem, diagnosed=False)
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
        integrator = replace(integrator, dt=step_for(integrator, problem, tol, tol_of))  # type: ignore[type-var]
    elif system.step_is_open and readable(y_start):
        integrator = with_step(integrator, system, to_numpy(y_start))
    sol = _shown(integrator, problem, action, rows, progress)
    if (
        tol is not None
        and steps_chosen
        and store is None
        and tol_of == "energy"
        and system.autonomous
        and system.conservative
    ):
        _check_tolerance_met(sol, tol)
    if chosen is not None:
        sol.stats["chosen"] = f"{sol.integrator.label}: {chosen}"
        sol.message += f" Method {sol.integrator.label!r} was chosen: {chosen}."
    return sol


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
        if sol.success and not bar.complete:
            bar(bar.total)
    finally:
        bar.end()
    return sol


def _check_tolerance_met(sol: Solution, tol: float) -> None:
    """Note a run whose energy error is larger than was asked for."""
    with warnings.catch_warnings(action="ignore"):  # of an error that is absolute
        error = float(np.max(np.abs(energy_change(sol)), initial=0.0))
    sol.stats["energy_error"] = error
    if error > tol:
        note = f"The relative energy error of the run is {error:.2g}, more than `tol` {tol:g}: pass a smaller one."
        sol.message += f" {note}"
        warnings.warn(note, RuntimeWarning, stacklevel=3)


def check_backend(backend: Any, integrator: Integrator) -> None:
    """Raise ValueError if it is none, or none of the method."""
    if not isinstance(backend, str) or backend not in BACKENDS:
        raise ValueError(
            f"`backend` must be one of {', '.join(map(repr, BACKENDS))}; got {backend!r}: for a GPU pass tensors on it."
        )
    if backend == "compiled" and not integrator.compiles:
        raise ValueError(f"`backend` 'compiled' does not apply to method {integrator.name!r}: use 'auto'.")


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
    able = problem.store is None and problem.letters is None
    told, jumps = landings(integrator, between, problem.t0, problem.t1, able)
    if told:
        warnings.warn(told, RuntimeWarning, stacklevel=4)
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
    if stopped is None:
        _diagnose(outcome, integrator, problem, rows, stacklevel=5)
    failed = outcome.status < 0 if isinstance(outcome.status, int) else np.any(np.asarray(outcome.status) < 0)
    if system.leaps and not failed and problem.letters is None and problem.store is None and readable(outcome.y):
        warn_of_leap(outcome, system, y_start, stacklevel=4)
    if system.functions_given and readable(outcome.y):
        system.check_functions_along(outcome.y)
    if integrator.trained:
        check_system_along(outcome, integrator, between, y_start)
    if action != "ignore" and readable(outcome.y):
        check_domain(outcome, integrator, between, action)
        if problem.store is None and not failed and between is system:
            warn_of_loss(outcome, integrator, system, y_start, stacklevel=4)
    if problem.diagnosed and rows is None and not failed and problem.store is None and readable(outcome.y):
        warn_of_long_steps(outcome, integrator, problem, stacklevel=4)
    y = outcome.y.movedim(0, -1) if is_tensor(outcome.y) else _time_last(outcome.y)
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
    if isinstance(sol, StoredSolution):
        sol.store, sol.t, sol.y = problem.store, None, None
    if stopped is not None:
        raise Interrupted(outcome, sol) from None
    return sol


def _solved_followed(integrator: Integrator, problem: Problem, action: str, rows: ParameterRows) -> Solution:
    """The solution of trajectories to whose parameters gradients flow: one run, whatever the values."""
    columns = {name: np.ravel(value) for name, value in rows.values.items()}
    followed = {name: rows.followed.get(name, as_tensor(column.copy())) for name, column in columns.items()}
    letters = np.stack([*columns.values()])
    together = replace(problem, letters=letters, followed=followed, diagnosed=False)
    if problem.system.between_impulses is not problem.system or problem.events is not None or action == "stop":
        raise ValueError(
            f"`params` has {', '.join(rows.followed)} that require gradients, which flow through no `events`, "
            "impulses, or `on_domain_exit` 'stop': detach them, or leave these out."
        )
    integrator.check_followed(together)
    sol = _solved(integrator, together, action, rows)
    sol.rows = rows
    return sol


def _solved_rows(integrator: Integrator, problem: Problem, action: str, rows: ParameterRows) -> Solution:
    """The solution of a batch whose trajectories have parameters of their own."""
    states = problem.y0.reshape(-1, problem.y0.shape[-1])
    groups = []
    alike = action == "ignore" and problem.system.between_impulses is problem.system
    for group in rows.by_form() if alike else rows.distinct():
        together = replace(problem, system=group.system, y0=states[group.places], letters=group.letters)
        if group.letters is None or integrator.takes_letters(together):
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
            if problem.diagnosed and part.letters is not None and not sol.success:
                _note_singularities(sol, integrator, part, rows.taken(index))
    except Interrupted as stop:
        pieces.append((index, stop.solution))
        whole = max((sol for _, sol in pieces), key=lambda sol: len(sol.t))
        pieces += [(index, _not_begun(stop.solution, part)) for index, part in groups[len(pieces) :]]
        pieces = [(index, _up_to(sol, whole.t)) for index, sol in pieces]
        sol = joined(pieces, problem.system, problem.y0, rows)
        raise Interrupted(stop.outcome, replace(sol, message=stop.solution.message)) from None
    return joined(pieces, problem.system, problem.y0, rows)


def _note_singularities(sol: Solution, integrator: Integrator, problem: Problem, rows: ParameterRows) -> None:
    """Note when solutions with parameters of their own become infinite, of the first `MOST_DIAGNOSED` that fail."""
    status = np.asarray(sol.status)
    failed, times = np.flatnonzero(status < 0), np.full(len(status), np.nan)
    for few, system, _ in itertools.islice(rows.taken(failed).distinct(), MOST_DIAGNOSED):
        i = failed[few]
        stats = {name: value[i] if isinstance(value, np.ndarray) else value for name, value in sol.stats.items()}
        outcome = Outcome(sol.t, np.moveaxis(sol.y[i], -1, 0), status[i], "", stats)
        note_singularities(outcome, integrator, replace(problem, system=system, y0=problem.y0[i], letters=None))
        times[i] = outcome.stats.get("blow_up_time", np.nan)
    if np.isfinite(times).any():
        sol.stats["blow_up_time"] = times
        first = int(np.argmax(np.isfinite(times)))
        sol.message += f" A solution itself becomes infinite, at about t = {times[first]:.10g}: end `t_span` before."


def _not_begun(sol: Solution, problem: Problem) -> Solution:
    """The solution of trajectories that were to run after those of `sol`, which Ctrl-C ended."""
    batch, y0 = tuple(problem.y0.shape[:-1]), problem.y0
    empty = y0[..., None][..., :0]
    return replace(sol, t=sol.t[:0], y=empty, status=np.full(batch, -1), system=problem.system, y0=y0, sol=None)


def _up_to(sol: Solution, t: np.ndarray) -> Solution:
    """A solution of which the outputs at the last ones of the times t are unknown, NaN."""
    unknown = full_of_nan(sol.y0)[..., None]
    width = len(t) - len(sol.t)
    if is_tensor(sol.y):
        import torch

        return replace(sol, t=t, y=torch.cat([sol.y, *[unknown] * width], dim=-1), sol=None)
    return replace(sol, t=t, y=np.concatenate([sol.y, np.repeat(unknown, width, axis=-1)], axis=-1), sol=None)


def _run(integrator: Integrator, problem: Problem) -> tuple[Outcome, Problem]:
    """The outcome of a run, and the problem that was solved."""
    search = problem.events
    if search is None or integrator.finds_events:
        return integrator.run(problem), problem
    return run_and_search(integrator, problem, search), problem


def _run_diagnosed(rows: ParameterRows | None, integrator: Integrator, problem: Problem) -> tuple[Outcome, Problem]:
    """The outcome of a piece of a run, and its problem."""
    outcome, problem = _run(integrator, problem)
    _diagnose(outcome, integrator, problem, rows, stacklevel=7)
    return outcome, problem


def _diagnose(
    outcome: Outcome, integrator: Integrator, problem: Problem, rows: ParameterRows | None, stacklevel: int
) -> None:
    """Note poles that a run passed, digits that it lost, and when the solution of one that failed becomes infinite."""
    if not problem.diagnosed:
        return
    passed = False
    looked = problem.system.poles is not None or problem.letters is not None
    if looked and problem.store is None and readable(outcome.y):
        if np.any(np.asarray(outcome.status) >= 0):
            passed = note_poles(outcome, integrator, problem, rows, stacklevel=stacklevel + (rows is not None))
        if problem.letters is None:
            warn_of_cancelling(outcome, problem, stacklevel=stacklevel)
    failed = outcome.status < 0 if isinstance(outcome.status, int) else np.any(np.asarray(outcome.status) < 0)
    if failed and problem.letters is None and readable(problem.y0):
        note_singularities(outcome, integrator, problem, passed)


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
        if problem.diagnosed and system.poles is not None:
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
    if note_poles(piece, integrator, before, None, stacklevel=6):
        at = np.where(np.isnan(known), piece.stats["failed_at"], known)
        store.noted |= {"failed_at": at.tolist(), "passed": store.noted.get("passed", piece.message)}


def check_stored(problem: Problem, action: str, rows: ParameterRows | None) -> None:
    """Refuse what a store does not take, with the reason."""
    if is_tensor(problem.y0):
        raise TypeError("`store` takes NumPy states, for it keeps no gradients: pass y0.detach().numpy().")
    if problem.events is not None and problem.events.events:
        raise ValueError(
            "`store` takes no `events`, whose zeros are kept in memory: store the outputs, and look for the zeros in "
            "them, or leave `store` out."
        )
    if problem.dense_output:
        raise ValueError("`store` has no `dense_output`, which keeps every step in memory: choose times by `t_eval`.")
    if action == "stop":
        raise ValueError("`store` takes no `on_domain_exit` 'stop': use 'warn'.")
    if rows is not None and not rows.uniform:
        raise ValueError(
            "`store` is for trajectories of the same `params`: use sympflow.ensemble(..., params=..., store=...)."
        )


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


def _time_last(y: np.ndarray) -> np.ndarray:
    return y.T if y.ndim == 2 else np.moveaxis(y, 0, -1)


def _fits(outcome: Outcome, y0: Array) -> bool:
    """True if status, t and y have the types and shapes that they must have."""
    t, y, status = outcome.t, outcome.y, outcome.status
    if type(t) is type(y) is np.ndarray and type(status) is int:
        return t.ndim == 1 and y.shape == (t.size, *y0.shape)
    count = np.shape(t)[:1]
    shapes = np.shape(t) == count and tuple(np.shape(y)) == (*count, *y0.shape)
    return shapes and np.asarray(status).dtype.kind in "iu"


def _check_outcome(outcome: Any, integrator: Integrator, y0: Array) -> None:
    """Refuse what is no answer (of a plug-in), and flag states that are not finite, whatever the method says."""
    if not (isinstance(outcome, Outcome) and _fits(outcome, y0)):
        what = type(outcome).__name__
        if isinstance(outcome, Outcome):
            shapes = f"{np.shape(outcome.t)} and {tuple(np.shape(outcome.y))}"
            what = f"status {outcome.status!r}, t and y of shapes {shapes}"
        raise TypeError(
            f"`method` {integrator.name!r} must answer with an Outcome that has an integer status, t of shape (n,) and "
            f"y of shape (n, *y0.shape); got {what}. Mend its run(): check_integrator tests it."
        )
    if outcome.finite or (not is_tensor(outcome.y) and np.isfinite(outcome.y).all()):
        return
    finite = finite_states(outcome.y)
    bad = ~finite.all(0) & (np.asarray(outcome.status) >= 0)
    if not bad.any():
        return
    if is_tensor(outcome.y) and lanes(outcome.y):
        report_lanes(outcome, finite, Failure.NON_FINITE)
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
    shape = (*rows.shape, y0.shape[-1])
    return rows, (y0.expand(shape) if is_tensor(y0) else np.broadcast_to(y0, shape).copy())


def check_own_parameters(system: HamiltonianSystem, values: Mapping[str, ArrayLike], integrator: Integrator) -> None:
    """Refuse a trained flow for other parameters than its system's, and a sweep from where H is constant in time."""
    if system.autonomous and system.symbols is not None and system.symbols.named_time is not None and values:
        raise ValueError(
            "`params` are those of a driven system, and the values that `system` has make it constant in time: pass "
            "one whose H depends on t, as by system.with_params(...)."
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
        raise ValueError(
            f"`t_eval` is not given, so {values:.3g} values ({values * 8 / 2**30:.3g} GiB) would be stored, more than "
            f"{MAX_SAVED_VALUES:.0e}: choose the times with `t_eval`, or thin them with `save_every`"
            f"{', or leave dense_output out' if problem.dense_output else ''}."
        )
