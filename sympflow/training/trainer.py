"""train(): from a Hamiltonian system to a flow, without data."""

from __future__ import annotations

import copy
import inspect
import math
import warnings
from collections.abc import Callable, Iterable
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
import torch

from sympflow.arguments import advice, check_one_of, plain, real_number
from sympflow.flow.flow_map import FlowMap
from sympflow.flow.primed import PrimedFlow
from sympflow.flow.sympflow import SympFlow
from sympflow.hamiltonian.domain import Domain, Tube, domain_of, remedy_for
from sympflow.hamiltonian.fingerprint import check_for_flows
from sympflow.hamiltonian.system import HamiltonianSystem
from sympflow.solver import solve
from sympflow.systems.given import GivenSystem, given_system
from sympflow.training import checkpoint as checkpoints
from sympflow.training import fits, trials
from sympflow.training.clock_fit import train_clock
from sympflow.training.fits import ClockedFit, Fit, GaussNewton, KeplerFit, LossFit, NetworkFit, PrimedFit, Solver
from sympflow.training.lattice_fit import LatticeSubsystem, by_subsystem, check_runs, runs_of
from sympflow.training.network_fit import LossRun
from sympflow.training.planet_fit import can_train, train_planets
from sympflow.training.points import Stream, handed_in, start_times, warn_of_another_system
from sympflow.training.runs import Run, Unstarted
from sympflow.training.session import Deadline, OutOfTime, Path, Session
from sympflow.training.split_fit import SplitRun
from sympflow.training.starts import check_step, default_primed, scaling_of, warn_of_domain
from sympflow.training.table_fit import MadeRuns, TableRun
from sympflow.workers import WorkerPool

ORBIT = 1000  # states of an orbit about which a domain is made, a default step apart

DRIVEN = ("primed", "sympflow")  # kinds that are fitted to driven systems
SHORT_BUDGET = 15.0  # seconds of the least that has trials
STARTS = 72  # of a compiled fit without options: these take a second
SOME, SMALL, FEWEST = 24, 6, 3  # of other systems, up to so many degrees of freedom, and of the largest
BOUGHT = 1000  # starts that a budget buys at most


