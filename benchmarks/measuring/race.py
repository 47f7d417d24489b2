"""Primed flows, splitting schemes and heyoka at equal error: how many steps each needs, and how long it takes."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import cached_property, partial
from typing import Any

import numpy as np

from measuring.compiled import flow_loops, last, scheme_loops
from sympflow import HamiltonianSystem, get, solve
from sympflow.flow.clocked import ClockedFlow
from sympflow.flow.primed import PrimedFlow
from sympflow.integrators.flows import LogSympFlow
from sympflow.metrics.energy_balance import extended_system
from sympflow.metrics.reference import reference
from sympflow.schemes import SCHEMES

INSTANTS = 1000
HELD_OUT, HELD_OUT_SEED = 20, 20_261_121  # a seed that no training uses
TIMED = 3  # states that are run one after the other for a time
TIMED_SPAN = 10_000.0  # how far: 1000 units of time may take 20 µs, of which the call would be a good part
TRANSFORMED = {"log_leapfrog": "leapfrog", "log_blanes_moan4": "blanes_moan4", "log_kahan_li8": "kahan_li8"}
LONGEST_TRANSFORMED = 0.5  # log_leapfrog keeps Kepler's energy at any step: it shall at least resolve the orbit
MOST_FORCES = 3_000_000  # beyond which a scheme is out of the race
SHORTEST = 4  # times that a flow's step may be below its Δt
CLOSENESS = 1.01  # of the fewest steps, as a ratio
NEAR = 2.0  # schemes with so many times the fewest evaluations are not timed
WORK = 20_000_000  # kicks of all trajectories together in a timed batch, which is a part of the interval


@dataclass(frozen=True)
class Runner:
    """A flow or a scheme that takes steps. `one` and `many` are its compiled loops: (h, y0, n, save) to states."""

    name: str
    forces: int
    hessians: int
    one: Callable[..., Any]
    many: Callable[..., Any]
    longest: float = np.inf
    balanced: Callable[..., Any] | None = None
    """`many` of the extended system [q, s, p, E] of a driven one."""

    @classmethod
    def of_flow(cls, flow: PrimedFlow | ClockedFlow, system: HamiltonianSystem) -> Runner:
        if isinstance(flow, ClockedFlow):
            name = f"{flow.scheme.name} with a clock, Δt = {flow.figures['step']:g}"
            return cls._through_solve(name, flow.scheme.force_evaluations, system, partial(LogSympFlow, flow=flow))
        loops, scheme = flow_loops(system, flow), flow.kernel_scheme()
        name = f"Δt = {flow.dt:g}, {scheme.force_evaluations} + {flow.processor}"
        name += f", degree {max(map(sum, flow.monomials))}" if flow.monomials else ""
        more = {}
        if not system.autonomous:
            extended = extended_system(system)
            more["balanced"] = flow_loops(extended, flow.on_extended(extended)).many
        return cls(name, scheme.force_evaluations, scheme.hessian_evaluations, loops.one, loops.many, flow.dt, **more)

    @classmethod
    def of_scheme(cls, name: str, system: HamiltonianSystem) -> Runner:
        loops, scheme = scheme_loops(system, name), SCHEMES[name]
        more = {} if system.autonomous else {"balanced": scheme_loops(extended_system(system), name).many}
        return cls(name, scheme.force_evaluations, scheme.hessian_evaluations, loops.one, loops.many, **more)

    @classmethod
    def of_transformed(cls, name: str, system: HamiltonianSystem) -> Runner:
        """A method of equal steps in the transformed time, through `solve`, with the cost of calling it."""
        return cls._through_solve(name, SCHEMES[TRANSFORMED[name]].force_evaluations, system, get(name))

    @classmethod
    def _through_solve(cls, name: str, forces: int, system: HamiltonianSystem, method: Callable[..., Any]) -> Runner:
        def run(h: float, y0: np.ndarray, n: int, save: np.ndarray) -> tuple[np.ndarray]:
            times = h * save
            y = solve(system, method(dt=h), (0.0, float(times[-1])), y0, t_eval=times, on_domain_exit="ignore").y
            missing = [*[(0, 0)] * (y.ndim - 1), (0, len(times) - y.shape[-1])]
            return (np.moveaxis(np.pad(y, missing, constant_values=np.nan), -1, -2),)

        return cls(name, forces, 0, run, run, LONGEST_TRANSFORMED)


def transformed(system: HamiltonianSystem) -> list[Runner]:
    """The methods for close encounters, where there are any."""
    return [Runner.of_transformed(name, system) for name in TRANSFORMED] if system.name == "kepler" else []


def schemes(system: HamiltonianSystem) -> list[Runner]:
    """All splitting schemes of the package that apply."""
    return [
        Runner.of_scheme(name, system)
        for name, scheme in SCHEMES.items()
        if system.quadratic_kinetic or not (scheme.nystrom or any(scheme.gradients))
    ]


@dataclass(frozen=True)
class Measure:
    """An error over [0, t_end], the median over held-out states: of the energy, or of the state at the end.

    The energy error of a driven system is that of the balance, E + H, over its energy scale or the largest |H|.
    """

    system: HamiltonianSystem
    name: str
    t_end: float
    seed: int = HELD_OUT_SEED

    @cached_property
    def y0(self) -> np.ndarray:
        assert self.system.domain is not None
        return self.system.domain.sample(HELD_OUT, self.seed)

    @cached_property
    def _end(self) -> np.ndarray:
        return reference(self.system, (0.0, self.t_end), self.y0, np.array([self.t_end])).y[..., 0]

    def of(self, runner: Runner, n: int) -> float:
        """In n steps."""
        save = np.unique(np.linspace(0, n, INSTANTS + 1).round().astype(np.int64))
        with np.errstate(all="ignore"):  # too few steps overflow
            if self.name == "energy" and runner.balanced is not None:
                h = self.t_end / n
                return self._of_balance(runner.balanced(h, self._extended_y0, n, save)[0], h * save)
            Y = runner.many(self.t_end / n, self.y0, n, save if self.name == "energy" else np.array([0, n]))[0]
            return self.of_states(Y)

    @cached_property
    def _extended_y0(self) -> np.ndarray:
        zero = np.zeros((len(self.y0), 1))
        q, p = np.split(self.y0, 2, axis=1)
        return np.concatenate([q, zero, p, zero], axis=1)

    def _of_balance(self, Y: np.ndarray, t: np.ndarray) -> float:
        """Energy errors of states (N, n, 2d + 2) of the extended system at times t (n,)."""
        H = self.system.hamiltonian(np.delete(Y, [self.system.ndof, -1], axis=-1), np.broadcast_to(t, Y.shape[:-1]))
        error = np.abs(H + Y[..., -1] - H[:, :1]).max(1) / (self.system.energy_scale or np.abs(H).max(1))
        return float(np.median(np.where(np.isnan(error), np.inf, error)))

    def of_states(self, Y: np.ndarray) -> float:
        """Errors of states (N, n, 2d), the first of which are the initial ones."""
        if self.name == "energy":
            H = self.system.hamiltonian(Y)
            error = np.abs(H - H[:, :1]).max(1) / np.abs(H[:, 0])
        else:
            error = np.linalg.norm(Y[:, -1] - self._end, axis=-1)
        return float(np.median(np.where(np.isnan(error), np.inf, error)))


def fewest_steps(
    error: Callable[[int], float], target: float, guess: int, least: int = 1, most: int = 10**7
) -> int | None:
    """The smallest n ≥ least, to 1 %, with error(n) ≤ target, if there is one up to `most`."""
    high = max(guess, least)
    while error(high) > target:
        if high >= most:
            return None
        high = min(2 * high, most)
    low = max(high // 2, least)
    while low > least and error(low) <= target:
        low, high = max(low // 2, least), low
    if error(low) <= target:
        return low
    while high > CLOSENESS * low + 1:
        middle = round((low * high) ** 0.5)
        low, high = (low, middle) if error(middle) <= target else (middle, high)
    return high


@dataclass
class Row:
    """A target, the flow that meets it in the shortest time, and how many times longer the best of the others takes."""

    system: str
    measure: str
    target: float
    flow: str
    dt: float
    kicks: int
    error: float
    fit_seconds: float
    one_step_error: float
    fractional_error: float
    seconds: float
    faster: dict[str, float] = field(default_factory=dict)
    rival: dict[str, str] = field(default_factory=dict)
    evaluations_saved: float = 0.0


def race(
    measure: Measure,
    target: float,
    flows: Sequence[PrimedFlow | ClockedFlow],
    taylor: Any,
    repeats: int,
    batch: int,
    span: float = TIMED_SPAN,
) -> Row | None:
    """All at the error `target`, on one thread: one trajectory, one with 1000 outputs, and a batch.

    One trajectory is timed over `span`: with friction a shorter one, for numbers that come to rest are denormal.
    """
    system, T = measure.system, measure.t_end
    own = {Runner.of_flow(f, system): f for f in flows}
    steps: dict[Runner, int] = {}
    encounters = transformed(system)
    for runner in [*own, *schemes(system), *encounters]:
        least = max(1, int(np.ceil(T / runner.longest * (1 - 1e-12))))
        guess = max(least, round(2000 * T / 1000 / runner.forces))
        most = MOST_FORCES // runner.forces if runner not in own else SHORTEST * least
        found = fewest_steps(partial(measure.of, runner), target, guess, least, most)
        if found is not None:
            steps[runner] = found
    work = {r: n * (r.forces + r.hessians / 2) for r, n in steps.items()}
    if not any(r in own for r in steps):
        return None
    ours = {r for r in steps if r in own}
    others = {r for r in steps if r not in own and r not in encounters}
    timed = {r for r in ours if isinstance(own[r], ClockedFlow)}  # each side against itself, for their forces differ
    sides = [side for side in (ours - timed, timed, others, {r for r in steps if r in encounters}) if side]
    near = [r for side in sides for r in side if work[r] <= NEAR * min(work[s] for s in side)]
    tol = None if taylor is None else tolerance(measure, taylor, target)
    times = {
        "one": _single(near, steps, measure, taylor, tol, repeats, span, outputs=False),
        "outputs": _single(near, steps, measure, taylor, tol, repeats, span, outputs=True),
        "batch": _batch(near, steps, measure, taylor, tol, repeats, batch),
    }
    flow = min((r for r in near if r in own), key=lambda r: times["one"][r.name])
    n, trained = steps[flow], own[flow]
    row = Row(
        system.name, measure.name, target, flow.name, T / n, n * flow.forces, measure.of(flow, n),
        trained.figures["training_seconds"], trained.figures["one_step_error"], trained.figures["fractional_error"],
        times["one"][flow.name],
    )  # fmt: skip
    for kind, of in times.items():
        mine = min(of[r.name] for r in near if r in own)
        rivals = {r.name: of[r.name] for r in near if r not in own}
        row.rival[kind] = min(rivals, key=rivals.__getitem__)
        row.faster[kind] = rivals[row.rival[kind]] / mine
        if "heyoka" in of:
            row.faster[f"heyoka {kind}"] = of["heyoka"] / mine
    row.evaluations_saved = min(steps[r] * r.forces for r in others) / row.kicks
    return row


def tolerance(measure: Measure, taylor: Any, target: float) -> float:
    """The largest tolerance of heyoka, to 10 %, that meets the target."""
    times = np.linspace(0.0, measure.t_end, INSTANTS + 1 if measure.name == "energy" else 2)

    def error(tol: float) -> float:
        return measure.of_states(np.stack([taylor.grid(tol, y, times) for y in measure.y0]))

    low, high = 1e-16, 1e-2
    while high > 1.1 * low:
        middle = float(np.sqrt(low * high))
        low, high = (middle, high) if error(middle) <= target else (low, middle)
    return low


def _single(near, steps, measure, taylor, tol, repeats, span, outputs):  # type: ignore[no-untyped-def]
    T, y0 = measure.t_end, measure.y0[:TIMED]
    repeat = max(1, round(span / T))
    times = np.linspace(0.0, repeat * T, repeat * INSTANTS + 1)
    calls: dict[str, Callable[[], Any]] = {}
    for runner in near:
        n = repeat * steps[runner]
        save = last(n)
        if outputs:
            save = np.unique(np.linspace(0, n, repeat * INSTANTS + 1).round().astype(np.int64))
        calls[runner.name] = partial(_each, partial(runner.one, T / steps[runner]), y0, n, save)
    if tol is not None:
        run, until = (taylor.grid, times) if outputs else (taylor.run, repeat * T)
        calls["heyoka"] = partial(_each, partial(run, tol), y0, until)
    return {name: seconds / (repeat * TIMED) for name, seconds in _timed(calls, repeats).items()}


def _each(run: Callable[..., Any], y0: np.ndarray, *arguments: Any) -> None:
    for y in y0:
        run(y, *arguments)


def _batch(near, steps, measure, taylor, tol, repeats, batch):  # type: ignore[no-untyped-def]
    T = measure.t_end
    y0 = measure.system.domain.sample(batch, 0)
    calls: dict[str, Callable[[], Any]] = {}
    share = {}
    for runner in near:
        n = steps[runner]
        part = max(1, min(n, WORK // (batch * runner.forces)))
        share[runner.name] = n / part
        calls[runner.name] = partial(runner.many, T / n, y0, part, last(part))
    if tol is not None:
        part = min(T, T * WORK / (50 * batch * max(steps[r] * r.forces for r in near)))
        share["heyoka"] = T / part
        calls["heyoka"] = partial(taylor.run_lanes, tol, y0, part)
    return {name: seconds * share[name] for name, seconds in _timed(calls, repeats).items()}


def _timed(calls: dict[str, Callable[[], Any]], repeats: int) -> dict[str, float]:
    """The least of several process times of each, taken in turn: what else the machine does only adds to a time."""
    best = dict.fromkeys(calls, np.inf)
    for call in calls.values():
        call()
    for _ in range(repeats):
        for name, call in calls.items():
            start = time.process_time()
            call()
            best[name] = min(best[name], time.process_time() - start)
    return best
