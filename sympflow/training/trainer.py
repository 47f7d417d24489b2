"""train(): from a Hamiltonian system to a flow, without data."""

from __future__ import annotations

import copy
import difflib
import inspect
import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
import torch
from numpy.typing import ArrayLike

from sympflow.arguments import plain
from sympflow.arrays import is_tensor
from sympflow.flow.flow_map import FlowMap
from sympflow.flow.primed import PrimedFlow
from sympflow.flow.split import SplitFlow
from sympflow.flow.sympflow import SympFlow
from sympflow.hamiltonian.domain import Domain, domain_of, remedy_for
from sympflow.hamiltonian.fingerprint import check_for_flows
from sympflow.hamiltonian.system import HamiltonianSystem
from sympflow.systems.given import given_system
from sympflow.training import checkpoint as checkpoints
from sympflow.training import trials
from sympflow.training.energy_runs import check_runs, runs_of
from sympflow.training.lattice_fit import Piece, on_piece
from sympflow.training.network_fit import LossRun
from sympflow.training.options import (
    KINDS,
    OF_LOSSES,
    OF_SEARCHES,
    LossOptions,
    NewFit,
    NewFlow,
    SplitOptions,
    TableOptions,
    is_number,
    plain_numbers,
)
from sympflow.training.points import Stream, digest, handed_in, start_times, unlabelled, warn_of_another_system
from sympflow.training.runs import Run, Unstarted
from sympflow.training.session import Deadline, OutOfTime, Path, Session
from sympflow.training.split_fit import SplitRun
from sympflow.training.starts import check_step, default_primed, new_network, scaling_of, warn_of_domain
from sympflow.training.table_fit import MadeRuns, TableRun
from sympflow.workers import Crew

DRIVEN = ("primed", "sympflow")  # kinds that are fitted to driven systems
BUDGET = 60.0  # seconds of a fit of which nothing else is said
SHORT_BUDGET = 15.0  # of such a fit with trials, which is compiled: most end before
STARTS = 72  # of such a fit, where it is compiled: these take a second
BOUGHT = 1000  # starts that a time budget buys at most