def train(
    system: GivenSystem | None = None,
    fit: Fit | float | None = None,
    *,
    flow: FlowMap | None = None,
    domain: Domain | None = None,
    solver: Solver | None = None,
    budget: float | None = None,
    checkpoint: Path | None = None,
    resume: Path | None = None,
    progress: bool | None = None,
    callback: Callable[[int, dict[str, float]], None] | None = None,
    workers: Any = 1,
    **options: Any,
) -> Any:
    """Train a flow map of `system` on [0, Δt]: by default the most accurate kind for the system.

    For planets about a star it is a `KeplerFlow`, found in half a minute. For another separable system with T = ½
    pᵀM⁻¹p it is a primed flow (`SympFlow.primed`), whose few numbers are fitted to the exact flow in seconds. For
    symbolic systems of up to three degrees of freedom short trials choose its Δt, and whether its kicks have curvature
    terms (`sympflow.training.trials`), unless an option of the flow or its fit is given. For any other system it is a
    SympFlow with MLP potentials, symplectic for every H, trained by Adam on its residual and by Hamiltonian matching,
    without data. The choice is the same on every machine.

    Parameters
    ----------
    system : HamiltonianSystem
        The system whose H the flow is fitted to, also if `data` are given.
    fit : Fit, optional
        `PrimedFit`, `SplitFit`, `NetworkFit`, `ClockedFit` and `KeplerFit` of `sympflow.training` make a flow and fit
        it; `LossFit` trains a given `flow` on losses. Their fields are the options. A number is Δt.
    flow : FlowMap, optional
        Train a copy of this flow further in place of a new one: one made by `SympFlow.primed` or `SympFlow.split`, say,
        or a second stage with another solver.
    domain : Domain, optional
        Ω; the default is that of the system.
    solver : GaussNewton, Adam, BFGS or LBFGS, optional
        By default `GaussNewton()` for primed and split flows, `Adam()` for others, which `GaussNewton` trains far
        better.
    budget : float, optional
        Stop after so many seconds, to 20 %, and a few seconds for what is imported and compiled. The limit includes
        trials (at most two thirds of it), labels (each set at most 0.3 of the remaining time), starts, fits and
        held-out errors. If labels take longer, the flow is returned untrained, with a warning. With a budget a symbolic
        system of up to three degrees of freedom has as many starts as two fifths of the time allow, up to 1000: so the
        flow depends on the machine. Without one the same call gives the same flow, however long it takes.
    checkpoint : path, optional
        Write the state of the run there at intervals, atomically; for a primed flow after each start of the search.
        During the trials nothing is written.
    resume : path, optional
        Continue from this checkpoint, with otherwise the same arguments; the weights are bit-identical to those of an
        uninterrupted run.
    progress : bool, optional
        Show a progress bar; the default is on a terminal only.
    callback : callable, optional
        callback(step, figures), called after each validation; `figures` has the held-out losses and one-step error.
    workers : int, object with .map, or callable
        Workers for the trials, starts and fits of `GaussNewton` on a primed or a split flow: a number of processes, −1
        for as many as there are cores, or an engine as for `sympflow.ensemble`. Without a budget the result does not
        depend on them, to the last bit.
    **options
        In place of `fit` and `solver` their fields by name, with `dt`, `kind` ("primed", "kepler", "sympflow", a
        network, or "mlp", the baseline), `optimizer` ("gauss-newton", "adam", "bfgs", "lbfgs"), and `time_budget` for
        `budget`: ``train(system, dt=0.5, stages=3, restarts=12)``.

    Returns
    -------
    SympFlow or MLPFlow
        In its best state by the held-out loss, its parameters without gradient; `recipe` and `figures` describe how it
        was made and how accurate it is, `history` has the held-out errors over the run. Ctrl-C, a used-up budget and a
        loss that is not finite also end the run with the best state so far, and a warning. Ctrl-C does so within
        seconds, once the first trial is finished. A second Ctrl-C raises KeyboardInterrupt.

    Warns
    -----
    UserWarning
        If the flow is far from the exact one: if its error in one step of Δt is at least a tenth of the displacement in
        that step, in the mean over held-out states and with coordinates in units of their spread over Ω; or, for a
        network on a separable system, at least that of one Verlet step. `figures` has both as "missed_share" and
        "verlet_missed_share".

    Raises
    ------
    ValueError
        If the system has no domain and none is given, an argument is not admissible, Δt is far beyond the periods of
        the system, or the weights and points would take more memory than the machine has.
    TypeError
        If the fit or the solver does not have an option; the message lists those it has.
    FloatingPointError
        If the loss is not finite from the start.
    KeyboardInterrupt
        On Ctrl-C before there is anything to return, or twice.

    Examples
    --------
    >>> flow = train(system, PrimedFit(stages=3, processor=6), solver=GaussNewton(restarts=24), budget=15)
    """
    if real_number(fit := plain(fit)):
        fit, options = None, {"dt": fit, **options}
    _refuse_unknown(options)
    system = _known_system(system, fit.data if isinstance(fit, LossFit | PrimedFit) else options.get("data"))
    start, budget = None, plain(budget)
    if solver is not None and not isinstance(solver, Solver):
        raise TypeError(f"`solver` must be GaussNewton(), Adam(), BFGS() or LBFGS(); got {solver!r}.")
    if budget is not None and "time_budget" in options:
        raise TypeError("`budget` and `time_budget` are the same limit: leave out one of them.")
    if budget is not None and not (real_number(budget) and 0 < budget < math.inf):
        raise ValueError(f"`budget` must be a positive number of seconds; got {budget!r}: leave it out.")
    limit = options.pop("time_budget", budget)
    session = Session(checkpoint, resume, plain(limit), progress, callback, WorkerPool(workers))
    if _of_planets(system, fit, flow, solver, options):
        kind = options.pop("kind", None)
        for name in (name for name in options if name not in KeplerFit.names()):
            raise TypeError(f"`{name}` is not an option of flows of kind {kind!r}: leave it out.")
        fit, options = KeplerFit(**{name: plain(x) for name, x in options.items()}), {}
    if fit is None or not isinstance(fit, Fit):
        fit, solver, start = _described(system, fit, solver, flow, fits.said(options))
    elif options:
        raise TypeError(f"`{next(iter(options))}` was given in addition to `fit`: make it an option of `fit`.")
    return fit_flow(system, flow, fit, solver, domain, session, start)


