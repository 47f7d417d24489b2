"""Short fits by which `train` chooses the flow for a system if no options are given."""

from __future__ import annotations

import math
from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace

import numpy as np

from sympflow.arguments import warn
from sympflow.compiler import NotCompiled
from sympflow.flow.primed import PrimedFlow
from sympflow.flow.scaling import Scaling
from sympflow.hamiltonian.domain import Domain
from sympflow.hamiltonian.exact_flow import reference_step
from sympflow.hamiltonian.system import HamiltonianSystem
from sympflow.schemes import CURVATURE, FORCE_GRADIENT
from sympflow.training.fits import GaussNewton, PrimedFit, Resolved
from sympflow.training.points import USELESS, Stream, shares_missed, start_times, states, step_errors
from sympflow.training.session import Deadline, OutOfTime, Session
from sympflow.training.starts import PHASE, SEED, default_primed
from sympflow.training.table_fit import TableRun

PHASES = (PHASE, 1.25, 1.5)  # ω Δt of the flows that are tried
STARTS, STEPS, FINAL_STEPS, POINTS = 6, 40, 160, 80  # of a trial's search, and what follows the best start
ORBITS, LENGTH = 20, 256  # held-out orbits of a trial, and their steps
FEWER, REFERENCE = 32, 1e-10  # steps of orbits whose energy changes, and the tolerance of the exact ones beside them
SHAPES = (
    ("111", 9, 1.0),
    ("010", 6, 1.0),
    ("010", 9, 1.2),
    ("k010", 9, 1.2),
    ("k101", 9, 1.2),
    ("k1001", 6, 1.0),
    ("k01010", 6, 0.9),
    ("k10101", 6, 0.9),
    ("1", 9, 1.5),
    ("222", 9, 1.0),
    ("121", 6, 1.0),
    ("k121", 6, 1.2),
    ("k121", 9, 1.5),
    ("k1221", 9, 1.0),
    ("2", 9, 1.5),
)
"""Kicks of K, "k" in front where a step begins with one, those of χ, and how much longer Δt is for the kicks of K, of
flows that are tried too: a kick is 0, plain, 1, with a force gradient, or 2, with a curvature term besides.

A step of one kick or two leaves more to the processor, and is longer for its kicks. With processors of twelve long runs
gain some per cent more, but an output between steps, of 25 to 29 kicks, makes runs with many outputs slower."""
ORDER = 6  # with which the errors of classical schemes fall where these flows are used: that of srkn11b and srkn14a
LARGER = 1.05  # times the work of a flow with a larger processor, which outputs pay for
MOST_NDOF = 3  # beyond which trials take too long
SHARE = 0.65  # of a time budget
DEAREST = 2.0  # times the cycles of a kick without them, beyond which curvature terms are not tried
NEAR, NEAREST = 1.2, 3  # times the estimated work of the best up to which flows make long runs, and how many
CLEAR = 1.03  # times the work in long runs, by which another flow must be better than the best by its trial
LONG, SAVED = 2048, 100  # steps of the longest Δt in a long run, and states that are looked at
GOAL = 1e-5  # the energy error of a trial that a default flow shall not exceed, if one of those tried does not
ALIKE = 2.0  # energy errors above that which differ by no more are the same


@dataclass(frozen=True)
class Trial:
    """The flow of a short fit, None if it leads nowhere, and its energy error."""

    start: Resolved
    error: float
    flow: PrimedFlow | None = None


def can_try(system: HamiltonianSystem) -> bool:
    """Return whether trials apply to a system."""
    return system.separable and system.quadratic_kinetic and system.definition.symbolic and system.ndof <= MOST_NDOF