def train(
    system: HamiltonianSystem | None = None,
    dt: float | None = None,
    *,
    kind: str | None = None,
    flow: FlowMap | None = None,
    domain: Domain | None = None,
    pairs: int | None = None,
    hidden: Sequence[int] | None = None,
    activation: str | None = None,
    dtype: torch.dtype | None = None,
    device: torch.device | str | None = None,
    stages: int | None = None,
    processor: int | None = None,
    optimizer: str | None = None,
    loss: str | None = None,
    steps: int | None = None,
    points: int | None = None,
    residual_weight: float = 1.0,
    matching_weight: float | None = None,
    label_weight: float | None = None,
    data: tuple[ArrayLike, ArrayLike, ArrayLike] | None = None,
    matching_times: int = 10,
    learning_rate: float = 5e-3,
    schedule: str = "one-cycle",
    clip: float | None = 1.0,
    refresh: int | None = None,
    seed: int = 0,
    validate_every: int | None = None,
    validation_points: int = 2000,
    reference_states: int = 100,
    restarts: int | None = None,
    label_times: int | None = None,
    frozen_weight: float | None = None,
    energy_weight: float | None = None,
    runs: int | None = None,
    checkpoint: Path | None = None,
    checkpoint_every: int | None = None,
    resume: Path | None = None,
    time_budget: float | None = None,
    progress: bool | None = None,
    callback: Callable[[int, dict[str, float]], None] | None = None,
    workers: Any = 1,
    **unknown: Any,
) -> Any:
    """Train a flow map of `system` on [0, dt]: with nothing else given, the best that is known for it.

    For a separable system with T = ½ pᵀM⁻¹p, however V was given, that is a primed flow (`SympFlow.primed`), whose few
    numbers are fitted to the exact flow in seconds. In up to three degrees of freedom of a symbolic system short trials
    choose its Δt, and whether its kicks have curvature terms (`sympflow.training.trials`), unless an option says
    something of the flow or its fit. For
    any other system it is a SympFlow with MLP potentials, symplectic for every H, trained by Adam on its residual and
    by Hamiltonian matching, without data. A flow of any kind, one made by `SympFlow.primed` or `SympFlow.split` among
    them, is trained further as `flow`.

    Parameters
    ----------
    system : HamiltonianSystem
        H, which a flow is fitted to, with `data` as well.
    dt : float, optional
        Δt, the longest time of the map; the default is that of `flow`, for a new primed flow what suits the system's
        frequencies on Ω (see `sympflow.training.starts`) and gains most in trials, else 1. At most thirty periods of
        half of the states of Ω: no flow takes more in one step.
    kind : {"primed", "sympflow", "mlp"}, optional
        The architecture: a SympFlow primed with the system's V and T; one with MLP potentials; or the unconstrained
        baseline with as many parameters as the SympFlow that `pairs` and `hidden` describe. The default is "primed"
        for the systems above, unless an option says that it is to be a network.
    flow : FlowMap, optional
        Train a copy of this flow further (a second stage, say, with another optimizer) in place of a new one.
    domain : Domain, optional
        Ω; the default is that of the system.
    stages, processor
        Of a new primed flow, see `SympFlow.primed`; the defaults are 3 kicks, or as many as a given `dt` needs, and a
        processor of 6.
    pairs, hidden, activation, dtype, device
        Of a new network, see `SympFlow`; the defaults are 3, (10, 10), "tanh" and float64 on the CPU.
    optimizer : {"gauss-newton", "adam", "bfgs", "lbfgs"}, optional
        The default is "gauss-newton" for primed and split flows, "adam" for networks, which "gauss-newton" trains far
        better.
    steps, points, residual_weight, matching_weight, label_weight, matching_times, learning_rate, schedule, clip,
    refresh, seed, validate_every, validation_points, reference_states, checkpoint_every
        See `sympflow.training.options.LossOptions`. What is left out gets the optimizer's own default: 20,000 steps on
        700 fresh points for Adam, at most 200 on 1500 fixed points for Gauss–Newton. A baseline has no Hamiltonian, so
        its matching weight is 0; Gauss–Newton leaves matching out as well, unless it is given a weight.
    data : (array (n,), array (n, 2d), array (n, 2d)), optional
        Labels of a network: times in [0, dt], states, and where the exact flow takes them; a tenth is held out.
        `label_weight` is then 1. Without data, labels are made where `label_weight` is given.
    loss : str, optional
        Some of "residual", "matching" and "labels", joined by "+": those that are left out get the weight 0. The
        default is "labels" for primed flows with optimizer="gauss-newton", else what the weights say.
    restarts, label_times, frozen_weight
        Of "gauss-newton" on a primed or a split flow, which takes of those above `steps`, `points`, `seed` and
        `reference_states`: see `sympflow.training.options.SearchOptions`. `label_times` counts for a network's
        `label_weight` too.
    energy_weight : float, optional
        Of "gauss-newton" on a primed flow: how much an error in the energy counts beside those of the coordinates. 10
        by default; 1000 for runs of which only the energy matters, 0 for none.
    runs : int, optional
        Of a primed flow of a lattice: after the search its numbers are fitted further to the energy
        errors of so many long runs of a larger ring; 48 is usual. Large systems lose several times less
        energy then, and the fit takes about twice as long. The default is none.
    checkpoint : path, optional
        Write the state of the run there every `checkpoint_every` steps, atomically; of a primed flow after each start
        of the search, and first as soon as there is a run: of one that is killed in the trials nothing is kept.
    resume : path, optional
        Go on from this checkpoint, given the same arguments otherwise; the weights end bit-identical to those of a
        run that was not interrupted.
    time_budget : float, optional
        Stop after so many seconds, to 20 %, and a few seconds for what is imported and compiled; a single evaluation of
        a network's loss at 32 points is the smallest piece. All counts: trials (at most two thirds of it), labels (at
        most 0.3 of what is left, each set), starts, fits, held-out figures. Where labels take longer the flow is
        returned as it was, and a warning says how far they came. The default for a new primed flow is 60, and 15
        where trials choose it, unless `restarts`, `steps` or `resume` is given: the search may take fewer starts then,
        which the recipe records; else there is none. In up to three degrees of freedom of a symbolic system such a fit
        has 72 starts; one with a budget, and without `restarts`, `steps` and files, as many as two fifths of the time
        allow, up to 1000.
    progress : bool, optional
        Show a progress bar; the default is on a terminal only.
    callback : callable, optional
        callback(step, figures) after each validation; `figures` has the held-out losses and one-step error.
    workers : int, object with .map, or callable
        Who follows the starts and fits of "gauss-newton" on a primed or a split flow, and makes the trials: a number of
        processes, −1 for as many as there are cores, or an engine as for `sympflow.ensemble`. Without a time budget the
        result is the same to the last bit whatever they are.

    Returns
    -------
    SympFlow or MLPFlow
        In its best state by the held-out loss, its parameters without gradient; `recipe` and `figures` tell how it
        was made and what it achieves, `history` the held-out figures over the run. Ctrl-C, a used-up budget and a
        loss that is not finite also end the run with the best state so far, and a warning. Ctrl-C does so within
        seconds, once there is a state to return: in the trials from the end of the first. A second one raises.

    Warns
    -----
    UserWarning
        If the flow is far from the exact one: where its error in one step of Δt is, in the mean over held-out states, a
        tenth or more of what the step moves a state, coordinates in units of their spread over Ω; or, for a network on
        a separable system, no less than that of one Verlet step. `figures` has both as "missed_share" and
        "verlet_missed_share".

    Raises
    ------
    ValueError
        If the system has no domain and none is given, an argument is not admissible, Δt is far beyond the periods of
        the system, or the weights and points would take more memory than the machine has.
    TypeError
        If an option is not one of the optimizer's, or of no training at all.
    FloatingPointError
        If the loss is not finite from the start.
    KeyboardInterrupt
        On Ctrl-C before there is anything to return, or twice.
    """
    _refuse_unknown(unknown)
    system = _known_system(system, data)
    dt = plain(dt)
    if dt is not None and not (is_number(dt) and 0 < dt < math.inf):
        raise ValueError(f"`dt` must be a positive finite number; got {dt!r}: leave it out for the default.")
    session = Session(checkpoint, resume, plain(time_budget), progress, callback, Crew(workers))
    new = NewFlow(kind, stages, processor, pairs, hidden, activation, dtype, device)
    asked = NewFit(
        optimizer=optimizer,
        loss=loss,
        steps=steps,
        points=points,
        learning_rate=learning_rate,
        schedule=schedule,
        clip=clip,
        refresh=refresh,
        validate_every=validate_every,
        validation_points=validation_points,
        checkpoint_every=checkpoint_every,
        residual_weight=residual_weight,
        matching_weight=matching_weight,
        label_weight=label_weight,
        matching_times=matching_times,
        data=data,
        seed=seed,
        reference_states=reference_states,
        restarts=restarts,
        label_times=label_times,
        frozen_weight=frozen_weight,
        energy_weight=energy_weight,
        runs=runs,
    )
    return fit_flow(system, dt, flow, plain_numbers(new), plain_numbers(asked), domain, session)