def fit_flow(
    system: HamiltonianSystem,
    flow: FlowMap | None,
    fit: Fit,
    solver: Solver | None,
    domain: Domain | None,
    session: Session,
    start: PrimedFit | None = None,
) -> Any:
    """`train`, its arguments sorted: a new flow, one to `start` with or a given one, and its fit."""
    if isinstance(fit, KeplerFit | ClockedFit):
        of_steps = {"solver": solver, "checkpoint": session.checkpoint, "resume": session.resume}
        for name, value in {**of_steps, "callback": session.callback}.items():
            if value is not None:
                raise TypeError(
                    f"`{name}` is for fits that run in steps, and {type(fit).__name__} does not: leave it out."
                )
    if isinstance(fit, KeplerFit):  # along an orbit, which needs no domain
        _checked_kind(system, flow, fit)
        return train_planets(system, fit, domain or system.domain, session)
    domain = _domain_for(system, domain)
    solver = _solver_for(fit, solver)
    if start is not None:
        if start.dt is None:
            warn_of_domain(system, domain)
        flow = _with_defaults(system, domain, start).flow(system)
    kind = _checked_kind(system, flow, fit)
    check_for_flows(system, takes_friction=kind == "primed", takes_driving=kind in DRIVEN)
    if isinstance(fit, ClockedFit):
        return train_clock(system, fit, domain)
    if isinstance(fit, PrimedFit):
        if fit.runs is not None:
            check_runs(system, fit)
        if fit.data is None and by_subsystem(system):
            few = LatticeSubsystem.of(system, domain)
            small = None if flow is None else few.small(flow)
            runs = None if fit.runs is None else partial(runs_of, few, fit.runs, fit.seed)
            fitted = _fitted(few.system, small, kind, replace(fit, runs=None), solver, few.domain, session, runs)
            return few.whole(fitted)
    if not (isinstance(fit, PrimedFit | fits.SplitFit) or session.pool.alone):
        raise TypeError(
            "`workers` share the starts of a search by 'gauss-newton' for primed and split flows, and this fit is one "
            "run of steps: leave it out."
        )
    return _fitted(system, flow, kind, fit, solver, domain, session)


def _fitted(
    system: HamiltonianSystem,
    flow: FlowMap | None,
    kind: str,
    fit: Fit,
    solver: Solver,
    domain: Domain,
    session: Session,
    runs: MadeRuns | None = None,
) -> Any:
    """The fit of `fit_flow` to the system itself; `runs` makes those to whose energy errors the table is fitted too."""
    new = flow is None
    untold = isinstance(solver, GaussNewton) and solver.restarts is None and solver.steps is None
    open_starts = new and isinstance(fit, PrimedFit) and untold and session.resume is None
    with session.interruption, session.pool, np.errstate(divide="ignore", invalid="ignore"):
        tried = None
        if new and fit.dt is not None:
            check_step(system, domain, fit.dt)
        if flow is not None:
            if kind in DRIVEN or kind == "mlp":  # the others have exact parts, however fast
                check_step(system, domain, flow.dt)
        elif isinstance(fit, PrimedFit):
            if fit.dt is None:
                warn_of_domain(system, domain)
            flow, tried = _new_primed(system, domain, fit, solver, session)
            session.cut = session.interruption.asked  # what trials were left out does not end the run
        elif not isinstance(fit, NetworkFit):
            flow = fit.flow(system, domain)
        system.vector_field(
            domain.sample(1, 0), start_times(system, 0.0, 1, 0, Stream.LABELS)
        )  # what is compiled for it counts, but not as labels
        compiled = trials.can_try(system)
        limited = session.time_budget is not None
        bought = open_starts and session.checkpoint is None and (compiled or not limited)
        if bought and isinstance(solver, GaussNewton):
            few = max(FEWEST, round(SOME * min(1.0, (SMALL / system.ndof) ** 2)))
            solver = replace(solver, restarts=few if not compiled else BOUGHT if limited else STARTS)
        run = _run_of(system, domain, flow, tried, fit, solver, session.deadline, runs)
        if session.resume is not None:
            run.load(session.resume)
        reason = run.go(session)
    return run.finish(reason, expected=bought and limited)


# arguments --------------------------------------------------------------------------------------------------------