def chosen_trial(system: HamiltonianSystem, domain: Domain, session: Session | None = None) -> Trial:
    """The flow that gains most: that of `default_primed`, or one with a longer Δt, curvature terms or another shape.

    Each is fitted at Δt and followed along held-out orbits. Its work is the cycles of its kicks in a unit of time,
    times e^(1/6) of its energy error e, as a scheme of order 6: the same choice on every machine. Curvature terms are
    tried with the best Δt, unless they make kicks twice as dear, then `SHAPES` with kicks of the better kind. Where all
    errors are above `GOAL` the least count. At last up to three with nearly the least work are compared in longer runs.
    """
    from sympflow.kernels.approximations import position_ranges
    from sympflow.kernels.splitting_loops import splitting_loops

    assert system.symbols is not None
    starts: list[Resolved] = tried_starts(system, domain, curvature=False)
    try:
        ranges = position_ranges(system.form, domain)
        loops = splitting_loops(system)
        costs = [loops.kick_cycles(level, ranges if level else ()) for level in (0, FORCE_GRADIENT, CURVATURE)]
    except NotCompiled:
        return Trial(starts[0], math.inf)
    session, found = Session() if session is None else session, dict[PrimedFit, Trial]()
    interruption, deadline = session.interruption, session.deadline.part(SHARE)

    def good(tried: list[Resolved]) -> dict[Resolved, float]:
        """The work of those that are good enough."""
        least = min(found[start].error for start in tried)
        worst = GOAL if least <= GOAL else ALIKE * least
        return {
            start: sum(costs[level] for level in start.levels)
            / start.dt
            * found[start].error ** (1 / ORDER)
            * LARGER ** (start.processor > starts[0].processor)
            for start in tried
            if found[start].error <= worst
        }

    def best(tried: list[PrimedFit]) -> PrimedFit:
        work = good(tried)
        return min(work, key=work.__getitem__)

    with_curvature = costs[CURVATURE] <= DEAREST * costs[FORCE_GRADIENT]
    with session.bar(len(starts) + with_curvature + 2 * len(SHAPES), f"{system.name} trials") as bar:

        def attempt(wanted: list[PrimedFit]) -> None:
            answers = session.each(_trial_of, (system, domain, deadline), wanted, deadline)
            for start in wanted:
                if deadline.over():
                    return
                bar.tries(len(found), _described(start))
                try:
                    made = next(answers)
                except KeyboardInterrupt:  # while others work
                    if session.pool.alone or not interruption.armed:
                        raise
                    interruption.asked = True
                if deadline.over():  # then it says nothing
                    return
                found[start] = made
                # from the first flow on Ctrl-C ends the trials
                interruption.armed = interruption.armed or made.flow is not None

        attempt(starts)
        if not found:
            _warn_if_cut(session, 0, starts)
            return Trial(starts[0], math.inf)
        plainest = best([*found])
        curved = replace(plainest, curvature=True)
        if with_curvature:
            attempt([curved])
        both = [plainest, curved]
        chosen = best(both) if curved in found else plainest
        shorter = replace(starts[max(0, starts.index(plainest) - 1)], curvature=chosen.curvature)
        others = list(dict.fromkeys([*shaped(chosen), *shaped(shorter)]))
        attempt(others)
        _warn_if_cut(session, len(found), {*starts, *others, *([curved] if with_curvature else [])})
        work = good([chosen, *(start for start in others if start in found)])
        long = {} if deadline.over() else _long_work(work, found, system, domain)
        first = min(work, key=work.__getitem__)
        return found[min(long, key=lambda start: long[start] * (1.0 if start == first else CLEAR), default=first)]


def _warn_if_cut(session: Session, n_tried: int, wanted: Collection[PrimedFit]) -> None:
    """Warn where the time ended the trials, not Ctrl-C: the flow may be far from what `train` finds else."""
    if n_tried < len(wanted) and not session.interruption.asked:
        warn(
            f"`time_budget`: of {session.time_budget:g} s the share for trials ended, as on a busy machine, after "
            f"{n_tried} of {len(wanted)} or more flows; one that was not tried may be much faster than the one that "
            "is fitted. "
            "Give a longer `time_budget`.",
            RuntimeWarning,
        )


def _long_work(
    work: dict[PrimedFit, float], found: dict[PrimedFit, Trial], system: HamiltonianSystem, domain: Domain
) -> dict[PrimedFit, float]:
    """The estimated work of those that are nearly as good as the best, by their energy errors in long runs."""
    near = [start for start in sorted(work, key=work.__getitem__) if work[start] <= NEAR * min(work.values())][:NEAREST]
    flows = [flow for start in near if (flow := found[start].flow) is not None]
    if len(near) < 2 or len(flows) < len(near) or not system.keeps_energy:
        return {}
    errors = long_errors(flows, system, domain)
    return {
        start: work[start] * (error / found[start].error) ** (1 / ORDER)
        for start, error in zip(near, errors, strict=True)
        if math.isfinite(error)
    }


def long_errors(flows: Sequence[PrimedFlow], system: HamiltonianSystem, domain: Domain) -> list[float]:
    """The median relative energy error of each flow in runs of 2048 times the longest Δt; ∞ where one ends early."""
    orbits, errors = states(domain, ORBITS, SEED, Stream.REFERENCE), []
    H = system.hamiltonian(orbits)
    scale = np.abs(H) if system.energy_scale is None else system.energy_scale
    for flow in flows:
        n = round(LONG * max(other.dt for other in flows) / flow.dt)
        save = np.linspace(0, n, SAVED + 1).astype(int)[1:]
        kernel = flow.kernel_for(system)
        with np.errstate(all="ignore"):
            energies = [system.hamiltonian(kernel.run(flow.dt, y, n, save).states) for y in orbits]
            worst = np.abs(np.array(energies) - H[:, None]).max(1) / scale
        errors.append(float(np.median(np.where(np.isnan(worst), np.inf, worst))))
    return errors


def tried_starts(system: HamiltonianSystem, domain: Domain, curvature: bool = True) -> list[PrimedFit]:
    """The flows that are tried first, from the shortest Δt to the longest; with `curvature` also with such terms."""
    plain = list(dict.fromkeys(default_primed(system, domain, phase=phase) for phase in PHASES))
    return plain + [replace(start, curvature=True) for start in plain if curvature]


