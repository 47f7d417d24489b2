"""The training of flows of planets: kicks of a processor that make the energies of states along one orbit equal.

A kick b of the interaction changes the energy by b Δt Σ m v·a, to first order in b, wherever on the orbit it is made,
since steps conserve energies far better. So the processor is found by linear least squares on the energy errors of
plain steps, repeated for the remaining errors, weighted by these, so that the largest become smaller.
"""

from __future__ import annotations

import math
import time
from collections.abc import Iterator
from dataclasses import replace
from typing import NamedTuple

import numpy as np
import torch

from sympflow.flow.planetary import STEP, KeplerFlow, processor_of
from sympflow.hamiltonian.domain import Domain
from sympflow.hamiltonian.planets import Frame, PlanetsHamiltonian
from sympflow.hamiltonian.system import HamiltonianSystem
from sympflow.kernels.kepler import KeplerKernel, KeplerLoops, kepler_loops
from sympflow.kernels.protocol import Task
from sympflow.schemes import corrector_maps, paired, reversed_substeps
from sympflow.training.fits import KeplerFit
from sympflow.training.session import Session

LINEAR_STEPS, WEIGHTED_STEPS = 3, 6
CUTOFF = 1e-9, 1e-5  # of singular values, without and with force gradients
FEW = 3  # points for each number, of a trial
LONGEST, SHORTEST, RATIO = 1 / 4, 1 / 100, 1.002  # steps that are tried, parts of the shortest period; their spacing
HOPE = 20.0  # error of a standard corrector, in units of the tolerance, from which a trained one may reach it
LOOKS = 300  # at the energy, to find that
TRIAL_ORBITS = 2000


class Orbit(NamedTuple):
    """Compiled loops of planets, a state to begin with, and its energy."""

    system: HamiltonianSystem
    frame: Frame
    loops: KeplerLoops
    start: np.ndarray
    energy: float

    @classmethod
    def of(cls, system: HamiltonianSystem, frame: Frame) -> Orbit:
        start = np.asarray(system.y0, dtype=float)
        return cls(system, frame, kepler_loops(frame), start, float(system.hamiltonian(start)))

    def errors(self, y: np.ndarray) -> np.ndarray:
        """The relative errors of the energy of states."""
        return (self.system.hamiltonian(y) - self.energy) / abs(self.energy)

    def states(self, h: float, orbits: float, points: int, seed: int, processor: tuple = ((), ())) -> np.ndarray:
        """States after random numbers of steps in so many orbits of the innermost planet."""
        n = max(points, int(orbits * self.frame.periods.min() / h))
        save = np.sort(np.random.default_rng(seed).choice(n, points, replace=False)) + 1
        return KeplerKernel(self.loops, STEP, *processor).run(h, self.start[None], n, save).states[0]


def can_train(system: HamiltonianSystem) -> bool:
    """Return True for planets whose best known flow is of this kind."""
    local = system.local
    return isinstance(local, PlanetsHamiltonian) and local.frame.jacobi and not len(local.frame.test)


def train_planets(system: HamiltonianSystem, fit: KeplerFit, domain: Domain | None, session: Session) -> KeplerFlow:
    """A flow of planets about a star, with its record."""
    started, cpu = time.perf_counter(), time.process_time()
    flow = KeplerFlow(system.ndof, fit.reach, fit.gradients, 1.0, system=system)
    if len(flow.frame.test):
        raise ValueError(
            f"`system` {system.name!r} has bodies without mass, which no step is fitted to: train a flow of the "
            "planets alone."
        )
    orbit = Orbit.of(system, flow.frame)
    dt = _longest(orbit, fit, session) if fit.dt is None else fit.dt
    flow.dt = float(dt)
    numbers, residual = fitted(orbit, flow.dt, fit)
    for mine, found in zip((flow.kicks, flow.gradients), _split(numbers, fit), strict=True):
        mine.copy_(torch.as_tensor(found))
    flow.domain = domain
    flow.identify(system, domain)
    own = {name: getattr(fit, name) for name in ("points", "orbits", "seed")}
    stage = {"optimizer": "least squares", "loss": "energy", **own}
    flow.recipe = {"stages": [stage], "torch": torch.__version__}
    flow.figures = {"fit_error": residual, "energy_error": held_out(orbit, flow.dt, numbers, fit)}
    flow.figures["training_seconds"] = round(time.perf_counter() - started, 3)
    flow.figures["training_cpu_seconds"] = round(time.process_time() - cpu, 3)
    return flow


def fitted(orbit: Orbit, h: float, fit: KeplerFit) -> tuple[np.ndarray, float]:
    """The numbers of the processor of steps h, and half of the range of the energy errors at the points."""
    y = orbit.states(h, fit.orbits, fit.points, fit.seed)
    columns = np.column_stack([np.ones(len(y)), _columns(orbit, h, y, fit)])
    unit = np.linalg.norm(columns, axis=0)
    columns /= unit
    numbers, weights = np.zeros(len(unit) - 1), np.ones(len(y))
    best = numbers, np.inf
    for k in range(LINEAR_STEPS + WEIGHTED_STEPS + 1):
        processor = processor_of(*_split(numbers, fit))
        error = orbit.errors(KeplerKernel(orbit.loops, processor).jvp(h, y)[0])
        middle = (error.max() + error.min()) / 2
        size = np.abs(error - middle)
        if not np.isfinite(size).all():
            break
        best = (numbers, float(size.max())) if size.max() < best[1] else best
        if k >= LINEAR_STEPS:  # Lawson's weights
            weights = weights * size
            weights /= weights.mean()
        root = np.sqrt(weights)
        found = np.linalg.lstsq(columns * root[:, None], -error * root, rcond=CUTOFF[fit.gradients > 0])[0]
        numbers = numbers + (found / unit)[1:]
    return best