def _refuse_unknown(options: dict[str, Any]) -> None:
    """Raise if there are options that `train` does not have, with what may be meant."""
    arguments = [each for each in inspect.signature(train).parameters if each not in ("system", "options")]
    known = [*arguments, "time_budget", *fits.keywords()]
    for name, value in options.items():
        if name in known:
            continue
        for maker in (SympFlow.primed, SympFlow.split, SympFlow.timed):
            if name in inspect.signature(maker).parameters:
                by = maker.__qualname__
                raise TypeError(f"`{name}` is an option of {by}: pass flow={by}(system, ..., {name}={value!r}).")
        remedy = advice(name, known) or "remove it."
        raise TypeError(f"`{name}` is not an option of train(), which takes {', '.join(known)}: {remedy}")


def _known_system(system: Any, data: Any) -> HamiltonianSystem:
    """Return H; a TypeError for data without a system."""
    is_data = isinstance(system, Iterable) or system is None or data is not None
    if is_data and not isinstance(system, HamiltonianSystem | str):
        raise TypeError(
            f"`system` must be a HamiltonianSystem, the H of the flow; got {type(system).__name__}: train() fits a "
            "flow to an H that is known, and `data` adds labels to that; it finds no H in data. Define H by "
            "HamiltonianSystem.from_sympy, or where you have its vector field by "
            "sympflow.interop.systems.from_module, and pass data=(t, x, y) beside it."
        )
    return given_system(system)


def _domain_for(system: HamiltonianSystem, domain: Domain | None) -> Domain:
    """Ω of a training: the domain that is given, else that of the system; checked."""
    domain = system.domain if domain is None else domain
    if domain is None and system.local is not None and system.local.has_subsystem and system.y0 is not None:
        domain = system.local_states()
    if domain is None:
        domain = _around_orbit(system)
    if domain is None:
        raise ValueError(
            f"`domain` is not known for the system {system.name!r}: pass the states to train on, as by "
            f"domain={remedy_for(system)}."
        )
    if not isinstance(domain, Domain):
        raise TypeError(f"`domain` must be a domain of phase space; got {domain!r}: use {remedy_for(system)}.")
    domain = domain_of(domain, system)
    width = domain.sample(1, 0).shape[-1]
    if width != 2 * system.ndof:
        raise ValueError(f"`domain` has states of length {width}, the system {2 * system.ndof}: give [q, p].")
    return domain


def _around_orbit(system: HamiltonianSystem) -> Domain | None:
    """A tube about the orbit of y0, a tenth of its extent wide; None of a system without one, or one that fails."""
    if system.y0 is None:
        return None
    t0, t1 = system.t_span
    end = t0 + math.copysign(min(abs(t1 - t0), ORBIT * system.dt), t1 - t0)
    with warnings.catch_warnings(action="ignore"):
        try:
            sol = solve(system, t_span=(t0, end), t_eval=np.linspace(t0, end, ORBIT + 1))
        except (ValueError, TypeError):
            return None
    size = np.ptp(sol.y, axis=-1).reshape(2, -1).max(1) / 10
    return Tube(sol.states, np.repeat(size, system.ndof)) if sol.success and (size > 0).all() else None


def _solver_for(fit: Fit, solver: Solver | None) -> Solver:
    """The solver that is given, or the default of a fit."""
    searches = isinstance(fit, PrimedFit | fits.SplitFit)
    if solver is None:
        return GaussNewton() if searches else fits.Adam()
    if searches and not isinstance(solver, GaussNewton):
        raise TypeError(
            f"`solver` of {type(fit).__name__} is GaussNewton; for {type(solver).__name__} pass LossFit() with a flow, "
            f"flow=SympFlow.{fit.kind}(system)."
        )
    return solver


# which flow and which fit -----------------------------------------------------------------------------------------