def all_starts(system: HamiltonianSystem, domain: Domain) -> list[PrimedFit]:
    """All flows that `chosen_trial` may choose."""
    starts = tried_starts(system, domain)
    return starts + [other for start in starts for other in shaped(start)]


def shaped(start: Resolved) -> list[PrimedFit]:
    """The flow in each of the `SHAPES` with kicks of its kind, about as many in a unit of time: see `dividing`."""
    made = []
    for shape, processor, longer in SHAPES:
        levels = [int(level) for level in shape.removeprefix("k")]
        first, n = ("kick", len(levels) - 1) if shape[0] == "k" else ("drift", len(levels))
        if bool(start.curvature) != (CURVATURE in levels):
            continue
        some = {
            name: True if min(levels) >= least else tuple(i for i, level in enumerate(levels) if level >= least)
            for name, least in (("force_gradient", FORCE_GRADIENT), ("curvature", CURVATURE))
        }
        made.append(
            replace(
                start,
                dt=dividing(start.dt * longer * n / start.stages),
                stages=n,
                processor=processor,
                first=first,
                force_gradient=some["force_gradient"],
                curvature=some["curvature"] if start.curvature else False,
            )
        )
    return made


def dividing(dt: float) -> float:
    """The Δt nearest to dt that divides a power of ten, 10ᵏ/n with n ≤ 10, so that outputs at round times are cheap."""
    unit = 10.0 ** math.floor(math.log10(dt))
    return min((10 * unit / n for n in range(1, 11)), key=lambda t: abs(math.log(t / dt)))


def _described(start: PrimedFit) -> str:
    words = {0: "plain", FORCE_GRADIENT: "with a force gradient", CURVATURE: "with a curvature term"}
    kinds = ", ".join(f"{start.levels.count(level)} {words[level]}" for level in sorted({*start.levels}))
    return f"Δt = {start.dt:g}, kicks: {kinds}; processor of {start.processor}"


def _trial_of(common: tuple[HamiltonianSystem, Domain, Deadline], start: PrimedFit) -> Trial:
    """A trial as a task, which is silent if its time ends."""
    system, domain, deadline = common
    try:
        return trial(start, system, domain, deadline)
    except OutOfTime:  # while the exact orbits of a system with friction are made, for one
        return Trial(start, math.inf)


def trial(start: Resolved, system: HamiltonianSystem, domain: Domain, deadline: Deadline | None = None) -> Trial:
    """A short fit at Δt, with its median relative energy error; infinite if it misses a tenth of what a step moves."""
    deadline = Session().deadline if deadline is None else deadline
    dt = start.dt
    fit = replace(start, points=POINTS, label_times=1, reference_states=ORBITS, seed=SEED)
    solver = GaussNewton(restarts=STARTS, steps=STEPS)
    scaling = Scaling.of_samples(states(domain, 1000, SEED, Stream.SCALING), dt)
    try:
        run = TableRun(start.flow(system), system, domain, scaling, fit, solver, deadline)
    except (ValueError, OutOfTime):  # of no state of Ω the solution exists up to Δt, or it takes too long
        return Trial(start, math.inf)
    frozen = run.frozen
    assert frozen is not None
    for _ in range(STARTS):
        run.minima.append(run.next_minimum(deadline.session, deadline))
    best = min(run.minima, key=lambda m: m.cost)
    for final in filter(None, (frozen, run.weighted)):
        best = final.minimize(best.x, FINAL_STEPS, deadline, thorough=True)
    table = frozen.coefficients(best.x).T
    exact = states(domain, ORBITS, SEED, Stream.REFERENCE)
    t = start_times(system, dt, len(exact), SEED, Stream.REFERENCE)
    H, worst, y = system.hamiltonian(exact, t), np.zeros(len(exact)), exact.T
    scale = np.abs(H) if system.energy_scale is None else system.energy_scale
    labels = run.held_out
    with np.errstate(all="ignore"):
        missed = run.step(table, labels.x.T, t0=labels.t0)[: len(y)].T - labels.y[-1]
        if not shares_missed(missed, labels, np.array(scaling.x))[1] < USELESS:
            return Trial(start, math.inf)
        for _ in range(LENGTH if system.conservative else FEWER):
            end = run.step(table, y, t0=t)
            y, E = end[: len(y)], end[len(y) :].sum(0)  # less the work of a drive, where there is one
            if not system.conservative:  # the energy that the exact flow has left
                exact = reference_step(system, exact, dt, REFERENCE, deadline.check, t)
            t = None if t is None else t + dt
            H = H - E if system.conservative else system.hamiltonian(exact, t)
            worst = np.maximum(worst, np.abs(system.hamiltonian(y.T, t) - H))
        worst /= scale
    error = float(np.median(np.where(np.isnan(worst), np.inf, worst)))
    if not math.isfinite(error) or deadline.over():
        return Trial(start, error)
    run.table.assign(run.table.continued(table[:, 0]))
    run.flow.figures = step_errors(run.differences())
    return Trial(start, error, run.flow)