def fit_flow(
    system: HamiltonianSystem,
    dt: float | None,
    flow: FlowMap | None,
    new: NewFlow,
    asked: NewFit,
    domain: Domain | None,
    session: Session,
) -> Any:
    """`train`, its arguments sorted: a new flow or a given one, its fit, and the surroundings of the run."""
    domain = _domain_for(system, domain)
    kind = _kind_of(system, flow, new, asked)
    if asked.runs is not None:
        check_runs(system, asked)
    check_for_flows(system, takes_friction=kind == "primed", takes_driving=kind in DRIVEN)
    if kind == "primed" and asked.searches and asked.data is None and on_piece(system):
        piece = Piece.of(system, domain)
        start = None if flow is None else piece.small(flow)
        runs = None if asked.runs is None else partial(runs_of, piece, asked.runs, asked.seed)
        fitted = _fitted(piece.system, dt, start, kind, new, replace(asked, runs=None), piece.domain, session, runs)
        return piece.whole(fitted)
    return _fitted(system, dt, flow, kind, new, asked, domain, session)


def _fitted(
    system: HamiltonianSystem,
    dt: float | None,
    flow: FlowMap | None,
    kind: str,
    new: NewFlow,
    asked: NewFit,
    domain: Domain,
    session: Session,
    runs: MadeRuns | None = None,
) -> Any:
    """The fit of `fit_flow` to the system itself; `runs` makes those to whose energy errors the table is fitted too."""
    untold = flow is None and asked.restarts is None and asked.steps is None
    hurried = untold and session.time_budget is None and session.resume is None and kind == "primed" and asked.searches
    if hurried:
        session.time_budget = SHORT_BUDGET if dt is None and trials.can_try(system) else BUDGET
    if not ((kind in ("primed", "split") and asked.searches) or session.crew.alone):
        raise TypeError(
            "`workers` share the starts of a search by 'gauss-newton' for primed and split flows, and this fit is one "
            "run of steps: leave it out."
        )
    with session.interruption, session.crew, np.errstate(divide="ignore", invalid="ignore"):
        tried = None
        if dt is not None and flow is None:
            check_step(system, domain, dt)
        if flow is not None:
            _check_flow(flow, system, dt)
            if kind in ("primed", "sympflow", "mlp"):  # the others have exact parts, however fast
                check_step(system, domain, flow.dt)
        elif kind == "primed":
            if asked.searches:
                TableOptions.of(asked)  # raises before trials
            if dt is None:
                warn_of_domain(system, domain)
            flow, tried = _new_primed(system, domain, dt, new, asked, session)
            session.cut = session.interruption.asked  # what trials were left out does not end the run
        system.vector_field(
            domain.sample(1, 0), start_times(system, 0.0, 1, 0, Stream.LABELS)
        )  # what is compiled for it counts, but not as labels
        bought = untold and kind == "primed" and asked.searches and session.checkpoint is None
        bought = bought and session.time_budget is not None and session.resume is None and trials.can_try(system)
        if bought:
            asked = replace(asked, restarts=STARTS if hurried else BOUGHT)
        run = _run_of(system, domain, kind, flow, tried, dt, new, asked, session.deadline, runs)
        if session.resume is not None:
            run.load(session.resume)
        reason = run.go(session)
    return run.finish(reason, expected=hurried or bought)