def _described(
    system: HamiltonianSystem, fit: Any, solver: Solver | None, flow: FlowMap | None, options: dict[str, Any]
) -> tuple[Fit, Solver, PrimedFit | None]:
    """The fit, the solver and the primed flow to begin with that plain keywords describe."""
    if fit is not None:
        raise TypeError(f"`fit` must be a fit of sympflow.training, such as PrimedFit(); got {fit!r}: or Δt, a number.")
    dt, by = options.get("dt"), options.pop("optimizer", None) if solver is None else solver.name
    searches = by in (None, GaussNewton.name)
    kind, of_flow = options.pop("kind", None), (*fits.OF_PRIMED, *fits.OF_NETWORKS, "dtype", "device")
    if flow is not None:
        if not isinstance(flow, FlowMap):
            raise TypeError(f"`flow` must be a SympFlow or an MLPFlow; got {flow!r}: leave it out for a new one.")
        for name in ["kind"] * (kind is not None) + [name for name in options if name in of_flow]:
            raise ValueError(f"`{name}` describes a new flow, but `flow` is given: leave out one of them.")
        if dt is not None and dt != flow.dt:
            raise ValueError(f"`dt` is {dt!r} but the flow has {flow.dt!r}: leave `dt` out to train it further.")
        options.pop("dt", None)
        kind = _kind_of(flow)
    else:
        named = ["kind"] * (kind is not None) + [n for n in options if n in (*fits.OF_PRIMED, *fits.OF_SEARCHES)]
        kind = _meant(system, options, searches) if kind is None else kind
        check_one_of("kind", kind, (*fits.KINDS, KeplerFit.kind))
        for name in (n for n in options if n in (fits.OF_NETWORKS if kind == "primed" else fits.OF_PRIMED)):
            raise TypeError(f"`{name}` is not an option of flows of kind {kind!r}: leave it out.")
        if kind == "primed":
            _check_primable(system, named, searches)
    start = None
    if kind == "primed" and flow is None and not searches:
        start = PrimedFit(**{n: options.pop(n) for n in PrimedFit.of_flow() if n in options})
    made, found = fits.from_keywords(options, kind, by, flow)
    if solver is not None and (twice := [name for name in options if name in found.names()]):
        raise TypeError(f"`{twice[0]}` was given in addition to `solver`: make it an option of `solver`.")
    return made, found if solver is None else solver, start


def _of_planets(system: HamiltonianSystem, fit: Any, flow: Any, solver: Any, options: dict[str, Any]) -> bool:
    """Return True where a new flow of planets is meant: by name, or by no option but those that it has."""
    if fit is not None or flow is not None:
        return False
    kind, like = options.get("kind"), set(options) <= set(KeplerFit.names())
    return kind == KeplerFit.kind or (kind is None and solver is None and like and can_train(system))


def _kind_of(flow: FlowMap) -> str:
    """The kind of a given flow."""
    return next((fit.kind for family, fit in fits.FITTED if isinstance(flow, family)), flow.kind)


def _meant(system: HamiltonianSystem, options: dict[str, Any], searches: bool) -> str:
    """The kind that is meant where none is named."""
    searched = [name for name in options if name in fits.OF_SEARCHES]
    suitable = system.separable and system.quadratic_kinetic
    if searched and not suitable:
        raise ValueError(
            f"`{searched[0]}` is of the search for primed flows by Gauss–Newton, which needs H = ½ pᵀM⁻¹p + V(q); "
            f"{system.name!r} is of another form: leave it out for a network, or pass kind='primed', optimizer='bfgs'."
        )
    if searched or any(name in fits.OF_PRIMED for name in options):
        return "primed"
    of_search = {*PrimedFit.names(), "steps", "restarts"} - {"dtype", "device"}
    of_networks = [name for name in options if name not in of_search]
    if "loss" not in options:
        of_networks += [name for name in (*fits.WEIGHTS, "matching_times", "data") if name in options]
    return "primed" if suitable and searches and not of_networks else "sympflow"


def _check_primable(system: HamiltonianSystem, given: list[str], searches: bool) -> None:
    """Raise if a new primed flow of the system cannot be made, or not be fitted by its solver."""
    named = " and ".join(f"`{name}`" for name in given)
    needs = f"{named} asks for a flow primed with V and T"
    if not system.separable:
        raise ValueError(
            f"{needs}, but the system {system.name!r} has one function H, not known as T(p) + V(q): leave out {named} "
            "for a network, or define the system with HamiltonianSystem.from_sympy."
        )
    if not system.quadratic_kinetic and searches:
        raise ValueError(
            f"{needs}, whose table Gauss–Newton fits only where T = ½ pᵀM⁻¹p, as it is not in the system "
            f"{system.name!r}: leave out {named} for a network, or pass optimizer='bfgs'."
        )