def _split(numbers: np.ndarray, fit: KeplerFit) -> tuple[list[float], list[float]]:
    """β and γ."""
    return numbers[: 2 * fit.reach].tolist(), numbers[2 * fit.reach :].tolist()


def _columns(orbit: Orbit, h: float, y: np.ndarray, fit: KeplerFit) -> np.ndarray:
    """Relative changes of the energy by each of the kicks and force gradients of a processor, at states (N, 2d)."""
    frame, loops, M = orbit.frame, orbit.loops, fit.reach
    masses = (frame.masses[frame.order] * frame.sums[:-1] / frame.sums[1:])[:, None]
    late = KeplerKernel(loops, [(1.0, 0.5, 0.0), (0.0, 0.5, 0.0)])  # a step that begins with its kick
    half = KeplerKernel(loops, [(0.0, 0.25, 0.0), (0.0, 0.25, 0.0)])
    columns = np.zeros((len(y), 2 * M + fit.gradients))
    for sign in (1, -1):
        z = np.empty((len(y), 2 * M, y.shape[-1]))
        z[:, 1::2] = KeplerKernel(loops, STEP).runs(Task(sign * h, y, M, np.arange(1, M + 1))).states
        middle = half.jvp(sign * h, y)[0]
        z[:, ::2] = late.runs(Task(sign * h, middle, M - 1, np.arange(M))).states
        x, v, *_ = frame.into(z)
        a = frame.interaction(x)
        columns[:, : 2 * M] += sign * h * (masses * v * a).sum((-1, -2))
        if fit.gradients:
            x, v, a = (u[:, : fit.gradients] for u in (x, v, a))
            columns[:, 2 * M :] += sign * h**3 * (masses * v * frame.interaction(x, a)).sum((-1, -2))
    return columns / abs(orbit.energy)


def held_out(orbit: Orbit, h: float, numbers: np.ndarray, fit: KeplerFit) -> float:
    """The largest energy error of a run of the flow at other times, over twice as many orbits."""
    processor = processor_of(*_split(numbers, fit))
    y = orbit.states(h, 2 * fit.orbits, fit.points, fit.seed + 1, (reversed_substeps(processor), processor))
    return float(np.abs(orbit.errors(y)).max())


def _longest(orbit: Orbit, fit: KeplerFit, session: Session) -> float:
    """The longest Δt whose flow has an error of at most `tol`; the best one where time ran out."""
    best, tried = (np.inf, 0.0), replace(fit, points=FEW * (2 * fit.reach + fit.gradients))
    steps = np.geomspace(LONGEST, SHORTEST, round(math.log(LONGEST / SHORTEST) / math.log(RATIO)))
    steps *= orbit.frame.periods.min()
    with session.bar(len(steps), f"{orbit.system.name} steps") as bar:
        for h in _between_resonances(orbit, steps, HOPE * fit.tol, fit.seed):
            if session.deadline.over() and best[1]:
                break
            bar.tries(int((steps > h).sum()), f"Δt {h:.4g}")
            error = np.inf
            if _promised(orbit, h, tried) <= 2 * fit.tol:
                error = held_out(orbit, h, fitted(orbit, h, fit)[0], fit)
            best = min(best, (error, h)) if best[1] else (error, h)
            if error <= fit.tol:
                break
    return best[1]


def _between_resonances(orbit: Orbit, steps: np.ndarray, hope: float, seed: int) -> Iterator[float]:
    """Steps from the longest on at which the error with a standard corrector is the least, and in reach."""
    standard = tuple(paired([(*m, 0.0) for m in corrector_maps(17, sign)]) for sign in (1, -1))
    last = [(0.0, 0.0), (0.0, 0.0)]
    for h in [float(f"{h:.4g}") for h in steps]:
        error = np.abs(orbit.errors(orbit.states(h, TRIAL_ORBITS, LOOKS, seed, standard))).max()
        (one, _), (two, middle) = last
        if middle and two <= min(one, error, hope):
            yield middle
        last = [last[1], (float(error), h)]
    yield last[1][1]


def _promised(orbit: Orbit, h: float, fit: KeplerFit) -> float:
    """An estimate of the range of energy errors at other points, of numbers that are fitted once."""
    y = orbit.states(h, fit.orbits, fit.points, fit.seed)
    columns = np.column_stack([np.ones(len(y)), _columns(orbit, h, y, fit)])
    unit, error = np.linalg.norm(columns, axis=0), orbit.errors(y)
    numbers = np.linalg.lstsq(columns / unit, -error, rcond=CUTOFF[fit.gradients > 0])[0] / unit
    return float(np.ptp(error + columns @ numbers) / math.sqrt(1 - columns.shape[1] / len(y)))