# arguments --------------------------------------------------------------------------------------------------------


def _refuse_unknown(options: dict[str, Any]) -> None:
    """Raise if there are options that `train` does not have, with what may be meant."""
    known = [each for each in inspect.signature(train).parameters if each != "unknown"]
    for name, value in options.items():
        for maker in (SympFlow.primed, SympFlow.split, SympFlow.timed):
            if name in inspect.signature(maker).parameters:
                by = maker.__qualname__
                raise TypeError(f"`{name}` is an option of {by}: pass flow={by}(system, ..., {name}={value!r}).")
        close = difflib.get_close_matches(name, known, n=1)
        hint = f"is `{close[0]}` meant?" if close else f"choose from {', '.join(known[1:])}."
        raise TypeError(f"`{name}` is no option of train(): {hint}")


def _known_system(system: Any, data: Any) -> HamiltonianSystem:
    """Return H, of which data alone tell nothing."""
    if not isinstance(system, HamiltonianSystem | str) and (data is not None or system is None or _is_data(system)):
        raise TypeError(
            f"`system` must be a HamiltonianSystem, the H of the flow; got {type(system).__name__}: train() fits a "
            "flow to an H that is known, and `data` adds labels to that; it finds no H in data. Define H by "
            "HamiltonianSystem.from_sympy, or where you have its vector field by "
            "sympflow.interop.systems.from_module, and pass data=(t, x, y) beside it."
        )
    return given_system(system)


def _is_data(value: Any) -> bool:
    return isinstance(value, list | tuple | dict | np.ndarray) or is_tensor(value)


def _domain_for(system: HamiltonianSystem, domain: Domain | None) -> Domain:
    """Ω of a training: the domain that is given, else that of the system; checked."""
    domain = system.domain if domain is None else domain
    if domain is None and system.local is not None and system.local.has_piece and system.y0 is not None:
        domain = system.local_states()
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