def _checked_kind(system: HamiltonianSystem, flow: FlowMap | None, fit: Fit) -> str:
    """The kind of the given flow, or of the new one that the fit makes; raises if they do not go together."""
    if flow is None:
        if type(fit) is LossFit:
            raise TypeError("`flow` is missing, which LossFit trains further: pass one, or NetworkFit() for a new one.")
        if isinstance(fit, PrimedFit):
            _check_primable(system, ["fit"], True)
        return fit.kind
    family = next((family for family, cls in fits.FITTED if isinstance(fit, cls)), FlowMap)
    if not isinstance(flow, family) or isinstance(fit, NetworkFit | ClockedFit | KeplerFit):
        raise TypeError(
            f"`fit` {type(fit).__name__} is not one of a given {type(flow).__name__}: pass LossFit(), or leave it out."
        )
    for name in (name for name in fit.given() if name in fit.of_flow()):
        raise ValueError(f"`{name}` describes a new flow, but `flow` is given: leave out one of them.")
    flow.check_system(system)
    if not flow.n_parameters:
        raise ValueError(f"`flow` is a {type(flow).__name__}, which has no numbers to be fitted: use it as it is.")
    return _kind_of(flow)


def _with_defaults(system: HamiltonianSystem, domain: Domain, fit: PrimedFit) -> PrimedFit:
    """The primed flow with what `default_primed` has where nothing is said, Δt in proportion to the kicks."""
    if not system.separable or (fit.dt is not None and fit.stages is not None and fit.processor is not None):
        return fit
    default = default_primed(system, domain, fit.dt)
    dt: Any = default.dt
    if fit.stages is not None and default.stages is not None:
        dt = float(f"{dt * fit.stages / default.stages:.3g}")
    stages = default.stages if fit.scheme is None else None
    return fit.but(dt=dt, stages=stages, processor=default.processor)


def _new_primed(
    system: HamiltonianSystem, domain: Domain, fit: PrimedFit, solver: Solver, session: Session
) -> tuple[PrimedFlow, PrimedFlow | None]:
    """A new primed flow, and the one of a trial if trials chose it; of a run to go on with that one's shape."""
    given = set(fit.given())
    if not given & set(fit.of_flow()) and trials.can_try(system):
        hurried = session.time_budget is not None and session.time_budget < SHORT_BUDGET
        if session.resume is not None:
            theirs = checkpoints.read(session.resume)["architecture"]
            for start in trials.all_starts(system, domain):
                flow = start.flow(system)
                if checkpoints.identity(flow, system, {})["architecture"] == theirs:
                    return flow, None
        elif given <= {"seed", "reference_states"} and solver == GaussNewton() and not hurried:
            trial = trials.chosen_trial(system, domain, session)
            return trial.start.flow(system), trial.flow
    return _with_defaults(system, domain, fit).flow(system), None


def _run_of(
    system: HamiltonianSystem,
    domain: Domain,
    flow: Any,
    tried: PrimedFlow | None,
    fit: Any,
    solver: Any,
    deadline: Deadline,
    runs: MadeRuns | None = None,
) -> Run:
    """The run of a copy of a flow, or of a new network if there is none."""
    dtype = (fit if flow is None else flow).dtype
    if isinstance(solver, GaussNewton) and dtype != torch.float64:
        raise TypeError("`optimizer` 'gauss-newton' fits flows in float64: leave out `dtype`, or use 'adam'.")
    if flow is not None:
        flow = copy.deepcopy(flow).bound(system)
        flow.certified = None  # of the numbers as they were
    dt = flow.dt if flow is not None else 1.0 if fit.dt is None else float(fit.dt)
    scaling = None
    try:
        if isinstance(fit, fits.SplitFit):
            return SplitRun(flow, system, domain, scaling, fit, solver, deadline)
        if fit.data is not None:
            fit = replace(fit, data=handed_in(fit.data, system, dt))
            warn_of_another_system(fit.data, system)
        scaling = scaling_of(domain, dt, fit.seed)
        if isinstance(fit, PrimedFit):
            return TableRun(flow, system, domain, scaling, fit, solver, deadline, tried=tried, made_runs=runs)
        if isinstance(fit, NetworkFit):
            flow = fit.network(system, dt, scaling)
        return LossRun(flow.requires_grad_(True), system, domain, scaling, fit, solver, deadline)
    except OutOfTime as cut:
        flow = flow if tried is None else tried
        return Unstarted(flow, system, domain, scaling, fit, solver, reached=str(cut))