def _check_flow(flow: FlowMap, system: HamiltonianSystem, dt: float | None) -> None:
    if dt is not None and dt != flow.dt:
        raise ValueError(f"`dt` is {dt!r} but the flow has {flow.dt!r}: leave `dt` out to train it further.")
    flow.check_system(system)
    if not flow.n_parameters:
        raise ValueError(f"`flow` is a {type(flow).__name__}, which has no numbers to be fitted: use it as it is.")


# which flow -------------------------------------------------------------------------------------------------------


def _kind_of(system: HamiltonianSystem, flow: FlowMap | None, new: NewFlow, asked: NewFit) -> str:
    """The kind of the given flow, or of the new one that the arguments of `train` describe; these are checked."""
    if flow is not None:
        if not isinstance(flow, FlowMap):
            raise TypeError(f"`flow` must be a SympFlow or an MLPFlow; got {flow!r}: leave it out for a new one.")
        for name in new.given():
            raise ValueError(f"`{name}` describes a new flow, but `flow` is given: leave out one of them.")
        searched = {"primed": PrimedFlow, "split": SplitFlow}  # by Gauss–Newton; any other flow is fitted as a network
        return next((kind for kind, family in searched.items() if isinstance(flow, family)), flow.kind)
    kind = _meant(system, new, asked) if new.kind is None else new.kind
    if kind not in KINDS:
        raise ValueError(f"`kind` {kind!r} is unknown: choose one of {', '.join(KINDS)}.")
    for name in new.given(NewFlow.OF_NETWORKS if kind == "primed" else NewFlow.OF_PRIMED):
        raise TypeError(f"`{name}` is not an option of flows of kind {kind!r}: leave it out.")
    if kind == "primed":
        _check_primable(system, new, asked)
    return kind


def _meant(system: HamiltonianSystem, new: NewFlow, asked: NewFit) -> str:
    """The kind that is meant where none is named."""
    searched = asked.given(OF_SEARCHES)
    fits = system.separable and system.quadratic_kinetic
    if searched and not fits:
        raise ValueError(
            f"`{searched[0]}` is of the search for primed flows by Gauss–Newton, which needs H = ½ pᵀM⁻¹p + V(q); "
            f"{system.name!r} is of another form: leave it out for a network, or pass kind='primed', optimizer='bfgs'."
        )
    if searched or new.given(NewFlow.OF_PRIMED):
        return "primed"
    of_networks = asked.beside(TableOptions)
    if asked.loss is None:
        of_networks += asked.given((*OF_LOSSES, "data"))
    wants_network = not asked.searches or of_networks or new.given(NewFlow.OF_NETWORKS)
    return "primed" if fits and not wants_network else "sympflow"


def _check_primable(system: HamiltonianSystem, new: NewFlow, asked: NewFit) -> None:
    """Raise if a new primed flow of the system cannot be made, or not be fitted by its optimizer."""
    given = new.given(("kind", *NewFlow.OF_PRIMED)) + asked.given(OF_SEARCHES)
    named = " and ".join(f"`{name}`" for name in given)
    needs = f"{named} asks for a flow primed with V and T"
    if not system.separable:
        raise ValueError(
            f"{needs}, but the system {system.name!r} has one function H, not known as T(p) + V(q): leave out {named} "
            "for a network, or define the system with HamiltonianSystem.from_sympy."
        )
    if not system.quadratic_kinetic and asked.searches:
        raise ValueError(
            f"{needs}, whose table Gauss–Newton fits only where T = ½ pᵀM⁻¹p, as it is not in the system "
            f"{system.name!r}: leave out {named} for a network, or pass optimizer='bfgs'."
        )


def _new_primed(
    system: HamiltonianSystem, domain: Domain, dt: float | None, new: NewFlow, asked: NewFit, session: Session
) -> tuple[PrimedFlow, PrimedFlow | None]:
    """A new primed flow, and the one that was fitted in a trial if there were any.

    Where nothing is said of the flow and its fit, trials choose it; of a run to go on with it is that one's, if it is
    one of those that are tried. Else what is not given is as `default_primed` has it, Δt in proportion to the kicks.
    """
    stages, processor = new.stages, new.processor
    can_try = dt is None and not new.given(("stages", "processor", "dtype", "device")) and trials.can_try(system)
    if can_try and session.resume is not None:
        theirs = checkpoints.read(session.resume)["architecture"]
        for start in trials.all_starts(system, domain):
            flow = start.flow(system)
            if checkpoints.identity(flow, system, {})["architecture"] == theirs:
                return flow, None
    elif can_try and _fit_is_untold(asked, session):
        trial = trials.chosen_trial(system, domain, session)
        flow = trial.start.flow(system)
        return flow, trial.flow
    if system.separable and (dt is None or stages is None or processor is None):
        default = default_primed(system, domain, dt)
        if dt is None:
            dt = default.dt if stages is None else float(f"{default.dt * stages / default.stages:.3g}")
        stages = default.stages if stages is None else stages
        processor = default.processor if processor is None else processor
    flow = SympFlow.primed(
        system,
        stages,
        dt=1.0 if dt is None else float(dt),
        processor=0 if processor is None else processor,
        dtype=torch.float64 if new.dtype is None else new.dtype,
        device=new.device,
    )
    return flow, None


def _fit_is_untold(asked: NewFit, session: Session) -> bool:
    """Return whether nothing is said of the fit of a new flow, and there is time for trials."""
    hurried = session.time_budget is not None and session.time_budget < SHORT_BUDGET
    return asked.searches and not hurried and not set(asked.given()) - {"optimizer", "seed", "reference_states"}


# which fit --------------------------------------------------------------------------------------------------------


def _run_of(
    system: HamiltonianSystem,
    domain: Domain,
    kind: str,
    flow: FlowMap | None,
    tried: PrimedFlow | None,
    dt: float | None,
    new: NewFlow,
    asked: NewFit,
    deadline: Deadline,
    runs: MadeRuns | None = None,
) -> Run:
    """The run of a copy of a flow, or of a new network if there is none."""
    searched = kind in ("primed", "split") and asked.searches
    double = new.dtype in (None, torch.float64) and (flow is None or flow.dtype == torch.float64)
    if not double and (searched or asked.optimizer == "gauss-newton"):
        raise TypeError("`optimizer` 'gauss-newton' fits flows in float64: leave out `dtype`, or use 'adam'.")
    if flow is not None:
        flow = copy.deepcopy(flow).bound(system)
        flow.certified = None  # of the numbers as they were
        dt = flow.dt
    if searched and isinstance(flow, SplitFlow):
        split = SplitOptions.of(asked)
        try:
            return SplitRun.start(flow, system, domain, split, deadline)
        except OutOfTime as cut:
            return Unstarted(flow, system, domain, None, split, str(cut))
    dt = 1.0 if dt is None else float(dt)
    labels = None if asked.data is None else handed_in(asked.data, system, dt)
    checksum = None if labels is None else digest(labels)
    if labels is not None:
        warn_of_another_system(labels, system)
    if searched and isinstance(flow, PrimedFlow):
        table = TableOptions.of(asked, checksum)
        scaling = scaling_of(domain, dt, table.seed)
        try:
            run: Run = TableRun.start(flow, system, domain, scaling, table, labels, tried, deadline, runs)
        except OutOfTime as cut:
            return Unstarted(flow if tried is None else tried, system, domain, scaling, table, str(cut))
        if labels is not None and table.loss == "labels":
            run.unfitted = unlabelled(labels[0], dt)
        return run
    options = LossOptions.of(asked, kind, checksum)
    scaling = scaling_of(domain, dt, options.seed)
    if flow is None:
        flow = new_network(system, new, dt, scaling, options.seed)
    try:
        run = LossRun.start(flow.requires_grad_(True), system, domain, scaling, options, labels, deadline)
    except OutOfTime as cut:
        return Unstarted(flow, system, domain, scaling, options, str(cut))
    if not (options.residual_weight or options.matching_weight):
        made = dt * np.arange(1, options.label_times + 1) / options.label_times
        run.unfitted = unlabelled(made if labels is None else labels[0], dt)
    return run
